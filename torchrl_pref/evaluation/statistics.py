"""Intervals of means over humans, and over pools and training seeds."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Generator, Tensor


def bootstrap_interval(values: Tensor, seed: int = 0, resamples: int = 2000) -> tuple[float, float]:
    """Percentile bootstrap 95% interval of the mean of values (B) over humans."""
    means = _resampled_shares(len(values), seed, resamples) @ values.float()
    low, high = torch.quantile(means, torch.tensor([0.025, 0.975])).tolist()
    return low, high


@lru_cache(maxsize=1)
def _resampled_shares(count: int, seed: int, resamples: int) -> Tensor:
    """The share of each human (resamples B) in each resample; the same for every curve."""
    generator = Generator().manual_seed(seed)
    picks = torch.randint(count, (resamples, count), generator=generator)
    ones = torch.ones(1).expand(picks.shape)
    return torch.zeros(picks.shape).scatter_add_(1, picks, ones) / count


def two_way_interval(values: Tensor, resamples: int = 4000) -> tuple[float, float]:
    """Bootstrap interval of the mean of values (P S) over pools and seeds, drawn apart.

    Nominally 95%. Resampling P things shows (P - 1)/P of their variance, which is made up for; even
    so the interval covers somewhat less, and much less where P is 3.
    """
    generator = Generator().manual_seed(0)
    n_pools, n_seeds = values.shape
    pools = torch.randint(n_pools, (resamples, n_pools), generator=generator)
    seeds = torch.randint(n_seeds, (resamples, n_seeds), generator=generator)
    means = values[pools.unsqueeze(-1), seeds.unsqueeze(-2)].mean((1, 2))
    centre, widen = values.mean(), math.sqrt(n_pools / max(1, n_pools - 1))
    bounds = torch.quantile(means, torch.tensor([0.025, 0.975]))
    low, high = (centre + widen * (bounds - centre)).tolist()
    return low, high
