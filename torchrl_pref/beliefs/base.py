"""What every belief can be asked.

Shapes: S sessions, M samples, H answers, D features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Generator, Tensor

from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel


class Update(NamedTuple):
    """What an answer makes of the belief."""

    samples: Tensor
    """(S M D), samples of the posterior."""
    ess: Tensor
    """(S), effective sample size of the mean, between 1 and M."""
    used: Tensor
    """(S) bool, False where the answer contradicts the earlier ones and was left out."""


class BeliefBase(ABC):
    """What is known of the weights ω of S people: M equally likely unit vectors for each.

    Attributes:
        response_model: how the belief thinks that people answer.
        n_samples: M.
    """

    response_model: ResponseModel
    n_samples: int

    def __repr__(self) -> str:
        numbers = (f"{k}={v}" for k, v in vars(self).items() if k != "response_model")
        return f"{type(self).__name__}({', '.join(numbers)})"

    @abstractmethod
    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """What is believed before the first answer, (S M D)."""

    @abstractmethod
    def update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, generator: Generator
    ) -> Update:
        """Condition on one more answer of each session.

        Args:
            samples: (S M D), samples of the belief before the answer.
            ess: (S), their effective sample size.
            answers: (S H), what ``response_model.evidence`` makes of all answers. The last is the
                one to condition on; of the others, those that are -1 count for nothing.
            generator: the source of all randomness, on the device of the samples.

        Raises:
            InputError: a sample or a feature is not finite.
        """
