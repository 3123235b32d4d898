"""What every belief can be asked.

Shapes: S sessions, M samples, H answers, D features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Generator, Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Optimal
from torchrl_pref.tensors import lengths


class Update(NamedTuple):
    """What an answer makes of the belief."""

    samples: Tensor
    """(S M D), samples of the posterior."""
    ess: Tensor
    """(S), effective sample size of the mean, between 1 and M."""
    used: Tensor
    """(S) bool, False where the answer contradicts the earlier ones and was left out."""


class BeliefBase(ABC):
    """What is known of S people: M equally likely samples (S M D) for each.

    The direction of a sample is ω (:func:`torchrl_pref.tensors.directions`). Its length says how
    many times more careful than the response model the person is: 1 in a belief that infers ω
    alone. The product with features so is the return that the response model expects, and whoever
    wants ω itself takes directions.

    Attributes:
        response_model: how the belief thinks that people answer.
        n_samples: M.
    """

    response_model: ResponseModel
    n_samples: int

    def __repr__(self) -> str:
        public = (item for item in vars(self).items() if not item[0].startswith("_"))
        numbers = (f"{k}={v}" for k, v in public if k != "response_model")
        return f"{type(self).__name__}({', '.join(numbers)})"

    def rationality(self, samples: Tensor) -> Tensor:
        """What samples (S M D) hold tau to be, (S M): their lengths times the model's scale.

        Raises:
            InputError: the response model is that of a human who never errs.
        """
        if isinstance(self.response_model, Optimal):
            raise InputError(
                f"tau of {self.response_model!r}: a human who never errs has none; expected a "
                "belief in Boltzmann(tau); make the session with that, or do not ask for it"
            )
        return lengths(samples).squeeze(-1) * self.response_model.scale

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
