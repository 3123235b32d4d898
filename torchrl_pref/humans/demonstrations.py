"""Simulated humans who show trajectories before they are asked.

Shapes: B humans, G demonstrations each, J alternatives, D features.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.questions.prior_evidence import check_tau
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal


@dataclass(frozen=True)
class Demonstrations:
    """How much simulated humans show, and how carefully.

    Attributes:
        count: G, demonstrations of each human; 0 is none.
        alternatives: J, at least 1. Of J + 1 random trajectories the human shows the best, by a
            Boltzmann choice. With one alternative it is a correction: one of two is replaced.
        tau: by what the returns are multiplied; None: the tau of the answers.

    Raises:
        InputError: a number is out of range.
    """

    count: int = 0
    alternatives: int = 10
    tau: float | None = None

    def __post_init__(self) -> None:
        check_count("demonstrations.count", self.count, 0)
        check_count("demonstrations.alternatives", self.alternatives, 1)
        check_tau(self.tau)

    def draw(
        self,
        trajectories: Tensor,
        seen: Tensor,
        omega: Tensor,
        model: ResponseModel,
        generator: Generator,
    ) -> Tensor:
        """What humans show.

        Args:
            trajectories: (n D), features of all that there are; J + 1 are drawn anew each time.
            seen: (n D), the same as the humans see them.
            omega: (B D), the humans' weights.
            model: how the humans answer.
            generator: the source of all luck, on the device of the trajectories.

        Returns:
            (B G J D), the features of what was shown less those of the alternatives.

        Raises:
            InputError: there are no J + 1 trajectories.
        """
        if len(trajectories) <= self.alternatives:
            raise InputError(
                f"demonstrations.alternatives={self.alternatives} of {len(trajectories)} "
                "trajectories in the pool: expected fewer; lower it, or use a larger pool"
            )
        shape = (len(omega), self.count, self.alternatives + 1)
        index = different(shape, len(trajectories), generator)
        features, device = trajectories[index], generator.device
        returns = (seen[index] @ omega[:, None, :, None]).squeeze(-1)
        luck = torch.empty(shape, device=device).exponential_(generator=generator)
        errs = self.tau is not None or not isinstance(model, Optimal)
        by = Boltzmann(self.tau or model.scale) if errs else Optimal()
        best = (by(returns) - luck.clamp(min=1e-30).log()).argmax(-1, keepdim=True)
        shown = features.take_along_dim(best.unsqueeze(-1), -2)
        others = torch.arange(shape[-1], device=device) != best
        return shown - features[others].unflatten(0, (*shape[:2], self.alternatives))


def different(shape: tuple[int, ...], count: int, generator: Generator) -> Tensor:
    """Indices (… n) below a count, of which no two along the last dimension are the same.

    By Floyd's algorithm (Bentley, *Programming pearls*, 1987): every set is as likely as another.
    """
    *leading, size = shape
    chosen = torch.empty(shape, dtype=torch.int64, device=generator.device)
    for place, last in enumerate(range(count - size, count)):
        drawn = torch.randint(last + 1, leading, generator=generator, device=generator.device)
        taken = (chosen[..., :place] == drawn.unsqueeze(-1)).any(-1)
        chosen[..., place] = torch.where(taken, last, drawn)
    return chosen
