"""The acquisition functions of ``acquisition.py`` compiled by Numba for the CPU.

One candidate after the other, its numbers in the cache, no temporaries; innermost loops run over
samples in float32, so that the processor takes many at once. All three functions come out of one
pass, as what they share is nearly all of the work. The first call on a new machine compiles for
some seconds.

Shapes: S sessions, C candidates, M samples, K options per query, D features, P the same with zeros
after them up to a multiple of four.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from torchrl_pref.compiled import compiled, over_sessions
from torchrl_pref.tensors import ROUNDING

Array = np.ndarray[Any, np.dtype[Any]]

ZERO: Any = np.float32(0)
HALF: Any = np.float32(0.5)
ONE: Any = np.float32(1)

FAR: Any = np.float32(87)
"""exp(-87) is the smallest that float32 holds in full."""

# exp(-x) is 2^n times 2^f, with f within a half of zero: Taylor's coefficients, to 10⁻⁷.
PER_BIT: Any = np.float32(-1 / math.log(2))
POWERS: Any = tuple(np.float32(math.log(2) ** i / math.factorial(i)) for i in range(7))
BIAS: Any = np.float32(127)
MANTISSA: Any = np.float32(2**23)


def compiled_scores(samples: Tensor, queries: Tensor, tau: float, tolerance: float) -> Tensor:
    """Information gain, alignment gain and volume removal of every candidate.

    Args:
        samples: (S M D) float32, the belief.
        queries: (S C K D) float32, the candidates; expanded over S where all sessions share them.
        tau: what the returns are multiplied by; infinite for answers without error.
        tolerance: of answers without error: gaps this small are ties.

    Returns:
        (S C 3).
    """
    scores = samples.new_empty(*queries.shape[:2], 3)
    shared = queries[:1] if queries.stride(0) == 0 else queries
    arrays = [t.detach().contiguous().numpy() for t in (samples, shared, scores)]
    over_sessions(_score_sessions, len(samples), *arrays, tau, tolerance)
    return scores


@compiled
def _score_sessions(
    first: int,
    last: int,
    samples: Array,
    queries: Array,
    scores: Array,
    tau: float,
    tolerance: float,
) -> None:
    """Fill ``scores`` (S C 3); there are queries (1 C K D) for all or (S C K D) for each."""
    n_samples, n_features = samples.shape[1:]
    n_options = queries.shape[2]
    hard = math.isinf(tau)
    unit = 1.0 if hard else tau  # leads are in units of 1/tau
    centred = np.zeros(((n_features + 3) // 4 * 4, n_samples), np.float32)
    turned, unit_samples = np.zeros_like(centred), np.empty((n_samples, n_features))
    mean = np.zeros(n_features)
    leads = np.zeros((n_options, len(centred)), np.float32)
    returns = np.zeros((n_options, n_samples), np.float32)
    probs = np.empty((n_options, n_samples), np.float32)
    scratch = np.empty((3, n_samples), np.float32)
    sums, left = np.empty(n_options), np.empty(len(centred))
    for s in range(first, last):
        pointed = centred
        if _turn(samples[s], unit_samples):
            pointed = turned
            _centre(unit_samples, mean, pointed)
        _centre(samples[s], mean, centred)
        shown = queries[min(s, len(queries) - 1)]
        for c in range(len(shown)):
            alike = True
            for k in range(n_options - 1):
                at_mean = 0.0
                for d in range(n_features):
                    lead = unit * (shown[c, k, d] - shown[c, n_options - 1, d])
                    leads[k, d] = lead
                    at_mean += lead * mean[d]
                    alike = alike and lead == 0.0
                _project(leads, centred, np.float32(at_mean), returns, k)
            if alike:  # exactly, whatever is lost in rounding
                scores[s, c] = 0.0, 0.0, 1.0 - 1.0 / n_options
                continue
            if hard:
                bits = _answer_exactly(returns, probs, sums, scratch[0], np.float32(tolerance))
            elif n_options == 2:
                bits = _answer_one_of_two(returns, probs, sums)
            else:
                returns[-1] = ZERO
                bits = _answer(returns, probs, sums, scratch)
            scores[s, c] = _gains(probs, sums, bits, pointed, left)


@compiled
def _turn(samples: Array, unit_samples: Array) -> bool:
    """Whether the length of a sample (M D) is not 1 but for rounding; if so ``unit_samples`` (M D)
    is filled with their directions."""
    differ = False
    for m in range(len(samples)):
        differ = differ or abs(_length(samples[m]) - 1.0) > ROUNDING
    if differ:  # as of beliefs that infer tau alone: for others nothing is divided
        for m in range(len(samples)):
            length = _length(samples[m])
            length = length if abs(length - 1.0) > ROUNDING else 1.0
            for d in range(samples.shape[1]):
                unit_samples[m, d] = samples[m, d] / length
    return differ


@compiled
def _length(sample: Array) -> float:
    """Of a vector (D)."""
    square = 0.0
    for d in range(len(sample)):
        square += float(sample[d]) ** 2
    return math.sqrt(square)


@compiled
def _centre(samples: Array, mean: Array, centred: Array) -> None:
    """Fill ``centred`` (P M) with samples (M D) less their ``mean`` (D)."""
    for d in range(samples.shape[1]):
        mean[d] = 0.0
        for m in range(len(samples)):
            mean[d] += samples[m, d]
        mean[d] /= len(samples)
        for m in range(len(samples)):
            centred[d, m] = samples[m, d] - mean[d]


@compiled
def _project(leads: Array, centred: Array, at_mean: float, returns: Array, k: int) -> None:
    """Fill row k of ``returns`` (K M) with lead k (P) times samples; its mean is ``at_mean``."""
    for d in range(0, len(centred), 4):
        first, second, third, fourth = (
            leads[k, d],
            leads[k, d + 1],
            leads[k, d + 2],
            leads[k, d + 3],
        )
        for m in range(returns.shape[1]):
            value = at_mean if d == 0 else returns[k, m]
            value += first * centred[d, m] + second * centred[d + 1, m]
            returns[k, m] = value + third * centred[d + 2, m] + fourth * centred[d + 3, m]


@compiled
def _exp_minus(x: float) -> float:
    """exp(-x) of float32 x from 0 to 87, exact at 0, in operations that take many x at once."""
    bits = x * PER_BIT
    whole = np.float32(np.int32(bits - HALF))
    part = bits - whole
    power = POWERS[6]
    power = power * part + POWERS[5]
    power = power * part + POWERS[4]
    power = power * part + POWERS[3]
    power = power * part + POWERS[2]
    power = power * part + POWERS[1]
    power = power * part + POWERS[0]
    return power * np.int32((whole + BIAS) * MANTISSA).view(np.float32)


@compiled
def _answer_one_of_two(returns: Array, probs: Array, sums: Array) -> float:
    """Fill ``probs`` (2 M) and their ``sums`` (2) over samples from the returns (2 M), the second
    of which are zero; the sum of the entropies in bits.

    With q the probability of the less likely answer and z the logit, the entropy is
    |z| q - log(1 - q), and 1 - q is 1/(1 + exp(-|z|)).
    """
    nats, bits = 0.0, 0.0
    sums[:] = 0.0
    for start in range(0, returns.shape[1], 120):  # as many factors up to 2 as float32 can multiply
        stop = start + 120
        logit, first, second = returns[0, start:stop], probs[0, start:stop], probs[1, start:stop]
        product, weighed, one, other = ONE, ZERO, ZERO, ZERO
        for m in range(len(logit)):
            size = min(abs(logit[m]), FAR)
            power = _exp_minus(size)
            likely = ONE / (ONE + power)
            unlikely = power * likely
            product *= ONE + power
            weighed += size * unlikely
            first[m] = unlikely if logit[m] < ZERO else likely
            second[m] = likely if logit[m] < ZERO else unlikely
            one += first[m]
            other += second[m]
        sums[0] += one
        sums[1] += other
        bits += math.log2(product)
        nats += weighed
    return bits + nats / math.log(2)


@compiled
def _answer(returns: Array, probs: Array, sums: Array, scratch: Array) -> float:
    """The same for K options, from their returns (K M), which are overwritten, as is ``scratch``
    (3 M)."""
    n_options, n_samples = returns.shape
    nats, bits = 0.0, 0.0
    sums[:] = 0.0
    step = int(120 / math.log2(n_options))  # as many factors up to K as float32 can multiply
    for start in range(0, n_samples, step):
        stop = start + step
        highest, total, weighed = (
            scratch[0, start:stop],
            scratch[1, start:stop],
            scratch[2, start:stop],
        )
        highest[:] = returns[0, start:stop]
        total[:] = ZERO
        weighed[:] = ZERO
        for k in range(1, n_options):
            gap = returns[k, start:stop]
            for m in range(len(highest)):
                highest[m] = max(highest[m], gap[m])
        # Few arrays in each loop, or the processor would take one number at a time.
        for k in range(n_options):
            gap, chosen = returns[k, start:stop], probs[k, start:stop]
            for m in range(len(highest)):
                gap[m] = min(highest[m] - gap[m], FAR)
                chosen[m] = _exp_minus(gap[m])
            for m in range(len(highest)):
                total[m] += chosen[m]
                weighed[m] += gap[m] * chosen[m]
        product, mean = ONE, ZERO
        for m in range(len(highest)):
            product *= total[m]
            total[m] = ONE / total[m]
            mean += weighed[m] * total[m]
        for k in range(n_options):
            chosen, share = probs[k, start:stop], ZERO
            for m in range(len(highest)):
                chosen[m] *= total[m]
                share += chosen[m]
            sums[k] += share
        bits += math.log2(product)
        nats += mean
    return bits + nats / math.log(2)


@compiled
def _answer_exactly(
    returns: Array, probs: Array, sums: Array, ties: Array, tolerance: float
) -> float:
    """The same of an optimal human: the highest return, ties alike; ``ties`` (M) is scratch."""
    n_options, n_samples = returns.shape
    bits = 0.0
    for k in range(n_options):
        for m in range(n_samples):
            probs[k, m], ties[m] = ONE, ONE
        for j in range(n_options):
            if j != k:
                for m in range(n_samples):
                    gap = returns[k, m] - returns[j, m]
                    probs[k, m] = ZERO if gap < -tolerance else probs[k, m]
                    ties[m] += ONE if abs(gap) <= tolerance else ZERO
        share, tied = ZERO, ZERO
        for m in range(n_samples):
            share += probs[k, m]
            tied += ties[m] - ONE
        sums[k] = share
        if tied > ZERO:
            for m in range(n_samples):
                if probs[k, m] * ties[m] > ONE:
                    probs[k, m] /= ties[m]
                    sums[k] += probs[k, m] - ONE
                    bits += probs[k, m] * math.log2(ties[m])
    return bits


@compiled
def _gains(
    probs: Array, sums: Array, bits: float, centred: Array, left: Array
) -> tuple[float, float, float]:
    """The scores from the probabilities (K M), their sums (K) over samples and the sum of the
    entropies in bits; ``left`` (P) is scratch."""
    n_options, n_samples = probs.shape
    likely, entropy, squares = 0, 0.0, 0.0
    for k in range(n_options):
        mean = sums[k] / n_samples
        if mean > 0:
            entropy -= mean * math.log2(mean)
        squares += mean * mean
        if sums[k] > sums[likely]:
            likely = k
    # The means of all answers move by nothing together: the likeliest by what the others do not.
    gain = 0.0
    left[:] = 0.0
    for k in range(n_options):
        if k != likely:
            length = 0.0
            for d in range(0, len(centred), 4):
                a, b, c, e = _weigh(probs, k, centred, d)
                length += a * a + b * b + c * c + e * e
                left[d] += a
                left[d + 1] += b
                left[d + 2] += c
                left[d + 3] += e
            gain += length / max(sums[k], 1e-30)
    length = 0.0
    for d in range(len(centred)):
        length += left[d] * left[d]
    gain += length / max(sums[likely], 1e-30)
    gained = min(max(entropy - bits / n_samples, 0.0), math.log2(n_options))  # but for rounding
    return gained, gain / n_samples, 1.0 - squares


@compiled
def _weigh(probs: Array, k: int, centred: Array, d: int) -> tuple[float, float, float, float]:
    """Sums over samples of the probabilities of answer k times features d to d + 3."""
    first, second, third, fourth = ZERO, ZERO, ZERO, ZERO
    for m in range(probs.shape[1]):
        first += probs[k, m] * centred[d, m]
        second += probs[k, m] * centred[d + 1, m]
        third += probs[k, m] * centred[d + 2, m]
        fourth += probs[k, m] * centred[d + 3, m]
    return first, second, third, fourth
