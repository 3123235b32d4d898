"""A belief of your own: no moves, but new samples of the prior, weighted by all answers.

    python ../../train.py belief=my_belief:Weighted belief.draws=5000

It is right wherever enough of the draws agree with the answers, and poor once they do not: with
four features and twenty answers of a noisy human a few hundred of 5,000 count.
"""

import torch
from torch import Generator, Tensor

from torchrl_pref.beliefs.base import BeliefBase, Update
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel


class Weighted(BeliefBase):
    """Importance sampling from the prior.

    Args:
        response_model: how the belief thinks that people answer.
        samples: M, that are kept.
        draws: that are weighted at each update.
    """

    def __init__(
        self, response_model: ResponseModel, samples: int = 100, draws: int = 5000
    ) -> None:
        self.response_model, self.n_samples, self.draws = response_model, samples, draws

    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """Uniform directions, (S M D)."""
        return uniform_sphere((n_sessions, self.n_samples, n_features), generator)

    def update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, generator: Generator
    ) -> Update:
        """All answers at once; what was believed before does not matter."""
        drawn = uniform_sphere((len(samples), self.draws, samples.shape[-1]), generator)
        likelihood = self.response_model.joint_log_likelihood(
            answers.gaps(drawn), answers.floor.unsqueeze(1)
        )
        used = likelihood.isfinite().any(1)  # else the answers contradict each other
        weights = likelihood.masked_fill(~used[:, None], 0.0).softmax(1)
        chosen = weights.multinomial(self.n_samples, replacement=True, generator=generator)
        after = torch.take_along_dim(drawn, chosen.unsqueeze(-1), 1)
        effective = (1 / weights.square().sum(1)).clamp(1, self.n_samples)
        after = torch.where(used[:, None, None], after, samples)
        return Update(after, torch.where(used, effective, ess), used)
