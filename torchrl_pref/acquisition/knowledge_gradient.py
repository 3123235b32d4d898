"""The knowledge gradient: how much better the best trajectory will be, once an answer is there.

Shapes: C candidate queries, M belief samples, R possible answers, D features, T trajectories, ``…``
any leading dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.questions.response_model import Prediction
from torchrl_pref.tensors import directions

HELD = 200_000
"""Returns of trajectories (C R t) held at once: bounds memory, fits the cache."""


@dataclass(frozen=True, eq=False)
class KnowledgeGradient:
    r"""Expected rise, by an answer, of the return of the trajectory that is thought to be best.

    .. math:: \sum_q P(q) \max_n E[\omega \mid q]^\top \varphi_n - \max_n E[\omega]^\top \varphi_n

    Frazier, Powell and Dayanik, *A knowledge-gradient policy for sequential information
    collection*, 2008; of a question with several options it is the expected value of information of
    Viappiani and Boutilier, *Optimal Bayesian recommendation sets and myopically optimal choice
    query sets*, 2010. ω is the direction of a sample. What changes no choice is worth nothing here,
    however much it tells of ω.

    Attributes:
        trajectories: (T D), the features of all that may be chosen in the end.

    Raises:
        InputError: these are no features of trajectories.
    """

    trajectories: Tensor

    def __post_init__(self) -> None:
        if self.trajectories.ndim != 2 or not len(self.trajectories):
            raise InputError(
                f"trajectories of shape {tuple(self.trajectories.shape)}: expected (T "
                "trajectories, D features); flatten a pool's by features.flatten(0, 1)"
            )
        object.__setattr__(self, "trajectories", self.trajectories.detach().unique(dim=0))

    def __call__(self, predicted: Prediction, samples: Tensor) -> Tensor:
        """The value of each candidate.

        Args:
            predicted: of the answers to C candidates, under M samples.
            samples: (… M D), the belief samples.

        Returns:
            (… C), at least 0, in units of the return; 0 where the options are alike.
        """
        batch, units = samples.shape[:-2], directions(samples)
        probs = predicted.probs.flatten(0, len(batch) - 1) if batch else predicted.probs[None]
        # One session at a time: each has other trajectories that may turn out best.
        each = zip(probs, units.reshape(-1, *units.shape[-2:]), strict=True)
        return torch.stack([self._rise(*one) for one in each]).view(*batch, -1)

    def _rise(self, probs: Tensor, samples: Tensor) -> Tensor:
        """The values (C) of candidates, from the answers (C M R) under unit samples (M D)."""
        mean = samples.mean(0)
        every = self.trajectories.to(samples)
        ahead = every - every[(every @ mean).argmax()]
        # P(q) E[ω|q] is P(q) E[ω] and this beside it, (C R D): nothing is divided by P(q), and a
        # small gain does not drown in the rounding of large returns.
        moved = torch.einsum("md,cmr->crd", samples - mean, probs) / len(samples)
        after = torch.cat([moved, probs.mean(1).unsqueeze(-1)], -1)
        rise = torch.zeros_like(after[..., 0])  # of what is best by now
        for part in ahead.split(max(1, HELD // max(len(samples), rise.numel(), 1))):
            # What is no better under any sample is none after an answer.
            part = part[(part @ samples.mT).amax(-1) > 0]
            if len(part):
                now = (part @ mean).clamp(max=0).unsqueeze(-1)
                later = after @ torch.cat([part, now], -1).mT
                rise = torch.maximum(rise, later.amax(-1))
        return rise.sum(-1)
