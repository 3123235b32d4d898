"""Logarithms, exponentials, cosines and sines for compiled loops: of several numbers at once, where
those of the library are computed one by one. Some are rounded to single precision, as they were
when the library's were taken: they decide where samples end up.

Shapes: n numbers.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchrl_pref.compiled import compiled

Array = np.ndarray[Any, np.dtype[Any]]


@compiled
def exp_minus(x: float) -> float:
    """exp(-x) of x from 0 on, with an error of at most 2·10⁻⁷: as (exp(-x/1024))^1024, which is
    computed for several x at once, and the library's exp is not."""
    x = min(x, 700.0) / 1024
    power = 1.0 - x + 0.5 * x * x
    for _ in range(10):
        power *= power
    return power


@compiled
def logs_of(numbers: Array) -> Array:
    """The logarithms (n) of numbers (n), to some 10⁻¹⁶, by the exponent and a series in the
    mantissa. The numbers are 0, infinite, NaN, or from 10⁻³⁰⁷ on."""
    bits = numbers.view(np.int64)
    mantissas = np.empty(len(bits), np.int64)
    for j in range(len(bits)):
        mantissas[j] = (bits[j] & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000
    mantissa, logs = mantissas.view(np.float64), np.empty(len(bits))
    for j in range(len(bits)):
        above = mantissa[j] > 1.4142135623730951
        near = mantissa[j] * (0.5 if above else 1.0)
        exponent = float((bits[j] >> 52) - 1023) + (1.0 if above else 0.0)
        t = (near - 1.0) / (near + 1.0)
        square = t * t
        series = ((1 / 21 * square + 1 / 19) * square + 1 / 17) * square + 1 / 15
        series = ((series * square + 1 / 13) * square + 1 / 11) * square + 1 / 9
        series = ((series * square + 1 / 7) * square + 1 / 5) * square + 1 / 3
        log = 2.0 * t * (series * square + 1.0) + exponent * 0.6931471805599453
        log = log if numbers[j] > 0 else -math.inf
        logs[j] = log if numbers[j] < math.inf else numbers[j]
    return logs


@compiled
def log_single(numbers: Array) -> None:
    """Put logarithms in single precision in the place of numbers (n); of zero a large negative
    number."""
    for j in range(len(numbers)):
        numbers[j] = np.float32(numbers[j] if numbers[j] > 1e-30 else 1e-30)
    logs = logs_of(numbers)
    for j in range(len(numbers)):
        numbers[j] = np.float32(logs[j])


@compiled
def cos_sin_single(angles: Array, cosine: Array, sine: Array) -> None:
    """Fill cosine and sine in single precision of angles (n) between -2π and 2π, several at once:
    by series, a quarter of a turn apart."""
    for j in range(len(angles)):
        angle = float(np.float32(angles[j]))
        quarter = np.floor(angle * 0.6366197723675814 + 0.5)
        x = angle - quarter * 1.5707963267948966
        square = x * x
        c = ((1 / 479001600 - square / 87178291200) * square - 1 / 3628800) * square + 1 / 40320
        c = (((c * square - 1 / 720) * square + 1 / 24) * square - 0.5) * square + 1.0
        s = ((1 / 6227020800 * square - 1 / 39916800) * square + 1 / 362880) * square - 1 / 5040
        s = (((s * square + 1 / 120) * square - 1 / 6) * square + 1.0) * x
        half = quarter - 2.0 * np.floor(quarter * 0.5)  # 1: cosine and sine change places
        side = 1.0 - 2.0 * np.abs(np.floor(quarter * 0.5) - 2.0 * np.floor(quarter * 0.25))
        cosine[j] = np.float32(side * (c if half == 0.0 else -s))
        sine[j] = np.float32(side * (s if half == 0.0 else c))
