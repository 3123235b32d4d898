"""Intervals of means over humans, and over pools and training seeds."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Generator, Tensor

RESAMPLES = 4000


def bootstrap_interval(values: Tensor, seed: int = 0) -> tuple[float, float]:
    """Bootstrap interval of the mean of values over one factor (P), or over two crossed ones (P S).

    One factor is humans that one strategy met; two are pools and training seeds, drawn apart.
    Nominally 95%. Resampling P things shows (P - 1)/P of their variance, which is made up for; even
    so the interval covers somewhat less where there are few, and much less where P is 3.
    """
    drawn = _resampled_shares(tuple(values.shape), seed)
    means = drawn[0] @ values.float()
    if values.ndim == 2:
        means = (means * drawn[1]).sum(1)
    centre, widen = values.float().mean(), math.sqrt(len(values) / max(1, len(values) - 1))
    bounds = torch.quantile(means, torch.tensor([0.025, 0.975]))
    low, high = (centre + widen * (bounds - centre)).tolist()
    return low, high


@lru_cache(maxsize=4)
def _resampled_shares(counts: tuple[int, ...], seed: int) -> list[Tensor]:
    """The share of each thing of each factor (resamples P) in each resample; the same for every
    curve."""
    generator = Generator().manual_seed(seed)
    shares = []
    for count in counts:
        picks = torch.randint(count, (RESAMPLES, count), generator=generator)
        ones = torch.ones(1).expand(picks.shape)
        shares.append(torch.zeros(picks.shape).scatter_add_(1, picks, ones) / count)
    return shares
