"""Made-up trajectories that are their own features, with as many and as alike as one asks for.

Shapes: T = 1 step, D features, ``…`` any leading dimensions.
"""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from torchrl_pref.errors import InputError, check_between, check_count, check_seed
from torchrl_pref.tasks.base import Task

LARGEST_DIMENSION, LARGEST_SKEW = 1000, 1e6


class GaussianTask(Task):
    """Features from a Gaussian, to try strategies at any D and any correlation between features.

    The variances along its principal axes fall geometrically, and the axes are turned at random, so
    that no normalisation of single features makes them equal. The Gridworld's differences of
    features have a skew of about 50.

    Args:
        dimension: D, at least 2.
        skew: the largest variance over the smallest, at least 1, which is isotropic.
        axes: seeds how the axes are turned.

    Raises:
        InputError: a number is out of its range.
    """

    def __init__(self, dimension: int = 4, skew: float = 50.0, axes: int = 0) -> None:
        self.dimension = check_count("dimension", dimension, 2)
        if self.dimension > LARGEST_DIMENSION:
            raise InputError(
                f"dimension={dimension}: expected a whole number from 2 to {LARGEST_DIMENSION}"
            )
        self.skew = check_between("skew", skew, 1.0, LARGEST_SKEW)
        luck = Generator().manual_seed(check_seed("axes", axes))
        turned, _ = torch.linalg.qr(torch.randn(dimension, dimension, generator=luck))
        shares = torch.linspace(0, 1, dimension)
        self._root = turned * self.skew ** (-shares / 2)
        self.feature_names = tuple(f"feature {number + 1}" for number in range(dimension))

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: (count 1 D), the features themselves."""
        drawn = torch.randn(count, 1, self.dimension, generator=Generator().manual_seed(seed))
        return drawn @ self._root.mT

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`."""
        return trajectories.squeeze(-2)
