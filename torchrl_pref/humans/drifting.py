"""A simulated human who changes their mind while they are asked.

Shapes: B sessions, H query budget, K options per query, D features.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.errors import check_not_negative
from torchrl_pref.humans.simulated import SimulatedHuman, at_turn
from torchrl_pref.questions.response_model import ResponseModel


class Drifting(SimulatedHuman):
    """Their weights take a random walk on the unit sphere, a step after each question.

    ``omega`` is where the walk ends, at the last question: what the person wants when the robot has
    learned it. Alignment is judged against that, after however many answers. The walk is drawn
    backwards from there, which makes no difference to what it is like.

    Args:
        response_model: how they answer.
        drift: about how far the weights turn between two questions, in radians, at least 0. After
            n questions it is about drift·√n.

    Raises:
        InputError: the drift is below 0.
    """

    def __init__(self, response_model: ResponseModel, drift: float = 0.1) -> None:
        super().__init__(response_model)
        self.drift = check_not_negative("drift", drift)

    def draw(
        self, n_sessions: int, budget: int, n_answers: int, n_features: int, generator: Generator
    ) -> TensorDict:
        """See :meth:`SimulatedHuman.draw`; ``walk`` (B H D) is what is added to ``omega`` at each
        question, before it is brought back to length 1."""
        human = super().draw(n_sessions, budget, n_answers, n_features, generator)
        shape = (n_sessions, budget, n_features)
        steps = torch.randn(shape, generator=generator, device=generator.device)
        steps[:, -1] = 0
        human["walk"] = self.drift / math.sqrt(n_features - 1) * steps.flip(1).cumsum(1).flip(1)
        return human

    def respond(
        self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor], turn: Tensor
    ) -> Tensor:
        """See :meth:`HumanBase.respond`."""
        now = {key: human[key] for key in ("noise", "care")}
        omega = F.normalize(human["omega"] + at_turn(human["walk"], turn), dim=-1)
        return super().respond(queries, {**now, "omega": omega}, turn)
