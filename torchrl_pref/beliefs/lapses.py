"""How often a person answers at random, where that is not known.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, E
lapse rates.

A few rates are believed possible, whatever ω is. No sample holds one: what a sample makes of the
answers is the mixture over all rates, and when it is to move, a rate is drawn for it, given itself
and the answers (Gibbs), so that the moves have one likelihood to follow.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Generator, Tensor

from torchrl_pref.beliefs.slice import Target
from torchrl_pref.errors import InputError
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel

RATES = (0.0, 0.4, 1.0, 2.0, 4.0)
"""What the rate may be, in units of the response model's, which is their mean."""

SHARES = (0.3, 0.25, 0.2, 0.15, 0.1)
"""How likely each rate is before the first answer."""


class LapseRates:
    """A belief over the lapse rate.

    Args:
        response_model: its lapse rate is the mean of those that are thought possible.

    Raises:
        InputError: the largest rate would be 1 or more.
    """

    def __init__(self, response_model: ResponseModel) -> None:
        self.model, base = response_model, response_model.lapse
        if RATES[-1] * base >= 1:
            raise InputError(
                f"lapse={base}: of people whose lapse rate is inferred, some are taken to have "
                f"{RATES[-1]:g} times that; expected less than {1 / RATES[-1]:g}"
            )
        self.rates = base * torch.tensor(RATES)
        self.odds = self.rates / (1 - self.rates) * (1 - base) / base

    def raised(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor], Tensor]:
        """From a slack (… S) to the log-likelihood (… S M) of the last of answers (S H) under
        samples (S M D) of the belief after the others; infinite slack gives 0."""
        past, newest = answers[:, :-1], answers[:, -1:]
        known = self._prior(samples) + self._each(past.gaps(samples), past).sum(2)
        known = known.log_softmax(-1)
        gaps = newest.gaps(samples)

        def raised(slack: Tensor) -> Tensor:
            more = gaps + slack.nan_to_num(posinf=0.0)[..., None, None, None, None]
            likely = (known + self._each(more, newest).squeeze(-2)).logsumexp(-1)
            return likely.masked_fill(slack.isinf()[..., None], 0.0)

        return raised

    def tempered(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor, Tensor], Tensor]:
        """From two powers (… S) to by how much the log-density of samples (S M D) is higher where
        the likelihood of answers (S H), given a rate, is raised to the second (… S M)."""
        prior = self._prior(samples)
        whole = self._each(answers.gaps(samples), answers).sum(2)

        def density(power: Tensor) -> Tensor:
            return (prior + power[..., None, None] * whole).logsumexp(-1)

        return lambda now, to: density(to) - density(now)

    def draw(self, samples: Tensor, target: Target, generator: Generator) -> Tensor:
        """A rate for each of samples (S M D), given the target's answers: as what it multiplies
        their floors by, (S M)."""
        gaps = target.answers.gaps(samples)
        gaps[:, :, -1] += target.slack[:, None, None, None]
        whole = self._each(gaps, target.answers).sum(2)
        logs = self._prior(samples) + target.power[:, None, None] * whole
        uniform = torch.rand(logs.shape, generator=generator, device=logs.device)
        noise = -(-uniform.clamp(min=1e-30).log()).log()
        return self.odds.to(samples)[(logs + noise).argmax(-1)]

    def _prior(self, samples: Tensor) -> Tensor:
        """(E), logarithm of how likely each rate is."""
        return torch.tensor(SHARES).to(samples).log()

    def _each(self, gaps: Tensor, answers: Evidence) -> Tensor:
        """(… S M H E), log-likelihood of answers with gaps (… S M H F J) at each rate."""
        product = self.model.log_likelihood(gaps).sum(-1).unsqueeze(-1)
        floor = answers.floor[:, None, :, None] * self.odds.to(gaps)
        likely = torch.logaddexp(product, floor.log()) + (1 - self.rates.to(gaps)).log()
        # What was shown is no lapse, and has no floor; what is no answer has none and a product of
        # 1. Neither says anything of how often people lapse.
        return torch.where(answers.floor[:, None, :, None] > 0, likely, product)
