"""A simulated human of your own: one who tires, and answers more and more at random.

    python ../../train.py human=my_human:Tiring human.patience=10

The belief is not told, unless you set belief.lapse.
"""

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions.response_model import ResponseModel


class Tiring(HumanBase):
    """Answers at random with a probability that is a half after so many questions.

    Args:
        response_model: how they answer while they are awake.
        patience: questions after which every second answer is random.
    """

    def __init__(self, response_model: ResponseModel, patience: float = 20.0) -> None:
        self.response_model, self.patience = response_model, patience
        self.awake = SimulatedHuman(response_model)

    def draw(
        self, n_sessions: int, budget: int, n_answers: int, n_features: int, generator: Generator
    ) -> TensorDict:
        """Their weights and all their luck, so that every strategy meets the same human."""
        human = self.awake.draw(n_sessions, budget, n_answers, n_features, generator)
        shape = (n_sessions, budget)
        human["nods"] = torch.rand(shape, generator=generator, device=generator.device)
        human["guess"] = torch.randint(
            n_answers, shape, generator=generator, device=generator.device
        )
        return human

    def respond(
        self, queries: Tensor, human: TensorDictBase | Mapping[str, Tensor], turn: Tensor
    ) -> Tensor:
        """(B), index of the answer."""
        answer = self.awake.respond(queries, human, turn)
        nods, guess = (human[key].gather(1, turn[:, None]).squeeze(1) for key in ("nods", "guess"))
        asleep = nods < turn / (turn + self.patience)
        return torch.where(asleep, guess, answer)
