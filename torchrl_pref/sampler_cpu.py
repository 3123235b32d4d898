"""The Markov step of ``sampler.py`` compiled by Numba for the CPU: one session after the other.

A sample that has found its place costs nothing more, a session's numbers never leave the cache, and
a call for one session costs a hundredth of one for a hundred. Innermost loops run over samples, so
that the processor takes several at once. The first call on a new machine takes some seconds.

Shapes: S sessions, M samples, H answers, K options per query, D features, U uniforms of a step,
G = h (K-1) return gaps of the h answers that a session has.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.compiled import compiled

Array = np.ndarray[Any, np.dtype[Any]]


def compiled_step(
    samples: Tensor,
    poles: Tensor,
    answers: Tensor,
    slack: Tensor,
    uniform: Tensor,
    arc: float,
    tau: float,
    tolerance: float,
) -> Tensor:
    """``sampler.great_circle_step`` with its uniforms given, for Boltzmann and optimal humans.

    Args:
        samples, poles: (S M D).
        answers: (S H K-1 D).
        slack: (S).
        uniform: (S M U), in [0, 1): two, and one for each shrink.
        arc: length of the arc that is searched, in lengths of the pole.
        tau: what the gaps are multiplied by; infinite for answers without error.
        tolerance: of answers without error: gaps this small are ties.

    Returns:
        (S M D), unit vectors.
    """
    moved = torch.empty_like(samples, memory_format=torch.contiguous_format)
    arrays = [t.contiguous().numpy() for t in (samples, poles, answers, slack, uniform, moved)]
    _move_sessions(*arrays, arc, tau, tolerance)
    return moved


@compiled
def _move_sessions(
    samples: Array,
    poles: Array,
    answers: Array,
    slack: Array,
    uniform: Array,
    moved: Array,
    arc: float,
    tau: float,
    tolerance: float,
) -> None:
    """Fill ``moved`` (S M D)."""
    n_answers, n_others, n_features = answers.shape[1:]
    hard = math.isinf(tau)
    unit = 1.0 if hard else tau  # gaps are in units of 1/tau
    rows = np.empty((n_features, n_answers * n_others))
    raised = np.empty(rows.shape[1])
    for s in range(len(samples)):
        g = 0
        for h in range(n_answers):
            newest = h == n_answers - 1
            if newest or np.any(answers[s, h]):
                for k in range(n_others):
                    rows[:, g] = unit * answers[s, h, k]
                    raised[g] = unit * slack[s] if newest else 0.0
                    g += 1
        session = samples[s], poles[s], uniform[s], moved[s]
        _move(*session, rows[:, :g], raised[:g], arc, n_others, hard, tolerance)


@compiled
def _move(
    samples: Array,
    poles: Array,
    uniform: Array,
    moved: Array,
    rows: Array,
    raised: Array,
    arc: float,
    n_others: int,
    hard: bool,
    tolerance: float,
) -> None:
    """Fill ``moved`` (M D) with where the slice sampler takes the samples (M D) of a session."""
    n_samples, n_features = samples.shape
    tangents, pole, ends = _aim(samples, poles, uniform, arc)
    # At an angle on a circle the gaps are circles[0] cos(angle) + circles[1] sin(angle) + raised.
    circles = np.zeros((2, len(raised), n_samples))
    for d in range(n_features):
        at, ahead = samples[:, d].copy(), tangents[:, d].copy()
        for g in range(len(raised)):
            for m in range(n_samples):
                circles[0, g, m] += rows[d, g] * at[m]
                circles[1, g, m] += rows[d, g] * ahead[m]
    turn = _search(circles, raised, pole, ends, uniform, n_features - 2, n_others, hard, tolerance)
    for m in range(n_samples):
        cosine, sine = math.cos(np.float32(turn[m])), math.sin(np.float32(turn[m]))
        norm = 0.0
        for d in range(n_features):
            tangents[m, d] = samples[m, d] * cosine + tangents[m, d] * sine
            norm += tangents[m, d] * tangents[m, d]
        for d in range(n_features):
            moved[m, d] = tangents[m, d] / math.sqrt(norm)


@compiled
def _aim(samples: Array, poles: Array, uniform: Array, arc: float) -> tuple[Array, Array, Array]:
    """Tangents (M D), cosine and sine of the angle to the pole (2 M), ends of the arc (2 M)."""
    n_samples, n_features = samples.shape
    tangents = np.empty((n_samples, n_features))
    pole, ends = np.empty((2, n_samples)), np.empty((2, n_samples))
    for m in range(n_samples):
        along = length = height = 0.0
        for d in range(n_features):
            along += poles[m, d] * samples[m, d]
            length += poles[m, d] * poles[m, d]
        for d in range(n_features):
            tangents[m, d] = poles[m, d] - along * samples[m, d]
            height += tangents[m, d] * tangents[m, d]
        height, length = max(math.sqrt(height), 1e-20), math.sqrt(length)
        for d in range(n_features):
            tangents[m, d] /= height
        pole[0, m], pole[1, m] = along / length, height / length
        width = min(arc * length, 2 * math.pi)
        ends[1, m] = uniform[m, 0] * width
        ends[0, m] = ends[1, m] - width
    return tangents, pole, ends


@compiled
def _search(
    circles: Array,
    raised: Array,
    pole: Array,
    ends: Array,
    uniform: Array,
    power: int,
    n_others: int,
    hard: bool,
    tolerance: float,
) -> Array:
    """Angles (M) in the slices: proposals on the arcs, which shrink to each one that is refused."""
    n = circles.shape[2]
    turn, angle, cosine, sine = np.zeros(n), np.empty(n), np.ones(n), np.zeros(n)
    level = _surprise(circles, raised, cosine, sine, n_others, hard, tolerance)
    for m in range(n):
        level[m] -= power * _log(abs(pole[1, m])) + _log(1.0 - uniform[m, 1])
        level[m] = min(level[m], 1e300)  # the impossible stays above
    left, refused = np.arange(n), np.empty(n, np.int64)
    for i in range(2, uniform.shape[1]):
        for j in range(n):
            m = left[j]
            angle[j] = ends[0, m] + uniform[m, i] * (ends[1, m] - ends[0, m])
            cosine[j], sine[j] = math.cos(np.float32(angle[j])), math.sin(np.float32(angle[j]))
        surprise = _surprise(circles, raised, cosine[:n], sine[:n], n_others, hard, tolerance)
        n_tried, n = n, 0
        for j in range(n_tried):
            m = left[j]
            meridian = abs(pole[1, m] * cosine[j] - pole[0, m] * sine[j])
            if surprise[j] <= level[m] + power * _log(meridian):
                turn[m] = angle[j]
            else:
                ends[int(angle[j] > 0), m] = angle[j]
                left[n], refused[n] = m, j
                n += 1
        if n == 0:
            break
        for g in range(len(raised)):
            for j in range(n):
                circles[0, g, j] = circles[0, g, refused[j]]
                circles[1, g, j] = circles[1, g, refused[j]]
    return turn


@compiled
def _surprise(
    circles: Array,
    raised: Array,
    cosine: Array,
    sine: Array,
    n_others: int,
    hard: bool,
    tolerance: float,
) -> Array:
    """Minus the log-likelihood (n) of all answers, at a point of each of the first n circles."""
    n = len(cosine)
    total, product = np.zeros(n), np.ones(n)  # the result is total + log(product)
    highest, terms = np.empty(n), np.empty(n)
    for h in range(len(raised) // n_others):
        for j in range(n):
            highest[j], terms[j] = 0.0, 1.0
        for g in range(h * n_others, (h + 1) * n_others):
            for j in range(n):
                gap = circles[0, g, j] * cosine[j] + circles[1, g, j] * sine[j] + raised[g]
                if hard:
                    highest[j] = math.inf if gap < -tolerance else highest[j]
                    terms[j] += 1.0 if gap <= tolerance else 0.0
                else:  # terms · exp(highest) is the sum of exp(-gap), and of one
                    ratio = _exp_minus(abs(gap + highest[j]))
                    terms[j] = terms[j] * ratio + 1.0 if -gap > highest[j] else terms[j] + ratio
                    highest[j] = max(highest[j], -gap)
        for j in range(n):
            total[j] += highest[j]
            product[j] *= terms[j]
        if h % 100 == 99:  # before the product overflows
            for j in range(n):
                total[j], product[j] = total[j] + math.log(product[j]), 1.0
    for j in range(n):
        total[j] += math.log(product[j])
    return total


@compiled
def _exp_minus(x: float) -> float:
    """exp(-x) of x from 0 on, with an error of at most 2·10⁻⁷: as (exp(-x/1024))^1024, which is
    computed for several x at once, and the library's exp is not."""
    x = min(x, 700.0) / 1024
    power = 1.0 - x + 0.5 * x * x
    for _ in range(10):
        power *= power
    return power


@compiled
def _log(number: float) -> float:
    """The logarithm, of zero a large negative number."""
    return math.log(np.float32(max(number, 1e-30)))
