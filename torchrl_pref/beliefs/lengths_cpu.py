"""Moves of samples along their rays, of ``rationality.py``, compiled by Numba for the CPU.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, U
uniforms of a move, G rows of all the answers that a session has, E factors of these.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchrl_pref.beliefs.slice_cpu import _flatten, _products, _surprise
from torchrl_pref.compiled import compiled

SLICE_DIGEST = "b94f392f70ca"
"""The first digits of the SHA-256 of ``slice_cpu.py``: whoever changes that file has to change this
one, too, without which the machine code that is kept of it would not be made anew."""

Array = np.ndarray[Any, np.dtype[Any]]


@compiled
def stretch_sessions(
    first: int,
    last: int,
    omega: Array,
    uniform: Array,
    rows: Array,
    offsets: Array,
    floor: Array,
    scales: Array,
    slack: Array,
    power: Array,
    stretched: Array,
    deviation: float,
    end: float,
    tau: float,
) -> None:
    """Fill ``stretched`` (S M) with the lengths that samples get, see ``rationality.move_lengths``;
    ``end`` is the largest log-length."""
    for s in range(first, last):
        given = _flatten(rows[s], offsets[s], floor[s], float(slack[s]), tau)
        some = omega[s], scales[s], uniform[s], stretched[s]
        _stretch_session(*some, *given, float(power[s]), deviation, end)


@compiled
def _stretch_session(
    omega: Array,
    scales: Array,
    uniform: Array,
    stretched: Array,
    rows: Array,
    raised: Array,
    ends: Array,
    floors: Array,
    power: float,
    deviation: float,
    end: float,
) -> None:
    """Fill ``stretched`` (M) with new lengths of the samples of a session, whose directions are
    ``omega`` (M D) and whose lengths and floors are ``scales`` (2 M)."""
    n = len(omega)
    # As points of circles that do not turn: gaps are returns[0] · length + raised.
    returns, still = np.zeros((2, len(raised), n)), np.zeros(n)
    returns[0] = _products(rows, omega)
    here, ranges = np.empty(n), np.empty((2, n))
    for m in range(n):
        here[m] = min(max(math.log(scales[0, m]), -end), end)
        ranges[0, m], ranges[1, m] = -end, end
    place, odds, proposal = here.copy(), scales[1].copy(), here.copy()
    level = _surprise(returns, raised, ends, floors, odds, np.exp(here), still, False, 0.0)
    for m in range(n):
        level[m] = power * level[m] + _far(here[m], deviation)
        level[m] = min(level[m] - math.log1p(-uniform[m, 0]), 1e300)  # the impossible stays above
    left, refused = np.arange(n), np.empty(n, np.int64)
    for i in range(1, uniform.shape[1]):
        for j in range(n):
            low, high = ranges[0, left[j]], ranges[1, left[j]]
            proposal[j] = low + uniform[left[j], i] * (high - low)
        given = returns, raised, ends, floors, odds
        surprise = _surprise(*given, np.exp(proposal[:n]), still[:n], False, 0.0)
        n_tried, n = n, 0
        for j in range(n_tried):
            m = left[j]
            if power * surprise[j] + _far(proposal[j], deviation) <= level[m]:
                place[m] = proposal[j]
            else:
                ranges[int(proposal[j] > here[m]), m] = proposal[j]
                left[n], refused[n] = m, j
                n += 1
        if n == 0:
            break
        for j in range(n):
            odds[j] = odds[refused[j]]
        for g in range(len(raised)):
            for j in range(n):
                returns[0, g, j] = returns[0, g, refused[j]]
    for m in range(len(place)):
        stretched[m] = math.exp(place[m])


@compiled
def _far(log_length: float, deviation: float) -> float:
    """Minus the logarithm of the prior's density at a log-length, up to a number."""
    return 0.5 * (log_length / deviation) ** 2
