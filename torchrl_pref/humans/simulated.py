"""Who answers the queries.

Shapes: B sessions, H query budget, K options per query, R possible answers, D features.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError, check_positive, check_type
from torchrl_pref.humans.base import HumanBase, returns_of
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import check_finite


class SimulatedHuman(HumanBase):
    """A human with hidden weights ω, uniform on the unit sphere, who answers by a response model.

    All the randomness of the answers is drawn with ω, one draw for each of the H answers to come:
    two strategies that face the same human also face the same luck, and their difference is paired.

    Args:
        response_model: how the human answers.
        spread: humans differ in how careful they are: each one's returns are multiplied by a factor
            drawn log-uniformly between 1/spread and spread, which a strategy is not told. 1 makes
            them all alike.

    Raises:
        InputError: there is no response model, or ``spread`` is not a number from 1 to 10⁶.
    """

    def __init__(self, response_model: ResponseModel, spread: float = 1.0) -> None:
        check_type("response_model", response_model, ResponseModel, "Boltzmann(2.0)")
        self.response_model = response_model
        self.spread = check_positive("spread", spread)
        if not 1 <= spread <= 1e6:
            raise InputError(
                f"spread={spread}: expected a factor of at least 1, and at most 1e6; 1 is no spread"
            )

    def draw(
        self, n_sessions: int, budget: int, n_answers: int, n_features: int, generator: Generator
    ) -> TensorDict:
        """Draw B humans: ``omega`` (B D), standard Gumbel ``noise`` (B H R), ``care`` (B 1)."""
        omega = uniform_sphere((n_sessions, n_features), generator)
        shape = (n_sessions, budget, n_answers)
        exponential = torch.empty(shape, device=generator.device).exponential_(generator=generator)
        noise = -exponential.clamp(min=1e-30).log()
        exponent = 2 * torch.rand((n_sessions, 1), generator=generator, device=generator.device) - 1
        human = {"omega": omega, "noise": noise, "care": self.spread**exponent}
        return TensorDict(human, [n_sessions], device=generator.device)

    def respond(
        self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor], turn: Tensor
    ) -> Tensor:
        """See :meth:`HumanBase.respond`; by the Gumbel-max trick."""
        return (self.log_probs(queries, human) + at_turn(human["noise"], turn)).argmax(-1)

    def log_probs(self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """See :meth:`HumanBase.log_probs`; as careful as they are."""
        return self.response_model(self.returns(queries, human))

    def returns(self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
        """What the options of queries (B … K D) are worth to them, times their care (B … K).

        Raises:
            InputError: a return is not finite.
        """
        returns = returns_of(queries, human["omega"])
        returns = returns * human["care"].view(-1, *(1,) * (returns.ndim - 1))
        check_finite("the human's returns (queries @ omega * care)", returns)
        return returns


def at_turn(drawn: Tensor, turn: Tensor) -> Tensor:
    """Of what was drawn for each question (B H n), the part (B n) for that of the turn (B)."""
    return torch.take_along_dim(drawn, turn[:, None, None], 1).squeeze(1)
