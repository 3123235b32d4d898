"""What the belief's sequential Monte Carlo is made of: weights, copies, where samples spread.

Shapes: S sessions, M samples, D features, V moves, P groups of samples, F sets of directions.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Generator, Tensor

from torchrl_pref.beliefs.resampling_cpu import (
    compiled_agreement,
    compiled_poles,
    compiled_resample,
    compiled_share,
)

GROUPS = 10
"""Samples move in directions drawn from the spread of the other groups: of nine tenths of them."""

FRAMES = 2
"""Sets of directions in a group, which its samples take in turn: copies of one that moved in the
same directions would stay more alike."""


def kish_share(log_weights: Tensor) -> Tensor:
    """Kish's effective share of weighted samples, (Σw)² / (M Σw²), for log-weights (… M)."""
    highest = log_weights.amax(-1, keepdim=True)
    weights = (log_weights - highest.nan_to_num(neginf=0.0)).exp()
    total, square = weights.sum(-1).square(), weights.square().sum(-1)
    return total / (square * log_weights.shape[-1]).clamp(min=1e-30)


def agreement(log_likelihood: Tensor) -> tuple[Tensor, Tensor]:
    """How far samples (S M) agree with an answer of this log-likelihood: Kish's effective share of
    them that it leaves (S), and how likely they hold it together (S)."""
    if log_likelihood.is_cpu:
        return compiled_agreement(log_likelihood)
    return kish_share(log_likelihood), log_likelihood.exp().mean(1)


def log_ratio(log_next: Tensor, log_now: Tensor) -> Tensor:
    """Log-weights (… S M) of samples with log-likelihoods (S M) that become others (… S M)."""
    # By rounding a sample may lie just outside of where it was moved to, and is dropped.
    return log_next - log_now.clamp(min=torch.finfo(log_now.dtype).min)


