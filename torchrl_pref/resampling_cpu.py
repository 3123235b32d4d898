"""The step of the belief compiled by Numba for the CPU: ``resampling.py`` and the moves in one.

For one session torch would spend more time on starting its operations than on the work itself.

Shapes: S sessions, M samples, H answers, K options per query, D features, V moves, P groups of
samples, U uniforms of a move.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.compiled import compiled
from torchrl_pref.sampler_cpu import move_session, rows_of

Array = np.ndarray[Any, np.dtype[Any]]


def compiled_resample(
    samples: Tensor, log_weights: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor]:
    """Samples (S M D) after systematic resampling with offsets (S), and by what it multiplies the
    variance of their mean (S)."""
    copies, factor = torch.empty_like(samples), torch.empty_like(offset)
    given = samples, log_weights, offset, copies, factor
    _resample_sessions(*(t.contiguous().numpy() for t in given))
    return copies, factor


def compiled_moves(
    start: Tensor,
    samples: Tensor,
    normal: Tensor,
    uniform: Tensor,
    answers: Tensor,
    slack: Tensor,
    power: Tensor,
    groups: int,
    arc: float,
    tau: float,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """One round of moves, for Boltzmann and optimal humans, with its random numbers given.

    Args:
        start: (S M D), where the samples were before any moves.
        samples: (S M D), where they are.
        normal: (S V D), of which directions are made.
        uniform: (V S M U), in [0, 1): two, and one for each shrink.
        answers: (S H K-1 D), feature gaps.
        slack, power: (S), see ``sampler.great_circle_moves``.
        groups: P.
        arc: length of the arc that is searched, in lengths of the pole.
        tau: what the gaps are multiplied by; infinite for answers without error.
        tolerance: of answers without error: gaps this small are ties.

    Returns:
        Samples (S M D), and how much of their variance ``start`` explains (S).
    """
    moved = torch.empty_like(samples, memory_format=torch.contiguous_format)
    explained = torch.empty_like(slack)
    given = start, samples, normal, uniform, answers, slack, power, moved, explained
    _move_sessions(*(t.contiguous().numpy() for t in given), groups, arc, tau, tolerance)
    return moved, explained


@compiled
def _resample_sessions(
    samples: Array, log_weights: Array, offset: Array, copies: Array, factor: Array
) -> None:
    """Fill ``copies`` (S M D) and ``factor`` (S)."""
    n_samples, n_features = samples.shape[1:]
    cumulative = np.empty(n_samples)
    for s in range(len(samples)):
        highest, total = log_weights[s].max(), 0.0
        for m in range(n_samples):
            total += math.exp(log_weights[s, m] - highest)
            cumulative[m] = total
        multiplicity = np.zeros(n_samples)
        chosen = np.empty(n_samples, np.int64)
        m = 0
        for i in range(n_samples):
            while m < n_samples - 1 and cumulative[m] < (i + offset[s]) / n_samples * total:
                m += 1
            chosen[i] = m
            multiplicity[m] += 1
            copies[s, i] = samples[s, m]
        mean = np.zeros(n_features)
        for i in range(n_samples):
            for d in range(n_features):
                mean[d] += copies[s, i, d] / n_samples
        weighted = whole = 0.0
        for i in range(n_samples):
            distance = 0.0
            for d in range(n_features):
                distance += (copies[s, i, d] - mean[d]) ** 2
            weighted += multiplicity[chosen[i]] * distance
            whole += distance
        factor[s] = weighted / max(whole, 1e-30)


@compiled
def _move_sessions(
    start: Array,
    samples: Array,
    normal: Array,
    uniform: Array,
    answers: Array,
    slack: Array,
    power: Array,
    moved: Array,
    explained: Array,
    n_groups: int,
    arc: float,
    tau: float,
    tolerance: float,
) -> None:
    """Fill ``moved`` (S M D) and ``explained`` (S)."""
    n_others, hard = answers.shape[2], math.isinf(tau)
    n_moves, n_features = normal.shape[1:]
    poles = np.empty((n_moves, n_groups, n_features))
    for s in range(len(samples)):
        frames = _frames(normal[s])
        spread = _spread_of_others(samples[s], n_groups)
        for v in range(n_moves):
            for p in range(n_groups):
                for d in range(n_features):
                    ahead = 0.0
                    for e in range(d + 1):
                        ahead += spread[p, d, e] * frames[v, e]
                    poles[v, p, d] = ahead
        rows, raised = rows_of(answers[s], slack[s], 1.0 if hard else tau)
        given = rows, raised, float(power[s]), arc, n_others, hard, tolerance
        move_session(samples[s], poles, uniform[:, s], moved[s], *given)
        explained[s] = _explained_share(start[s], moved[s])


@compiled
def _frames(normal: Array) -> Array:
    """Unit vectors (V D) from normal numbers, D after D at right angles to each other."""
    n_moves, n_features = normal.shape
    frames = normal.astype(np.float64)
    for v in range(n_moves):
        for w in range(v - v % n_features, v):
            along = 0.0
            for d in range(n_features):
                along += frames[v, d] * frames[w, d]
            for d in range(n_features):
                frames[v, d] -= along * frames[w, d]
        square = 0.0
        for d in range(n_features):
            square += frames[v, d] * frames[v, d]
        for d in range(n_features):
            frames[v, d] /= math.sqrt(square)
    return frames


@compiled
def _spread_of_others(samples: Array, n_groups: int) -> Array:
    """(P D D), Cholesky factors of the covariance of all samples (M D) outside each group."""
    n_samples, n_features = samples.shape
    centred = samples - _mean(samples)
    sums = np.zeros((n_groups, n_features))
    products = np.zeros((n_groups, n_features, n_features))
    for m in range(n_samples):
        p = m * n_groups // n_samples
        sums[p] += centred[m]
        _add_products(products[p], centred[m], centred[m])
    whole = products.sum(0)
    factors = np.empty_like(products)
    for p in range(n_groups):
        count = n_samples - (-(-(p + 1) * n_samples // n_groups) + (-p * n_samples // n_groups))
        covariance = (whole - products[p]) / count
        _add_products(covariance, sums[p] / count, -sums[p] / count)
        largest = 1e-12
        for d in range(n_features):
            largest = max(largest, covariance[d, d])
        for d in range(n_features):
            covariance[d, d] += 1e-6 * largest  # every direction stays possible
        factors[p] = _cholesky(covariance)
    return factors


@compiled
def _add_products(matrix: Array, left: Array, right: Array) -> None:
    """Add the outer product of two vectors (D) to a matrix (D D)."""
    for d in range(len(left)):
        for e in range(len(right)):
            matrix[d, e] += left[d] * right[e]


@compiled
def _explained_share(before: Array, after: Array) -> float:
    """How much of the variance of places (M D) those before explain, adjusted for chance."""
    n_samples, n_features = before.shape
    before, after = before - _mean(before), after - _mean(after)
    square, both = np.zeros((n_features, n_features)), np.zeros((n_features, n_features))
    for m in range(n_samples):
        _add_products(square, before[m], before[m])
        _add_products(both, before[m], after[m])
    largest = 0.0
    for d in range(n_features):
        largest = max(largest, square[d, d])
    for d in range(n_features):
        square[d, d] += 1e-6 * largest + 1e-20
    factor = _cholesky(square)
    explained = 0.0
    for column in range(n_features):
        for d in range(n_features):
            for e in range(d):
                both[d, column] -= factor[d, e] * both[e, column]
            both[d, column] /= factor[d, d]
            explained += both[d, column] ** 2
    share = explained / max(np.sum(after * after), 1e-30)
    freedom = max(1, n_samples - 1 - n_features)
    return min(max(1 - (1 - share) * (n_samples - 1) / freedom, 0.0), 1.0)


@compiled
def _mean(samples: Array) -> Array:
    """(D), of samples (M D), in float64."""
    total = np.zeros(samples.shape[1])
    for row in samples:
        total += row
    return total / len(samples)


@compiled
def _cholesky(matrix: Array) -> Array:
    """Lower triangular factor (D D) of a positive matrix."""
    size = len(matrix)
    factor = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = math.sqrt(max(rest, 1e-30))
            else:
                factor[i, j] = rest / factor[j, j]
    return factor
