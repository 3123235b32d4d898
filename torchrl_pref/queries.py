"""Query pools: N queries of K options with D features each.

Shapes: N queries, K options per query, D features, T trajectory length.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.features import check_features, corner_distances
from torchrl_pref.files import DTYPES, is_dense, load_safely, without_rest
from torchrl_pref.gridworld import random_walks
from torchrl_pref.writing import replacing


@dataclass(frozen=True)
class QueryPool:
    """A fixed set of queries to choose from.

    Attributes:
        features: (N K D) float32; a copy of what was given, without its gradients.
        trajectories: (N K T …), what a person would be shown, or None.

    Raises:
        InputError: the features are not (N, K ≥ 2, D ≥ 2) finite numbers, or the trajectories do
            not belong to them or are of a type that cannot be saved.
    """

    features: Tensor
    trajectories: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "features", check_features(self.features))
        if self.trajectories is not None:
            object.__setattr__(self, "trajectories", self._check_trajectories(self.trajectories))

    def _check_trajectories(self, shown: Any) -> Tensor:
        """The trajectories as a plain tensor, without gradients."""
        if not isinstance(shown, Tensor) or shown.layout != torch.strided:
            raise InputError(
                f"trajectories of type {type(shown).__name__}: expected a dense torch.Tensor; "
                "torch.as_tensor(…) makes one of an array or of lists, to_dense() of a sparse one"
            )
        if shown.dtype not in DTYPES or shown.is_meta:
            raise InputError(
                f"trajectories of {shown.dtype} on {shown.device}: expected plain numbers, which "
                "can be saved; convert them, as by .float()"
            )
        if shown.shape[:2] != self.features.shape[:2]:
            raise InputError(
                f"trajectories of shape {tuple(shown.shape)}: expected "
                f"{tuple(self.features.shape[:2])} as the first two sizes, those of the features"
            )
        return shown.detach().as_subclass(Tensor)

    def __len__(self) -> int:
        return len(self.features)

    @property
    def n_options(self) -> int:
        """K."""
        return self.features.shape[1]

    @property
    def n_features(self) -> int:
        """D."""
        return self.features.shape[2]

    @property
    def digest(self) -> str:
        """SHA-256 of the features and their shape, in hexadecimal: equal pools, equal digests."""
        content = self.features.contiguous().cpu().numpy()
        return hashlib.sha256(repr(content.shape).encode() + content.tobytes()).hexdigest()

    def map_features(self, function: Callable[[Tensor], Tensor]) -> QueryPool:
        """The same queries with other features, such as those of a ``Normalizer``."""
        return replace(self, features=function(self.features))

    def save(self, path: str | Path) -> None:
        """Write the pool to a file, whole or not at all."""
        shown = None if self.trajectories is None else without_rest(self.trajectories)
        content = {"features": without_rest(self.features), "trajectories": shown}
        save_atomically({"kind": "query pool", **content}, path)

    @classmethod
    def load(cls, path: str | Path) -> QueryPool:
        """Read a pool from a file. No pickled code is ever executed.

        Raises:
            InputError: the file is missing, cut off, spoiled, or not a query pool.
        """
        content = load_safely(path, "query pool")
        features: Any = content.get("features")
        shown: Any = content.get("trajectories")
        if not is_dense(features) or not (shown is None or is_dense(shown)):
            raise InputError(
                f"{path}: a query pool without features, or with what is no plain tensor; make it "
                "again with save()"
            )
        try:
            return cls(features, shown)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def gridworld_pool(
    n_queries: int = 1000, n_options: int = 2, size: int = 8, length: int = 20, seed: int = 0
) -> QueryPool:
    """The paper's pool: K random walks a query, mean distances to the corners, not normalised.

    Args:
        n_queries: N, at least 1.
        n_options: K, at least 2.
        size: cells along an edge of the Gridworld.
        length: T, cells in a walk.
        seed: fixes the pool.

    Raises:
        InputError: a number is below its minimum.
    """
    check_count("pool.size", n_queries, 1)
    check_count("pool.options", n_options, 2)
    walks = random_walks(n_queries * n_options, size, length, seed)
    features = corner_distances(walks, size)
    shape = (n_queries, n_options)
    return QueryPool(features.unflatten(0, shape), walks.unflatten(0, shape))


def save_atomically(content: dict[str, Any], path: str | Path) -> None:
    """Write plain data and tensors to a file, so that a reader never sees half of it.

    Raises:
        InputError: the file cannot be written.
    """
    path = Path(path)
    try:
        with replacing(path) as partial, partial.open("wb") as file:
            torch.save(content, file)
    except (OSError, RuntimeError) as error:  # torch reports a full disk as the latter
        raise InputError(
            f"{path}: cannot be written ({error}); free some space there, or name another folder"
        ) from error
