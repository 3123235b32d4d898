"""Humans who are not as the belief takes them to be: the imperfect teachers of B-Pref.

Source: Lee, Smith, Dragan and Abbeel, *B-Pref: Benchmarking preference-based reinforcement
learning*, 2021, section 4. Of its five teachers two are settings of every human: the one who errs
by chance (a rate ε of wrong answers of two is a ``lapse`` of 2ε) and the noisily rational one
(``tau``).

Shapes: B sessions, K options per query, R possible answers, T trajectory length, D features.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from torchrl_pref.errors import InputError, check_finite_number, check_not_negative, check_share
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.questions.weak import Weak


class Skipping(SimulatedHuman):
    """Will not say which is best where all options are poor.

    B-Pref's threshold moves with what its robot has learned. Here there are pools with normalised
    features: the return of an average trajectory is 0, and its standard deviation is about 1.

    Args:
        response_model: how they answer otherwise.
        threshold: below this return an option is poor; 0 is the average.

    Raises:
        InputError: the threshold is no finite number.
    """

    def __init__(self, response_model: ResponseModel, threshold: float = 0.0) -> None:
        super().__init__(response_model)
        self.threshold = check_finite_number("threshold", threshold)

    def respond(
        self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor], turn: Tensor
    ) -> Tensor:
        """See :meth:`HumanBase.respond`: ``REFUSED`` where no option reaches the threshold."""
        answers = super().respond(queries, human, turn)
        best = (queries @ human["omega"].unsqueeze(-1)).squeeze(-1).amax(-1)
        return torch.where(best < self.threshold, REFUSED, answers)


class Undecided(SimulatedHuman):
    """Calls two options equal where their returns differ by less than a threshold, else picks one.

    The belief expects a person of a weak question to call equal what is near with a probability
    that falls with the difference; to these the threshold is sharp.

    Args:
        response_model: tau and lapse of the picks; its question is a weak one.
        threshold: in the unit of tau times the return, at least 0.

    Raises:
        InputError: the question has no "about equal", or the threshold is below 0.
    """

    def __init__(self, response_model: ResponseModel, threshold: float = 1.0) -> None:
        super().__init__(response_model)
        if not isinstance(response_model.question, Weak):
            raise InputError(
                f"human=undecided and {response_model.question!r}, in which nothing can be called "
                "equal; expected question=weak, or another human"
            )
        self.threshold = check_not_negative("threshold", threshold)
        self.picks = Boltzmann(response_model.scale, lapse=response_model.lapse)

    def log_probs(self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """See :meth:`HumanBase.log_probs`: 2 is "about equal", for certain or not at all."""
        returns = self.returns(queries, human)
        gap = self.picks.tau * (returns[..., 0] - returns[..., 1]).abs()
        picked = F.pad(self.picks(returns), (0, 1), value=-math.inf)
        equal = picked.new_tensor([-math.inf, -math.inf, 0.0])
        return torch.where((gap < self.threshold).unsqueeze(-1), equal, picked)


class Myopic(SimulatedHuman):
    """Judges a trajectory by its end: a step counts the less, the longer before the end it is.

    Args:
        response_model: how they answer.
        discount: how much less each step counts than the next one, above 0 and at most 1. The
            weights sum to one, so that 1 is someone who sees all steps alike.

    Raises:
        InputError: the discount is out of range.
    """

    def __init__(self, response_model: ResponseModel, discount: float = 0.9) -> None:
        super().__init__(response_model)
        self.discount = check_share("discount", discount)
        if self.discount == 0:
            raise InputError("discount=0: expected above 0; 0.01 sees hardly more than the last")

    def step_weights(self, n_steps: int) -> Tensor:
        """See :meth:`HumanBase.step_weights`: discount^(T-1), …, discount, 1 over their sum."""
        weights = self.discount ** torch.arange(n_steps - 1, -1, -1, dtype=torch.float64)
        return weights / weights.sum()
