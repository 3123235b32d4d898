"""Feature maps of trajectories, and the normaliser fitted on the training pool.

Shapes: ``…`` any leading dimensions (queries, options), T trajectory length, D features.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tensors import check_finite, check_plain


def corner_distances(positions: Tensor, size: int) -> Tensor:
    """The paper's four features (section 4.1): mean distance to each corner of the Gridworld.

    Args:
        positions: (… T 2), cells visited, from 0 to ``size`` - 1.
        size: cells along an edge.

    Returns:
        (… 4), Euclidean distances in cells, averaged over the trajectory.
    """
    edge = float(size - 1)
    corners = torch.tensor([[0.0, 0.0], [0.0, edge], [edge, 0.0], [edge, edge]])
    offsets = positions.float().unsqueeze(-2) - corners.to(positions.device)
    return offsets.norm(dim=-1).mean(-2)


def check_features(features: Tensor) -> Tensor:
    """Return the features of a pool as float32: a copy, without gradients.

    Raises:
        InputError: they are no plain real numbers, the shape is not (N, K ≥ 2, D ≥ 2), or a value
            is NaN, infinite, or beyond float32.
    """
    check_plain("features", features)
    shape = tuple(features.shape)
    if features.ndim != 3 or shape[0] < 1 or shape[1] < 2 or shape[2] < 2:
        raise InputError(
            f"features of shape {shape}: expected (N queries, K options, D features) with N at "
            "least 1, K at least 2 and D at least 2; reshape them or stack the options of a query"
        )
    # A copy: what is later written into the tensor that was given is not checked.
    single = features.detach().as_subclass(Tensor).to(torch.float32, copy=True).contiguous()
    for bad, what, mend in (
        (~features.isfinite(), "NaN or infinity", "finite numbers; remove or mend these queries"),
        (single.isinf(), "numbers beyond float32", "numbers up to 1e38; scale the features"),
        ((single == 0) & (features != 0), "numbers that are 0 in float32", "larger ones; scale"),
    ):
        broken = bad.flatten(1).any(1).nonzero().squeeze(-1)
        if broken.numel():
            raise InputError(
                f"features of {broken.numel()} of {shape[0]} queries hold {what} (first: "
                f"query {int(broken[0])}): expected {mend}"
            )
    return single


@dataclass(frozen=True)
class Normalizer:
    """Zero mean and unit variance, by the training pool's statistics (the paper's section 4.1).

    Attributes:
        mean: (D), mean of each feature over all training options.
        std: (D), standard deviation of each feature, in the feature's unit.
    """

    mean: Tensor
    std: Tensor

    @classmethod
    def fit(cls, features: Tensor) -> Normalizer:
        """Measure the statistics of raw features (… D).

        Raises:
            InputError: a feature is no finite number, or never varies, so that no scale makes its
                variance one.
        """
        check_finite("features", check_plain("features", features))
        flat = features.flatten(0, -2).double()
        mean, std = flat.mean(0), flat.std(0, correction=0)
        constant = (std <= 1e-6 * (1 + mean.abs())).nonzero().squeeze(-1).tolist()
        if constant:
            raise InputError(
                f"feature {', '.join(map(str, constant))} never varies over the training pool: "
                "expected features that differ between options; drop it, or use a larger pool"
            )
        return cls(mean.float(), std.float())

    def __call__(self, features: Tensor) -> Tensor:
        """Normalise raw features (… D).

        Raises:
            InputError: D is not the number of features that this was fitted on.
        """
        if features.shape[-1] != len(self.mean):
            raise InputError(
                f"features with D={features.shape[-1]}: expected D={len(self.mean)}, as in the "
                "training pool; use the feature map that the training pool was made with"
            )
        return (features - self.mean) / self.std


def balance(features: Tensor) -> Callable[[Tensor], Tensor]:
    """A linear map after which a pool's options differ equally in every direction.

    Some directions of ω show in hardly any query of a pool. After this map, fitted on the pool's
    features (N K D), the options of a query differ by the same variance in all D directions.

    Raises:
        InputError: a feature is no finite number, or the options do not differ in some direction
            at all.
    """
    check_finite("features", check_plain("features", features))
    gaps = (features - features.mean(1, keepdim=True)).flatten(0, 1).double()
    variances, directions = torch.linalg.eigh(gaps.mT @ gaps / len(gaps))
    if variances[0] <= 1e-10 * variances[-1]:
        raise InputError(
            "features cannot be balanced: the options of a query never differ in some direction; "
            "expected D linearly independent features; drop those that follow from the others"
        )
    matrix = (directions / variances.sqrt()) @ directions.mT
    return lambda raw: raw @ matrix.to(raw)
