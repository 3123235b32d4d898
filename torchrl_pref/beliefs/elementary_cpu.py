"""Logarithms, exponentials, cosines and sines for compiled loops, in operations that take several
numbers at once, where those of the library are computed one by one. Some are rounded to single
precision, as they were when the library's were taken: they decide where samples end up.
"""

from __future__ import annotations

import math

import numpy as np

from torchrl_pref.compiled import compiled


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
def log(x: float) -> float:
    """The logarithm, to some 10⁻¹⁶, by the exponent and a series in the mantissa, of x that is 0,
    infinite, NaN, or from 10⁻³⁰⁷ on."""
    bits = np.float64(x).view(np.int64)
    mantissa = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    above = mantissa > 1.4142135623730951
    near = mantissa * (0.5 if above else 1.0)
    exponent = float((bits >> 52) - 1023) + (1.0 if above else 0.0)
    t = (near - 1.0) / (near + 1.0)
    square = t * t
    series = ((1 / 21 * square + 1 / 19) * square + 1 / 17) * square + 1 / 15
    series = ((series * square + 1 / 13) * square + 1 / 11) * square + 1 / 9
    series = ((series * square + 1 / 7) * square + 1 / 5) * square + 1 / 3
    finite = 2.0 * t * (series * square + 1.0) + exponent * 0.6931471805599453
    return (finite if x > 0 else -math.inf) if x < math.inf else x


@compiled
def log_single(x: float) -> float:
    """The logarithm in single precision, of zero a large negative number."""
    return float(np.float32(log(float(np.float32(x if x > 1e-30 else 1e-30)))))


@compiled
def cos_sin_single(x: float) -> tuple[float, float]:
    """Cosine and sine in single precision of an angle between -2π and 2π: by series, a quarter of a
    turn apart."""
    angle = float(np.float32(x))
    quarter = np.floor(angle * 0.6366197723675814 + 0.5)
    rest = angle - quarter * 1.5707963267948966
    square = rest * rest
    c = ((1 / 479001600 - square / 87178291200) * square - 1 / 3628800) * square + 1 / 40320
    c = (((c * square - 1 / 720) * square + 1 / 24) * square - 0.5) * square + 1.0
    s = ((1 / 6227020800 * square - 1 / 39916800) * square + 1 / 362880) * square - 1 / 5040
    s = (((s * square + 1 / 120) * square - 1 / 6) * square + 1.0) * rest
    half = quarter - 2.0 * np.floor(quarter * 0.5)  # 1: cosine and sine change places
    side = 1.0 - 2.0 * np.abs(np.floor(quarter * 0.5) - 2.0 * np.floor(quarter * 0.25))
    cosine, sine = side * (c if half == 0.0 else -s), side * (s if half == 0.0 else c)
    return float(np.float32(cosine)), float(np.float32(sine))
