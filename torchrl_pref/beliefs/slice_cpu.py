"""The Markov moves of ``slice.py`` compiled by Numba for the CPU: each session by itself.

A sample that has found its place costs nothing more, a session's numbers never leave the cache, and
a call for one session costs a hundredth of one for a hundred. Innermost loops run over samples, so
that the processor takes several at once. The first call on a new machine takes some seconds.

A move needs of ω only its return gaps: they turn with ω, and all samples of a group move towards
one pole, so that a move costs as much for many features as for few.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, V
moves, P sets of samples that share a pole, U uniforms of a move, G rows of all the answers that a
session has, E factors of these.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchrl_pref.beliefs.elementary_cpu import cos_sin_single, exp_minus, log, log_single
from torchrl_pref.compiled import compiled

ELEMENTARY_DIGEST = "898406cc5808"
"""The first digits of the SHA-256 of ``elementary_cpu.py``: whoever changes that file has to change
this one, too, without which the machine code that is kept of it would not be made anew."""

Array = np.ndarray[Any, np.dtype[Any]]


@compiled
def move_sessions(
    first: int,
    last: int,
    samples: Array,
    poles: Array,
    uniform: Array,
    rows: Array,
    offsets: Array,
    floor: Array,
    scales: Array,
    slack: Array,
    power: Array,
    moved: Array,
    arc: float,
    tau: float,
    tolerance: float,
) -> None:
    """Fill ``moved`` (S M D)."""
    hard = math.isinf(tau)
    for s in range(first, last):
        unit = 1.0 if hard else tau
        given = _flatten(rows[s], offsets[s], floor[s], float(slack[s]), unit)
        constants = float(power[s]), arc, hard, tolerance
        some = samples[s], scales[s], poles[:, s], uniform[:, s], moved[s]
        _move_session(*some, *given, *constants)


@compiled
def _flatten(
    rows: Array, offsets: Array, floor: Array, slack: float, unit: float
) -> tuple[Array, Array, Array, Array]:
    """The evidence (H F J D) that there is, in units of 1/tau.

    Returns:
        Rows (G D), by how much their returns are raised (G), where each factor ends among the rows
        (E), and the floor of the answer that ends with a factor (E), -1 where none does.
    """
    n_answers, n_factors, n_rows, n_features = rows.shape
    size = n_answers * n_factors
    flat, raised = np.empty((size * n_rows, n_features)), np.empty(size * n_rows)
    ends, floors = np.empty(size, np.int64), np.empty(size)
    g = e = 0
    for h in range(n_answers):
        newest = h == n_answers - 1
        if not newest and not np.any(rows[h]):  # open, or about options that are alike
            continue
        for f in range(n_factors):
            before = g
            for j in range(n_rows):
                if offsets[h, f, j] < math.inf:
                    flat[g] = unit * rows[h, f, j]
                    raised[g] = unit * (offsets[h, f, j] + (slack if newest else 0.0))
                    g += 1
            if g > before:
                ends[e], floors[e] = g, -1.0
                e += 1
        if e > 0:
            floors[e - 1] = floor[h]
    return flat[:g], raised[:g], ends[:e], floors[:e]


@compiled
def _move_session(
    samples: Array,
    scales: Array,
    poles: Array,
    uniform: Array,
    moved: Array,
    rows: Array,
    raised: Array,
    ends: Array,
    floors: Array,
    power: float,
    arc: float,
    hard: bool,
    tolerance: float,
) -> None:
    """Fill ``moved`` (M D) with where V moves take the samples (M D) of a session, whose gaps and
    floors count by ``scales`` (2 M)."""
    n_samples, n_features = samples.shape
    places = np.empty((n_features, n_samples))
    for m in range(n_samples):
        # Of unit length in float64: a circle through the pole nearby is told by the rounding else.
        norm = 0.0
        for d in range(n_features):
            norm += float(samples[m, d]) ** 2
        for d in range(n_features):
            places[d, m] = samples[m, d] / math.sqrt(norm)
    gaps = np.zeros((len(raised), n_samples))
    for g in range(len(raised)):
        for d in range(n_features):
            row = rows[g, d]
            for m in range(n_samples):
                gaps[g, m] += row * places[d, m]
    scaled = np.any(scales[0] != 1)
    # At an angle on a circle the gaps are circles[0] cos(angle) + circles[1] sin(angle) + raised.
    circles = np.empty((2, len(raised), n_samples))
    for v in range(len(poles)):
        along, height, pole, arcs = _aim(places, poles[v], uniform[v], arc)
        ahead = _products(poles[v], rows)
        circles[0] = gaps
        _turn_gaps(gaps, circles[1], ahead, along, height)
        if scaled:
            circles *= scales[0]
        given = circles, raised, ends, floors, scales[1], pole, arcs, uniform[v], power
        turn = _search(*given, n_features - 2, hard, tolerance)
        cosine, sine = np.cos(turn), np.sin(turn)
        for m in range(n_samples):
            sine[m] /= height[m]
            cosine[m] -= along[m] * sine[m]  # of the place itself
        for p in range(poles.shape[1]):
            first, last = _group(p, poles.shape[1], n_samples)
            for d in range(n_features):
                for m in range(first, last):
                    places[d, m] = places[d, m] * cosine[m] + poles[v, p, d] * sine[m]
            for g in range(len(raised)):
                for m in range(first, last):
                    gaps[g, m] = gaps[g, m] * cosine[m] + ahead[p, g] * sine[m]
    for m in range(n_samples):
        norm = 0.0
        for d in range(n_features):
            norm += places[d, m] * places[d, m]
        for d in range(n_features):
            moved[m, d] = places[d, m] / math.sqrt(norm)


@compiled
def _group(p: int, n_groups: int, n_samples: int) -> tuple[int, int]:
    """First sample of a group, and the first of the next."""
    return -(-p * n_samples // n_groups), -(-(p + 1) * n_samples // n_groups)


@compiled
def _products(poles: Array, rows: Array) -> Array:
    """Return gaps (P G) of poles (P D)."""
    products = np.zeros((len(poles), len(rows)))
    for p in range(len(poles)):
        for g in range(len(rows)):
            for d in range(rows.shape[1]):
                products[p, g] += rows[g, d] * poles[p, d]
    return products


@compiled
def _turn_gaps(gaps: Array, sideways: Array, ahead: Array, along: Array, height: Array) -> None:
    """Fill ``sideways`` (G M) with the gaps of the tangents, from those of the places (G M) and of
    the poles (P G)."""
    n_samples = gaps.shape[1]
    for p in range(len(ahead)):
        first, last = _group(p, len(ahead), n_samples)
        for g in range(len(gaps)):
            for m in range(first, last):
                sideways[g, m] = (ahead[p, g] - along[m] * gaps[g, m]) / height[m]


@compiled
def _aim(
    places: Array, poles: Array, uniform: Array, arc: float
) -> tuple[Array, Array, Array, Array]:
    """How far the places (D M) are along their pole, the length of the rest of it (M), cosine and
    sine of the angle to it (2 M), and the ends of the arc (2 M)."""
    n_features, n_samples = places.shape
    along, height = np.zeros(n_samples), np.empty(n_samples)
    pole, ends = np.empty((2, n_samples)), np.empty((2, n_samples))
    for p in range(len(poles)):
        first, last = _group(p, len(poles), n_samples)
        square = 0.0
        for d in range(n_features):
            ahead = poles[p, d]
            square += ahead * ahead
            for m in range(first, last):
                along[m] += ahead * places[d, m]
        length = math.sqrt(square)
        # Of two features there is but one circle, and going round it reaches every mode.
        width = min(arc * length, 2 * math.pi) if n_features > 2 else 2 * math.pi
        for m in range(first, last):
            height[m] = max(math.sqrt(max(square - along[m] * along[m], 0.0)), 1e-20)
            pole[0, m], pole[1, m] = along[m] / length, height[m] / length
            ends[1, m] = uniform[m, 0] * width
            ends[0, m] = ends[1, m] - width
    return along, height, pole, ends


@compiled
def _search(
    circles: Array,
    raised: Array,
    ends: Array,
    floors: Array,
    odds: Array,
    pole: Array,
    arcs: Array,
    uniform: Array,
    power: float,
    meridians: int,
    hard: bool,
    tolerance: float,
) -> Array:
    """Angles (M) in the slices: proposals on the arcs, which shrink to each one that is refused."""
    n = circles.shape[2]
    turn, angle, cosine, sine = np.zeros(n), np.empty(n), np.ones(n), np.zeros(n)
    lapses = np.any(floors > 0)
    odds = odds.copy() if lapses else odds
    level = _surprise(circles, raised, ends, floors, odds, cosine, sine, hard, tolerance)
    for m in range(n):
        level[m] = power * level[m] - meridians * log_single(abs(pole[1, m]))
        level[m] -= log_single(1.0 - uniform[m, 1])
        level[m] = min(level[m], 1e300)  # the impossible stays above
    if hard and not lapses:
        _cut_arcs(arcs, circles, raised, tolerance)
    left, refused, meridian = np.arange(n), np.empty(n, np.int64), np.empty(n)
    for i in range(2, uniform.shape[1]):
        for j in range(n):
            m = left[j]
            angle[j] = arcs[0, m] + uniform[m, i] * (arcs[1, m] - arcs[0, m])
        for j in range(n):
            cosine[j], sine[j] = cos_sin_single(angle[j])
        given = circles, raised, ends, floors, odds, cosine[:n], sine[:n]
        surprise = _surprise(*given, hard, tolerance)
        for j in range(n):
            m = left[j]
            meridian[j] = log_single(abs(pole[1, m] * cosine[j] - pole[0, m] * sine[j]))
        n_tried, n = n, 0
        for j in range(n_tried):
            m = left[j]
            if power * surprise[j] <= level[m] + meridians * meridian[j]:
                turn[m] = angle[j]
            else:
                arcs[int(angle[j] > 0), m] = angle[j]
                left[n], refused[n] = m, j
                n += 1
        if n == 0:
            break
        for j in range(n if lapses else 0):
            odds[j] = odds[refused[j]]
        for g in range(len(raised)):
            for j in range(n):
                circles[0, g, j] = circles[0, g, refused[j]]
                circles[1, g, j] = circles[1, g, refused[j]]
    return turn


@compiled
def _cut_arcs(arcs: Array, circles: Array, raised: Array, tolerance: float) -> None:
    """Cut arcs with these ends (2 M) to where answers without error are possible, see
    ``response_model.ResponseModel.possible_arc``."""
    n_samples = circles.shape[2]
    # Of one over the tangent of half an angle, as far as each end may go.
    above, below = np.full(n_samples, -math.inf), np.full(n_samples, -math.inf)
    for g in range(len(raised)):
        c = raised[g] + tolerance
        for m in range(n_samples):
            p, q = circles[0, g, m], circles[1, g, m]
            square = q * q + p * p - c * c
            root = math.sqrt(max(square, 0.0))
            room = max(p + c, 1e-300)
            above[m] = max(above[m], (root - q) / room if square > 0 else -math.inf)
            below[m] = max(below[m], (root + q) / room if square > 0 else -math.inf)
    for m in range(n_samples):
        arcs[0, m] = max(arcs[0, m], -2 * math.atan2(1.0, below[m]))
        arcs[1, m] = min(arcs[1, m], 2 * math.atan2(1.0, above[m]))


@compiled
def _surprise(
    circles: Array,
    raised: Array,
    ends: Array,
    floors: Array,
    odds: Array,
    cosine: Array,
    sine: Array,
    hard: bool,
    tolerance: float,
) -> Array:
    """Minus the log-likelihood (n) of all answers, at a point of each of the first n circles."""
    n = len(cosine)
    total, product = np.zeros(n), np.ones(n)  # the result is total + log(product)
    before, highest, terms = np.zeros(n), np.empty(n), np.empty(n)
    start, lapses = 0, np.any(floors > 0)
    for e in range(len(ends)):
        for j in range(n):
            highest[j], terms[j] = 0.0, 1.0
        for g in range(start, ends[e]):
            for j in range(n):
                gap = circles[0, g, j] * cosine[j] + circles[1, g, j] * sine[j] + raised[g]
                if hard:
                    highest[j] = math.inf if gap < -tolerance else highest[j]
                    terms[j] += 1.0 if gap <= tolerance else 0.0
                else:  # terms · exp(highest) is the sum of exp(-gap), and of one
                    ratio = exp_minus(abs(gap + highest[j]))
                    terms[j] = terms[j] * ratio + 1.0 if -gap > highest[j] else terms[j] + ratio
                    highest[j] = max(highest[j], -gap)
        start = ends[e]
        for j in range(n):
            total[j] += highest[j]
            product[j] *= terms[j]
        if e % 100 == 99 or (lapses and floors[e] >= 0):  # before the product overflows
            for j in range(n):
                total[j], product[j] = total[j] + log(product[j]), 1.0
        if floors[e] > 0:  # the floor is added to what this answer alone is likely
            for j in range(n):
                terms[j] = math.exp(before[j] - total[j]) + floors[e] * odds[j]
            for j in range(n):
                total[j] = before[j] - log(terms[j])
        if lapses and floors[e] >= 0:
            for j in range(n):
                before[j] = total[j]
    for j in range(n):
        total[j] += log(product[j])
    return total
