"""What follows from a belief alone is computed once for each belief, not once for each step.

Shapes: B sessions, M belief samples, D features.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


class PerBelief:
    """A function of the samples, computed anew only for the sessions whose belief has changed.

    In a feed most offers are skipped, and a skip leaves the belief as it is. The samples themselves
    tell, so nothing has to say when a belief changes or a session ends.

    Args:
        function: from samples (B M D) to values (B …), each session's by itself.
    """

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        self.function = function
        self._samples, self._values = torch.empty(0), torch.empty(0)

    def __call__(self, samples: Tensor) -> Tensor:
        """The values (B …) of samples (B M D)."""
        if samples.requires_grad:
            return self.function(samples)
        if _is_one_belief(samples):
            one = self(samples[:1])
            return one.expand(len(samples), *one.shape[1:])
        known = self._samples
        if known.shape != samples.shape or known.device != samples.device:
            who = torch.arange(len(samples), device=samples.device)
        else:
            who = (known != samples).flatten(1).any(1).nonzero().squeeze(-1)
        if len(who) == len(samples):
            self._values = self.function(samples)
        elif len(who):
            # Not in place: who was given the old values may still hold them.
            self._values = self._values.index_copy(0, who, self.function(samples[who]))
        if len(who):
            self._samples = samples.clone()
        return self._values


def _is_one_belief(samples: Tensor) -> bool:
    """Whether several rows (B M D) are all the same, as where one session sees several offers."""
    if len(samples) < 2 or not torch.equal(samples[0], samples[1]):
        return False
    return bool((samples == samples[:1]).all())
