"""Query pools: N queries of K options with D features each.

Shapes: N queries, K options per query, D features, T trajectory length.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.storage.files import DTYPES, is_dense, load_safely, without_rest
from torchrl_pref.storage.writing import replacing
from torchrl_pref.tensors import (
    check_default_dtype,
    check_finite,
    check_names,
    check_plain,
    default_names,
)


@dataclass(frozen=True)
class QueryPool:
    """A fixed set of queries to choose from.

    Attributes:
        features: (N K D) float32; a copy of what was given, without its gradients.
        trajectories: (N K T …), what a person would be shown, or None.
        feature_names: D, what each feature is called; by default ``feature 1`` and so on.

    Raises:
        InputError: the features are not (N, K ≥ 1, D ≥ 2) finite numbers, or the trajectories or
            the names do not belong to them or cannot be saved.
    """

    features: Tensor
    trajectories: Tensor | None = None
    feature_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_default_dtype()
        object.__setattr__(self, "features", check_features(self.features))
        names = self.feature_names or default_names(self.n_features)
        object.__setattr__(self, "feature_names", check_names(names, self.n_features))
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

    def __reduce__(self) -> tuple[Any, ...]:
        """By value: torch would put the features of a pool that is on its way to another process
        into shared memory, of which a container may have little."""
        where = self.features.device
        content = self.features.numpy(force=True), where, self.trajectories, self.feature_names
        return _unreduced, content

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
        """The same queries with other features; those of a ``Normalizer`` keep their names."""
        names = self.feature_names if isinstance(function, Normalizer) else ()
        return replace(self, features=function(self.features), feature_names=names)

    def save(self, path: str | Path) -> None:
        """Write the pool to a file, whole or not at all."""
        shown = None if self.trajectories is None else without_rest(self.trajectories)
        content = {"features": without_rest(self.features), "trajectories": shown}
        names = list(self.feature_names)
        save_atomically({"kind": "query pool", **content, "feature_names": names}, path)

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
            # Files of earlier versions have no names.
            return cls(features, shown, content.get("feature_names", ()))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None


def _unreduced(
    features: np.ndarray[Any, Any],
    device: torch.device,
    trajectories: Tensor | None,
    names: tuple[str, ...],
) -> QueryPool:
    """What :meth:`QueryPool.__reduce__` was called on."""
    return QueryPool(torch.from_numpy(features).to(device), trajectories, names)


def check_alike(train: QueryPool, test: QueryPool) -> None:
    """Refuse a test pool that another number of features describes than the training pool, or
    features of other names; a pool without names may have any.

    Raises:
        InputError: they do not belong together.
    """
    names = train.feature_names, test.feature_names
    if train.n_features != test.n_features:
        raise InputError(
            f"pool.test with D={test.n_features}: expected D={train.n_features} features, as in "
            "the training pool; use the feature map that the training pool was made with"
        )
    if names[0] != names[1] and default_names(train.n_features) not in names:
        own, other = (", ".join(each)[:200] for each in names)
        raise InputError(
            f"pool.test has the features {other}, and the training pool {own}: expected the same, "
            "in the same order; bring those of pool.test into this order, or save it without names"
        )


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


def check_features(features: Tensor) -> Tensor:
    """Return the features of a pool as float32: a copy, without gradients.

    Raises:
        InputError: they are no plain real numbers, the shape is not (N, K ≥ 1, D ≥ 2), or a value
            is NaN, infinite, or beyond float32.
    """
    check_plain("features", features)
    shape = tuple(features.shape)
    if features.ndim != 3 or shape[0] < 1 or shape[1] < 1 or shape[2] < 2:
        raise InputError(
            f"features of shape {shape}: expected (N queries, K options, D features) with N at "
            "least 1, K at least 1 and D at least 2; reshape them or stack the options of a query"
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
    def fit(cls, features: Tensor, names: tuple[str, ...] = ()) -> Normalizer:
        """Measure the statistics of raw features (… D).

        Args:
            features: (… D).
            names: D, for messages.

        Raises:
            InputError: there are none, one is no finite number or beyond float32, or one never
                varies, or too little for float32, so that no scale makes its variance one. What
                varies by rounding alone is not told from a feature in small units.
        """
        if not check_plain("features", features).float().isfinite().all():
            raise InputError(
                "features: NaN, infinity or a number too large for float32; expected finite numbers"
                " up to 1e38; mend or scale them"
            )
        if features.ndim < 2 or not features.numel():
            raise InputError(
                f"features of shape {tuple(features.shape)}: expected some, with the D features of "
                "a trajectory last"
            )
        flat = features.detach().flatten(0, -2).double()
        mean, std = flat.mean(0), flat.std(0, correction=0)
        names = names or default_names(len(std))
        low, high = flat.aminmax(dim=0)
        for bad, what, mend in (
            (
                low == high,
                "never varies over the pool",
                "drop it (of a file: task.columns=[…] with the others), or use a larger pool",
            ),
            (
                std <= 1e-6 * mean.abs(),
                "varies by less than a millionth of its mean over the pool, which float32 "
                "hardly tells",
                "subtract a constant where the feature is made, in float64, or drop it",
            ),
            (std.float() == 0, "is 0 in float32", "give it in a smaller unit"),
        ):
            if bad.any():
                which = ", ".join(names[place] for place in bad.nonzero().squeeze(-1).tolist())
                raise InputError(
                    f"{which} {what}: expected features that differ between options; {mend}"
                )
        return cls(mean.float(), std.float())

    def save(self, path: str | Path) -> None:
        """Write the normaliser to a file, whole or not at all."""
        content = {"mean": without_rest(self.mean), "std": without_rest(self.std)}
        save_atomically({"kind": "normalizer", **content}, path)

    @classmethod
    def load(cls, path: str | Path) -> Normalizer:
        """Read a normaliser from a file. No pickled code is ever executed.

        Raises:
            InputError: the file is missing, cut off, spoiled, or not a normaliser.
        """
        content = load_safely(path, "normalizer")
        mean: Any = content.get("mean")
        std: Any = content.get("std")
        for value in (mean, std):
            if not is_dense(value) or value.dtype != torch.float32 or value.ndim != 1:
                raise InputError(
                    f"{path}: a normaliser without the mean and the deviation of each feature; "
                    "make it again with save()"
                )
        if mean.shape != std.shape or not (mean.isfinite() & std.isfinite() & (std > 0)).all():
            raise InputError(
                f"{path}: a normaliser whose numbers no features can have: expected as many means "
                "as deviations, finite, and these above 0; make it again with save()"
            )
        return cls(mean, std)

    def __call__(self, features: Tensor) -> Tensor:
        """Normalise raw features (… D).

        Raises:
            InputError: they are no tensor, or D is not what this was fitted on.
        """
        check_plain("features", features)
        size = features.shape[-1] if features.ndim else 0
        if size != len(self.mean):
            raise InputError(
                f"features with D={size}: expected D={len(self.mean)}, as in the training pool; "
                "use the feature map that the training pool was made with"
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
