"""Tensors that cannot be used, refused where they enter: what came, what was expected, how to mend.

Each check reads a tensor once and costs a few microseconds: they stand at the doors of the package
(a step, a reset, an update of the belief) and not in its inner loops.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.errors import InputError

LONGEST_NAME = 100
"""Letters of a feature's name."""

ROUNDING = 1e-5
"""A vector whose length is this near to 1 is of length 1."""


def lengths(vectors: Tensor) -> Tensor:
    """Lengths (… 1) of vectors (… D): exactly 1 of those that are of length 1 but for rounding."""
    length = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return torch.where((length - 1).abs() <= ROUNDING, 1.0, length)


def directions(vectors: Tensor) -> Tensor:
    """Unit vectors (… D) along vectors (… D): themselves, to the last bit, where they are such."""
    return vectors / lengths(vectors).clamp(min=1e-30)


def as_whole(value: Any) -> Any:
    """Numbers of NumPy and torch as Python's own, and arrays of them as lists; anything else as it
    is."""
    known = isinstance(value, (np.ndarray, np.generic)) and not np.ma.isMaskedArray(value)
    if known or (isinstance(value, Tensor) and not value.is_meta):
        return value.tolist()
    return value


def check_plain(name: str, tensor: Any) -> Tensor:
    """Return ``tensor`` if it is a dense one of real numbers, with values.

    Raises:
        InputError: it is not.
    """
    if not isinstance(tensor, Tensor):
        raise InputError(
            f"{name} of type {type(tensor).__name__}: expected a torch.Tensor; "
            "torch.as_tensor(…) makes one of an array or of lists"
        )
    for bad, what, mend in (
        (tensor.is_complex(), "complex numbers", "take .real or .abs()"),
        (tensor.is_quantized, "quantised numbers", "call .dequantize()"),
        (tensor.is_nested, "a nested tensor", "pad it, as by .to_padded_tensor(0)"),
        (tensor.is_sparse or "sparse" in str(tensor.layout), "a sparse tensor", "call .to_dense()"),
        (tensor.is_meta, "a tensor without values (meta)", "make it on a device"),
    ):
        if bad:
            raise InputError(f"{name}: got {what}; expected a dense tensor of real numbers; {mend}")
    return tensor


def check_finite(name: str, *tensors: Tensor) -> None:
    """Refuse NaN and infinity in any of some tensors.

    Raises:
        InputError: there is one.
    """
    # One entry that is not finite makes the sum so: a single number to look at for each tensor.
    if not math.isfinite(sum(float(tensor.detach().sum()) for tensor in tensors)):
        raise InputError(
            f"{name}: NaN, infinity or a number too large for float32; expected finite numbers; "
            "look where they were made"
        )


def check_range(name: str, values: Any, low: int, high: int, meaning: str) -> Tensor:
    """Return a tensor of whole numbers, as int64, if all are from ``low`` to ``high``.

    Args:
        name: of the numbers, for the message.
        values: the tensor; truth values count as 0 and 1.
        low, high: both allowed.
        meaning: what the numbers are, for the message.

    Raises:
        InputError: the values are no whole numbers, or one is out of range.
    """
    if not isinstance(values, Tensor) or values.is_floating_point() or values.is_complex():
        kind = f"dtype {values.dtype}" if isinstance(values, Tensor) else type(values).__name__
        raise InputError(
            f"{name} of {kind}: expected a tensor of whole numbers from {low} to {high}, {meaning}"
        )
    if values.numel():
        least, most = values.aminmax()
        if int(least) < low or int(most) > high:
            raise InputError(
                f"{name} from {int(least)} to {int(most)}: expected {low} to {high}, {meaning}"
            )
    return values.long()


def check_default_dtype() -> None:
    """Refuse to begin where torch makes tensors of another type than this package computes in.

    Raises:
        InputError: torch's default is not ``float32``.
    """
    if torch.get_default_dtype() != torch.float32:
        raise InputError(
            f"torch's default type is {torch.get_default_dtype()}: expected torch.float32, that of "
            "beliefs, humans and policies; call torch.set_default_dtype(torch.float32)"
        )


def check_shape(name: str, tensor: Tensor, expected: tuple[int, ...], meaning: str) -> None:
    """Refuse a tensor of another shape.

    Raises:
        InputError: the shape is not the one expected.
    """
    if tuple(tensor.shape) != tuple(expected):
        raise InputError(
            f"{name} of shape {tuple(tensor.shape)}: expected {tuple(expected)}, {meaning}"
        )


def default_names(n_features: int) -> tuple[str, ...]:
    """What features are called where nobody named them."""
    return tuple(f"feature {number}" for number in range(1, n_features + 1))


def check_names(names: Any, n_features: int) -> tuple[str, ...]:
    """Return the names of D features as a tuple.

    Raises:
        InputError: they are not D different texts of one line.
    """
    if not isinstance(names, (list, tuple)) or len(names) != n_features:
        count = len(names) if isinstance(names, (list, tuple)) else type(names).__name__
        raise InputError(f"feature_names: {count} for {n_features} features; expected one of each")
    for name in names:
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= LONGEST_NAME:
            raise InputError(
                f"feature_names: {name!r:.80}; expected texts of one line and at most "
                f"{LONGEST_NAME} letters; rename it"
            )
    if len(set(names)) < n_features:
        raise InputError(f"feature_names: {names!s:.200} names one twice; rename one")
    return tuple(names)
