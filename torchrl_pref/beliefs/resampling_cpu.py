"""What is in ``resampling.py``, compiled by Numba for the CPU: one session after the other.

For one session torch would spend more time on starting its operations than on the work itself.

Shapes: S sessions, M samples, D features, V moves, P groups of samples, F sets of directions.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_pref.compiled import compiled

Array = np.ndarray[Any, np.dtype[Any]]


def compiled_resample(
    samples: Tensor, log_weights: Tensor, offset: Tensor, order: Tensor
) -> tuple[Tensor, Tensor]:
    """Samples (S M D) after systematic resampling with offsets (S), in an order (M), and by what it
    multiplies the variance of their mean (S)."""
    copies, factor = torch.empty_like(samples), torch.empty_like(offset)
    given = samples, log_weights, offset, order, copies, factor
    _resample_sessions(*(t.contiguous().numpy() for t in given))
    return copies, factor


def compiled_poles(samples: Tensor, normal: Tensor, groups: int) -> Tensor:
    """``resampling.poles_of`` from samples (S M D) and normal numbers (S F V D): (V S PF D)."""
    n_sessions, n_frames, n_moves, n_features = normal.shape
    poles = samples.new_empty(n_moves, n_sessions, groups * n_frames, n_features)
    _aim_sessions(*(t.contiguous().numpy() for t in (samples, normal, poles)))
    return poles


def compiled_share(before: Tensor, after: Tensor) -> Tensor:
    """``resampling.explained_share`` of samples (S M D): (S)."""
    share = before.new_empty(len(before))
    _explain_sessions(*(t.contiguous().numpy() for t in (before, after, share)))
    return share


def compiled_agreement(log_likelihood: Tensor) -> tuple[Tensor, Tensor]:
    """``resampling.agreement`` of samples with an answer of log-likelihood (S M): (S) and (S)."""
    share, mean = log_likelihood.new_empty(2, len(log_likelihood))
    _agree_sessions(*(t.contiguous().numpy() for t in (log_likelihood, share, mean)))
    return share, mean


@compiled
def _agree_sessions(log_likelihood: Array, share: Array, mean: Array) -> None:
    """Fill ``share`` (S) and ``mean`` (S)."""
    n_samples = log_likelihood.shape[1]
    for s in range(len(share)):
        highest = max(log_likelihood[s].max(), -1e30)  # where the answer is impossible to all
        total = square = 0.0
        for m in range(n_samples):
            weight = math.exp(log_likelihood[s, m] - highest)
            total += weight
            square += weight * weight
        share[s] = total * total / max(n_samples * square, 1e-30)
        mean[s] = total * math.exp(highest) / n_samples


@compiled
def _resample_sessions(
    samples: Array,
    log_weights: Array,
    offset: Array,
    order: Array,
    copies: Array,
    factor: Array,
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
        for i in range(n_samples):
            copies[s, i] = samples[s, chosen[order[i]]]
        mean = np.zeros(n_features)
        for i in range(n_samples):
            for d in range(n_features):
                mean[d] += copies[s, i, d] / n_samples
        weighted = whole = 0.0
        for i in range(n_samples):
            distance = 0.0
            for d in range(n_features):
                distance += (copies[s, i, d] - mean[d]) ** 2
            weighted += multiplicity[chosen[order[i]]] * distance
            whole += distance
        factor[s] = weighted / max(whole, 1e-30)


@compiled
def _aim_sessions(samples: Array, normal: Array, poles: Array) -> None:
    """Fill ``poles`` (V S PF D)."""
    n_frames, n_moves, n_features = normal.shape[1:]
    n_groups = poles.shape[2] // n_frames
    for s in range(len(samples)):
        spread = _spread_of_others(samples[s], n_groups)
        for f in range(n_frames):
            frames = _frames(normal[s, f])
            for v in range(n_moves):
                for p in range(n_groups):
                    for d in range(n_features):
                        ahead = 0.0
                        for e in range(d + 1):
                            ahead += spread[p, d, e] * frames[v, e]
                        poles[v, s, p * n_frames + f, d] = ahead


@compiled
def _explain_sessions(before: Array, after: Array, share: Array) -> None:
    """Fill ``share`` (S)."""
    for s in range(len(share)):
        share[s] = _explained_share(before[s], after[s])


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
