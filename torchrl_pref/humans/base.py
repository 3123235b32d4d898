"""What everybody who is asked can do.

Shapes: B sessions, H query budget, K options per query, R possible answers, T trajectory length, D
features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_pref.questions.response_model import ResponseModel

REFUSED = -2
"""The answer of someone who would not say: it counts as asked, and teaches nothing."""


class HumanBase(ABC):
    """Someone who answers queries.

    Attributes:
        response_model: the kind of question that they answer, and how; what a belief assumes may
            differ.
    """

    response_model: ResponseModel

    @abstractmethod
    def draw(
        self, n_sessions: int, budget: int, n_answers: int, n_features: int, generator: Generator
    ) -> TensorDict:
        """Draw B humans, with all the luck of their H answers.

        Returns:
            ``omega`` (B D), their weights, and whatever else :meth:`respond` reads: every tensor
            (B …) and none that changes during a session.
        """

    @abstractmethod
    def respond(
        self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor], turn: Tensor
    ) -> Tensor:
        """Answer a query.

        Args:
            queries: (B K D), features of the options.
            human: as drawn.
            turn: (B), how many queries each human has answered before.

        Returns:
            (B) int64, the index of the answer, or ``REFUSED`` where they would not say.

        Raises:
            InputError: the returns are not finite.
        """

    def log_probs(self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """How likely each answer of theirs is, where they answer: without the luck.

        Only who knows the human can tell it. Here it is what the response model says at their ω;
        whoever answers otherwise says so by a method of their own.

        Args:
            queries: (B … K D), features of the options, as they see them.
            human: as drawn; of those who change, as they are in the end.

        Returns:
            (B … R), natural logarithm.
        """
        return self.response_model(returns_of(queries, human["omega"]))

    def step_weights(self, n_steps: int) -> Tensor | None:
        """(T), how much each step of a trajectory counts to them: they see queries so weighted.

        None, as here, where they see what the belief sees: the features of whole trajectories.
        """
        return None


def returns_of(queries: Tensor, omega: Tensor) -> Tensor:
    """Returns (B … K) of the options of queries (B … K D) to people of weights (B D)."""
    return (queries.flatten(1, -2) @ omega.unsqueeze(-1)).reshape(queries.shape[:-1])
