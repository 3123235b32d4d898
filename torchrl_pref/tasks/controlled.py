"""Tasks whose trajectories follow from controls, smoothly: their questions can be searched for by
gradient as well as drawn.

Shapes: U controls of a trajectory, T trajectory length, D features, ``…`` any leading dimensions.
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Generator, Tensor

from torchrl_pref.tasks.base import Task


class ControlledTask(Task):
    """A task with dynamics that are written in torch.

    ``features(roll_out(controls))`` is differentiable in the controls, and of their dtype and
    device.

    Attributes:
        low, high: (U), the least and the largest of each control.
    """

    low: Tensor
    high: Tensor

    @abstractmethod
    def roll_out(self, controls: Tensor) -> Tensor:
        """Trajectories (… T …) under controls (… U), which are not clipped."""

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: each control is drawn uniformly between its bounds."""
        return self.roll_out(self.draw(count, seed))

    def draw(self, count: int, seed: int) -> Tensor:
        """Controls (count U), each uniform between its bounds."""
        generator = Generator().manual_seed(seed)
        shares = torch.rand(count, len(self.low), generator=generator)
        return self.low + (self.high - self.low) * shares
