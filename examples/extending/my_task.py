"""A task of your own: a point that a force pushes about a table, and what of its path may matter.

python ../../train.py task=my_task:Table task.steps=30
"""

import torch
from torch import Generator, Tensor

from torchrl_pref.tasks.base import Task


class Table(Task):
    """Paths of a point with random, slowly turning pushes.

    Args:
        steps: T, positions in a path.
    """

    feature_names = ("length", "height at the end", "nearest to the middle", "turns")

    def __init__(self, steps: int = 30) -> None:
        self.steps = steps

    def trajectories(self, count: int, seed: int) -> Tensor:
        """Positions (count T 2); the seed alone decides them."""
        generator = Generator().manual_seed(seed)
        pushes = 0.1 * torch.randn(count, self.steps, 2, generator=generator)
        start = torch.rand(count, 1, 2, generator=generator) - 0.5
        return start + pushes.cumsum(1).cumsum(1) / 4

    def features(self, trajectories: Tensor) -> Tensor:
        """(… 4), from positions (… T 2)."""
        moves = trajectories.diff(dim=-2)
        bends = moves.diff(dim=-2).norm(dim=-1)
        return torch.stack(
            [
                moves.norm(dim=-1).sum(-1),
                trajectories[..., -1, 1],
                trajectories.norm(dim=-1).amin(-1),
                bends.mean(-1),
            ],
            -1,
        )