def resample(samples: Tensor, log_weights: Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    """Draw samples in proportion to their weights, systematically: with one number for all.

    Args:
        samples: (S M D).
        log_weights: (S M), not all of a session minus infinity.
        generator: the source of randomness, on the device of the samples.

    Returns:
        Samples (S M D) and by what this multiplies the variance of their mean (S). Copies of one
        are in one group, unless they are at its border, and in turn in its sets of directions.
    """
    offset = torch.rand(len(samples), generator=generator, device=samples.device)
    order = _order(samples.shape[1], samples.device)
    if samples.is_cpu:
        return compiled_resample(samples, log_weights, offset, order)
    return tensor_resample(samples, log_weights, offset, order)


@lru_cache(maxsize=16)
def _order(n_samples: int, device: torch.device) -> Tensor:
    """(M), which of the copies in a row goes to each place: those that a group gets are dealt to
    its sets of directions, as many to each as it has places for."""
    sets = group_of(n_samples, min(GROUPS, n_samples) * FRAMES, device)
    places = torch.arange(n_samples, device=device)
    first = torch.searchsorted(sets, sets)
    size = torch.searchsorted(sets, sets, right=True) - first
    # The copies of a group fill its sets at an even pace, so that neighbours go to different ones.
    pace = (places - first + 0.5) / size
    dealt = torch.argsort(sets // FRAMES + pace + 1e-3 * (sets % FRAMES))
    return torch.argsort(dealt)


def tensor_resample(
    samples: Tensor, log_weights: Tensor, offset: Tensor, order: Tensor
) -> tuple[Tensor, Tensor]:
    """:func:`resample` in tensors, with its number in [0, 1) for each session (S) and the order of
    the copies (M) given."""
    n_samples = log_weights.shape[-1]
    cumulative = log_weights.softmax(-1).cumsum(-1, dtype=torch.float64)
    points = (order + offset.double().unsqueeze(1)) / n_samples * cumulative[:, -1:]
    chosen = torch.searchsorted(cumulative, points).clamp(max=n_samples - 1)
    copies = samples.gather(1, chosen.unsqueeze(-1).expand_as(samples))
    return copies, variance_of_copies(chosen, copies)


def covariance_of(samples: Tensor) -> Tensor:
    """Covariance (… D D) of belief samples (… M D)."""
    centred = samples - samples.mean(-2, keepdim=True)
    return centred.mT @ centred / samples.shape[-2]


def variance_of_copies(chosen: Tensor, copies: Tensor) -> Tensor:
    """By what resampling multiplies the variance of the mean (S).

    A sample that is there n times counts n times, and more the farther it is from the mean: where
    the weights are large matters.

    Args:
        chosen: (S M), indices of the samples before.
        copies: (S M D), the samples after.
    """
    ones = torch.ones_like(copies[..., 0])
    multiplicity = torch.zeros_like(ones).scatter_add_(1, chosen, ones).gather(1, chosen)
    distance = (copies - copies.mean(1, keepdim=True)).square().sum(-1)
    return (multiplicity * distance).sum(1) / distance.sum(1).clamp(min=1e-30)


def group_of(n_samples: int, n_groups: int, device: torch.device) -> Tensor:
    """(M), the group of each sample: samples that follow each other, and so copies, share one."""
    return torch.arange(n_samples, device=device) * n_groups // n_samples


def spread_of_others(samples: Tensor) -> Tensor:
    """For each group the Cholesky factor of the covariance of all samples outside it, (S P D D).

    A direction that depends on the very sample that it moves leaves a bias, which grows with D.
    """
    n_samples, n_features = samples.shape[1:]
    n_groups = min(GROUPS, n_samples)
    group = group_of(n_samples, n_groups, samples.device)
    centred = samples - samples.mean(1, keepdim=True)
    others = (group != torch.arange(n_groups, device=samples.device).unsqueeze(1)).to(samples)
    share = others / others.sum(1, keepdim=True)
    means = share @ centred
    squares = (centred.unsqueeze(-1) * centred.unsqueeze(-2)).flatten(2)
    covariance = (share @ squares).unflatten(2, (n_features, n_features))
    covariance = covariance - means.unsqueeze(-1) * means.unsqueeze(-2)
    # The floor keeps every direction possible.
    floor = 1e-6 * covariance.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-12)
    covariance.diagonal(dim1=-2, dim2=-1).add_(floor.unsqueeze(-1))
    return torch.linalg.cholesky_ex(covariance).L


def frames_of(normal: Tensor) -> Tensor:
    """Random unit vectors from normal numbers (S V D), D after D at right angles to each other.

    Moves along such a frame, preconditioned, undo nothing of each other, so that D of them do what
    half as many again do in independent directions.
    """
    frames = []
    for some in normal.split(normal.shape[2], 1):
        factors = torch.linalg.qr(some.mT)
        # As by Gram and Schmidt, where the first is not turned round.
        frames.append((factors.Q * factors.R.diagonal(dim1=1, dim2=2).sign().unsqueeze(1)).mT)
    return torch.cat(frames, 1)


def poles_of(samples: Tensor, normal: Tensor) -> Tensor:
    """Directions of moves, from the spread of samples (S M D) and normal numbers (S F V D).

    Returns:
        (V S PF D), each as long as a Gaussian with the covariance of the samples outside the group
        is wide in that direction.
    """
    if samples.is_cpu:
        return compiled_poles(samples, normal, min(GROUPS, samples.shape[1]))
    return tensor_poles(samples, normal)


def tensor_poles(samples: Tensor, normal: Tensor) -> Tensor:
    """:func:`poles_of` in tensors."""
    frames = frames_of(normal.flatten(0, 1)).unflatten(0, normal.shape[:2])
    poles = torch.einsum("spde,sfve->vspfd", spread_of_others(samples), frames)
    return poles.flatten(2, 3)


def explained_share(before: Tensor, after: Tensor) -> Tensor:
    """How much of the variance of samples (S M D) their places before the moves explain, (S).

    The coefficient of determination of a linear regression, adjusted for chance and summed over
    features: 0 where the moves have made them forget.
    """
    return (compiled_share if before.is_cpu else tensor_share)(before, after)


def tensor_share(before: Tensor, after: Tensor) -> Tensor:
    """:func:`explained_share` in tensors."""
    n_samples, n_features = before.shape[1:]
    before = before - before.mean(1, keepdim=True)
    after = after - after.mean(1, keepdim=True)
    square = before.mT @ before
    diagonal = square.diagonal(dim1=-2, dim2=-1)
    diagonal.add_(1e-6 * diagonal.amax(-1, keepdim=True) + 1e-20)
    factor = torch.linalg.cholesky_ex(square).L
    explained = torch.linalg.solve_triangular(factor, before.mT @ after, upper=False)
    total = after.square().sum((1, 2)).clamp(min=1e-30)
    share = explained.square().sum((1, 2)) / total
    freedom = max(1, n_samples - 1 - n_features)
    return (1 - (1 - share) * (n_samples - 1) / freedom).clamp(0, 1)


def furthest(start: Tensor, end: Tensor, fits: Callable[[Tensor], Tensor]) -> Tensor:
    """(S), the end where it fits, else as near to it as fits, from a start (S) that does.

    ``fits`` takes places (P S) and says for each whether it fits. Thirty times an interval is
    halved; for a few sessions it is faster to cut it into 32 parts, six times.
    """
    reached = fits(end[None])[0]
    if reached.all():
        return end
    parts, times = (32, 6) if len(start) <= 32 else (2, 30)
    share = torch.linspace(0, 1, parts + 1, device=start.device)[:, None]
    near, beyond = start, end
    for _ in range(times):
        places = torch.lerp(near, beyond, share)
        # The first place fits, and the last does not.
        n_fit = fits(places[1:-1]).cumprod(0).sum(0, keepdim=True)
        near, beyond = places.gather(0, n_fit)[0], places.gather(0, n_fit + 1)[0]
    return torch.where(reached, end, near)
