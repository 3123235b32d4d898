"""The acquisition functions for any kind of question, compiled by Numba for the CPU.

Choices of one have closed forms, in ``scoring_cpu.py``. Here an answer is what its question's table
says: a product of factors, each of which is computed once for all the answers that share it, and so
is what an answer has in common with the one before it. Of six options there are 720 orders, made of
186 factors.

Shapes: S sessions, C candidates, M samples, K options per query, R possible answers, F factors of
an answer, U different factors, J rows of a factor, D features.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from torchrl_pref.compiled import compiled, over_sessions
from torchrl_pref.questions.base import Factors
from torchrl_pref.tensors import directions

Array = np.ndarray[Any, np.dtype[Any]]

ZERO: Any = np.float32(0)
ONE: Any = np.float32(1)
TWO: Any = np.float32(2)
HALF: Any = np.float32(0.5)

FAR: Any = np.float32(87)
"""exp(-87) is the smallest that float32 holds in full."""

# As in ``scoring_cpu``: a compiled function calls only those of its own file.
PER_BIT: Any = np.float32(-1 / math.log(2))
POWERS: Any = tuple(np.float32(math.log(2) ** i / math.factorial(i)) for i in range(7))
BIAS: Any = np.float32(127)
MANTISSA: Any = np.float32(2**23)

# log((1 + t) / (1 - t)) / 2t is 1 + t²/3 + t⁴/5 + …
ODD: Any = tuple(np.float32(1 / i) for i in (3, 5, 7, 9))
LOG_2: Any = np.float32(math.log(2))
ROOT_2: Any = np.float32(math.sqrt(2))


def compiled_table_scores(
    samples: Tensor,
    queries: Tensor,
    factors: Factors,
    log_weights: Tensor,
    scale: float,
    tau: float,
    tolerance: float,
    lapse: float,
) -> Tensor:
    """Information gain, alignment gain and volume removal of every candidate.

    Args:
        samples: (S M D) float32, the belief.
        queries: (S C K D) float32, the candidates; expanded over S where all sessions share them.
        factors: of the question's answers.
        log_weights: (R), see ``questions.base.Answers``.
        scale: what a return of 1 is in logits, the unit of the offsets.
        tau: what the returns are multiplied by; infinite for answers without error.
        tolerance: of answers without error: gaps this small are ties.
        lapse: probability of an answer at random.

    Returns:
        (S C 3).
    """
    scores = samples.new_empty(*queries.shape[:2], 3)
    shared = queries[:1] if queries.stride(0) == 0 else queries
    unit = 1.0 if math.isinf(tau) else tau
    tables = factors.contrasts, factors.offsets * (unit / scale), factors.of_answer, log_weights
    given = samples, directions(samples), shared, scores, *tables
    arrays = [t.detach().contiguous().numpy() for t in given]
    constants = unit, math.isinf(tau), np.float32(tolerance), lapse
    over_sessions(_score_sessions, len(samples), *arrays, *constants)
    return scores


@compiled
def _score_sessions(
    first: int,
    last: int,
    samples: Array,
    pointed: Array,
    queries: Array,
    scores: Array,
    contrasts: Array,
    raised: Array,
    of_answer: Array,
    log_weights: Array,
    unit: float,
    hard: bool,
    tolerance: float,
    lapse: float,
) -> None:
    """Fill ``scores`` (S C 3); there are queries (1 C K D) for all or (S C K D) for each. Samples
    are ``pointed`` (S M D) where their directions count."""
    n_samples, n_features = samples.shape[1:]
    n_options, n_factors = queries.shape[2], len(contrasts)
    centred = np.empty((n_features, n_samples), np.float32)
    plain = np.empty((n_features, n_samples), np.float32)
    returns = np.empty((n_options, n_samples), np.float32)
    likely = np.empty((n_factors, n_samples), np.float32)
    logs = np.empty((n_factors, n_samples), np.float32)
    scratch = np.empty((2, of_answer.shape[1] + 1, n_samples), np.float32)
    same = _in_common(of_answer)
    for s in range(first, last):
        for d in range(n_features):
            mean = 0.0
            for m in range(n_samples):
                plain[d, m] = samples[s, m, d]
                mean += pointed[s, m, d]
            for m in range(n_samples):
                centred[d, m] = pointed[s, m, d] - mean / n_samples
        shown = queries[min(s, len(queries) - 1)]
        for c in range(len(shown)):
            _fill_returns(shown[c], plain, returns, unit)
            for u in range(n_factors):
                gaps = contrasts[u], raised[u], returns
                if hard:
                    _factor_exactly(*gaps, likely[u], logs[u], scratch[0, 0], tolerance)
                else:
                    _factor(*gaps, likely[u], logs[u], scratch[0, 0], scratch[1, 0])
            given = likely, logs, of_answer, same, log_weights, scratch
            scores[s, c] = _gains(*given, centred, lapse)


@compiled
def _in_common(of_answer: Array) -> Array:
    """(R), how many of its first factors an answer shares with the one before it."""
    same = np.zeros(len(of_answer), np.int64)
    for r in range(1, len(of_answer)):
        while same[r] < of_answer.shape[1] and (of_answer[r, same[r]] == of_answer[r - 1, same[r]]):
            same[r] += 1
    return same


@compiled
def _fill_returns(options: Array, samples: Array, returns: Array, unit: float) -> None:
    """Fill ``returns`` (K M) of options (K D) under samples (D M), less that of the last option;
    that of a single option as it is."""
    returns[:] = ZERO
    n_options, n_features = options.shape
    for k in range(max(1, n_options - 1)):
        for d in range(n_features):
            other = 0.0 if n_options == 1 else options[n_options - 1, d]
            lead = np.float32(unit * (options[k, d] - other))
            for m in range(returns.shape[1]):
                returns[k, m] += lead * samples[d, m]


@compiled
def _fill_gaps(contrasts: Array, raised: float, returns: Array, gaps: Array) -> None:
    """Fill ``gaps`` (M) of a row with contrasts (K) from returns (K M)."""
    gaps[:] = raised
    for k in range(len(contrasts)):
        if contrasts[k] != ZERO:
            for m in range(len(gaps)):
                gaps[m] += contrasts[k] * returns[k, m]


@compiled
def _factor(
    contrasts: Array,
    raised: Array,
    returns: Array,
    likely: Array,
    logs: Array,
    gaps: Array,
    highest: Array,
) -> None:
    """Fill the probability (M) of a factor with rows (J K) and its logarithm (M); ``gaps`` and
    ``highest`` (M) are scratch."""
    highest[:] = ZERO
    likely[:] = ONE  # likely · exp(highest) is the sum of exp(-gap), and of one
    for j in range(len(raised)):
        if raised[j] < np.inf:
            _fill_gaps(contrasts[j], raised[j], returns, gaps)
            for m in range(len(gaps)):
                above = -gaps[m] - highest[m]
                ratio = _exp_minus(min(abs(above), FAR))
                likely[m] = likely[m] * ratio + ONE if above > ZERO else likely[m] + ratio
                highest[m] = max(highest[m], -gaps[m])
    for m in range(len(gaps)):
        logs[m] = -highest[m] - _log(likely[m])
        likely[m] = _exp_minus(min(highest[m], FAR)) / likely[m]


@compiled
def _factor_exactly(
    contrasts: Array,
    raised: Array,
    returns: Array,
    likely: Array,
    logs: Array,
    gaps: Array,
    tolerance: float,
) -> None:
    """The same of an optimal human: the highest return, ties alike."""
    likely[:] = ONE
    logs[:] = ONE  # here the number of those that tie
    for j in range(len(raised)):
        if raised[j] < np.inf:
            _fill_gaps(contrasts[j], raised[j], returns, gaps)
            for m in range(len(gaps)):
                likely[m] = ZERO if gaps[m] < -tolerance else likely[m]
                logs[m] += ONE if abs(gaps[m]) <= tolerance else ZERO
    for m in range(len(gaps)):
        likely[m] /= logs[m]
        logs[m] = -_log(logs[m])


@compiled
def _gains(
    likely: Array,
    logs: Array,
    of_answer: Array,
    same: Array,
    log_weights: Array,
    scratch: Array,
    centred: Array,
    lapse: float,
) -> tuple[float, float, float]:
    """The scores from the factors' probabilities (U M) and their logarithms (U M).

    ``scratch`` (2 F+1 M) holds the products of an answer's first factors, and the sums of their
    logarithms.
    """
    n_answers, n_factors = of_answer.shape
    n_samples = likely.shape[1]
    entropy, of_mean, squares, gain = 0.0, 0.0, 0.0, 0.0
    scratch[0, 0], scratch[1, 0] = ONE, ZERO
    for r in range(n_answers):
        for f in range(same[r], n_factors):
            u = of_answer[r, f]
            _multiply(scratch[0, f], likely[u], scratch[0, f + 1])
            _add(scratch[1, f], logs[u], scratch[1, f + 1])
        product, length = scratch[0, n_factors], 0.0
        total, weighed = _sum(product), _dot(product, scratch[1, n_factors])
        for d in range(len(centred)):
            moved = _dot(product, centred[d])
            length += moved * moved
        weight = math.exp(log_weights[r]) / n_samples
        mean = weight * total
        if lapse == 0.0:
            entropy -= weight * weighed + mean * log_weights[r]
        else:
            at_random, weight = lapse / n_answers, (1.0 - lapse) * weight
            mean = at_random + (1.0 - lapse) * mean
            shares = np.float32(at_random), np.float32(weight * n_samples)
            entropy += _entropy_of_mixed(product, *shares) / n_samples
        if mean > 0:
            of_mean -= mean * math.log(mean)
        squares += mean * mean
        gain += weight * weight * length / max(mean, 1e-30)
    gained = min(max((of_mean - entropy) / math.log(2), 0.0), math.log2(n_answers))
    return gained, gain, 1.0 - squares


@compiled
def _entropy_of_mixed(product: Array, at_random: float, weight: float) -> float:
    """The sum over samples of -p log p, where p is ``at_random`` + ``weight`` · product (M)."""
    total = ZERO
    for m in range(len(product)):
        mixed = at_random + weight * product[m]
        total -= mixed * _log(mixed)
    return total


@compiled
def _multiply(first: Array, second: Array, product: Array) -> None:
    """Fill the product (M) of two (M)."""
    for m in range(len(product)):
        product[m] = first[m] * second[m]


@compiled
def _add(first: Array, second: Array, total: Array) -> None:
    """Fill the sum (M) of two (M)."""
    for m in range(len(total)):
        total[m] = first[m] + second[m]


@compiled
def _sum(numbers: Array) -> float:
    """Of numbers (M)."""
    total = ZERO
    for m in range(len(numbers)):
        total += numbers[m]
    return total


@compiled
def _dot(first: Array, second: Array) -> float:
    """The sum of the products of two (M)."""
    total = ZERO
    for m in range(len(first)):
        total += first[m] * second[m]
    return total


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
def _log(x: float) -> float:
    """log(x) of positive float32 x, exact at 1, in operations that take many x at once."""
    bits = np.float32(x).view(np.int32)
    whole = np.float32((bits >> 23) - 127)
    part = np.int32((bits & 0x7FFFFF) | 0x3F800000).view(np.float32)
    whole, part = (whole + ONE, part * HALF) if part > ROOT_2 else (whole, part)
    t = (part - ONE) / (part + ONE)
    square = t * t
    series = ODD[3]
    series = series * square + ODD[2]
    series = series * square + ODD[1]
    series = series * square + ODD[0]
    return TWO * t * (series * square + ONE) + whole * LOG_2
