"""From an accuracy to the tau that has it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.tensors import check_finite, check_plain


def calibrate_tau(returns: Tensor, target: float = 0.9) -> float:
    """The tau at which the best option is picked with probability ``target`` on average.

    This is what "noisy user (90%)" of the paper's Figure 1 is taken to mean. A single option is
    held against the average trajectory, whose normalised features, and so its return, are 0.

    Args:
        returns: (… K), returns of the options of the training pool under humans of the prior.
        target: mean probability of the best option, above 1/K (K = 1: above 1/2) and below 1.

    Raises:
        InputError: the returns are no finite numbers of K ≥ 1 options, or no tau up to 10⁶ reaches
            the target (most options tie).
    """
    check_plain("returns", returns)
    if returns.ndim < 1 or returns.shape[-1] < 1 or not returns.numel():
        raise InputError(
            f"returns of shape {tuple(returns.shape)}: expected (… K), at least one row of at "
            "least 1 option"
        )
    check_finite("returns", returns.to(torch.float32))
    if returns.shape[-1] == 1:
        returns = torch.cat([returns, torch.zeros_like(returns)], -1)
    gaps = (returns.amax(-1, keepdim=True) - returns).sort(-1).values[..., 1:]

    def accuracy(tau: float) -> float:
        return Boltzmann(tau).log_likelihood(gaps).exp().mean(dtype=torch.float64).item()

    low, high = 1e-6, 1e6
    if not accuracy(low) < target < accuracy(high):
        raise InputError(
            f"an accuracy of {target} cannot be reached: tau between {low:g} and {high:g} gives "
            f"{accuracy(low):.3f} to {accuracy(high):.3f}; give tau as a number"
        )
    while high / low > 1 + 1e-6:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if accuracy(middle) < target else (low, middle)
    return math.sqrt(low * high)
