"""What tasks have in common whose trajectories are there already, as in a file.

Letters: N trajectories or queries, K options per query, D features.
"""

from __future__ import annotations

import copy
import math
from typing import TypeVar

import torch
from torch import Generator, Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.base import Task, feature_bars
from torchrl_pref.tasks.scene import Scene

Self = TypeVar("Self", bound="RecordedTask")


class RecordedTask(Task):
    """Trajectories that are there already; in a pool stand their numbers.

    Trajectories on their own are put together to queries: each is in about as many as another, and
    never twice in one. Queries that are given stay as they are.

    Args:
        source: what they are of, for messages.
        features: (N D) of trajectories, or (N K D) of queries.
        names: D, what the features are called.
    """

    def __init__(self, source: str, features: Tensor, names: tuple[str, ...]) -> None:
        self.feature_names, self._source = names, source
        self._features = features.reshape(-1, len(names))
        n_options = features.shape[1] if features.ndim == 3 else 1
        self._rows = torch.arange(len(self._features)).view(-1, n_options)

    def split(self: Self, seed: int) -> tuple[Self, Self]:
        """See :meth:`Task.split`: a half each, drawn by the seed."""
        order = torch.randperm(len(self._rows), generator=Generator().manual_seed(seed))
        halves = []
        for chosen in order.tensor_split(2):
            half = copy.copy(self)
            half._rows = self._rows[chosen]
            halves.append(half)
        return halves[0], halves[1]

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: the features as bars, each as far from its mean over all
        trajectories as there are standard deviations, at most three."""
        features = self.features(trajectory)
        deviation, mean = torch.std_mean(self._features, 0)
        sizes = ((features - mean) / deviation.clamp(min=1e-12)).clamp(-3, 3)
        return feature_bars(self.feature_names, features, sizes)

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: (count 1) int64, numbers of trajectories; they come again
        where there are fewer."""
        return _passes(self._rows.flatten(), count, 1, seed)

    def queries(self, n_queries: int, n_options: int, seed: int) -> Tensor:
        """See :meth:`Task.queries`: (N K 1) int64, numbers of trajectories.

        Raises:
            InputError: there are too few trajectories, or queries of another K.
        """
        n_rows, given = self._rows.shape
        if given == 1 and n_rows >= n_options:
            if math.comb(n_rows, n_options) > n_queries:
                chosen = _passes(self._rows.flatten(), n_queries, n_options, seed)
                return chosen.unsqueeze(-1)
            queries = torch.combinations(self._rows.flatten(), n_options)
        elif given == n_options and n_rows:
            queries = self._rows
        elif given > 1 and given != n_options:
            raise InputError(
                f"pool.options={n_options}: {self._source} holds queries of {given} options; set "
                f"pool.options={given}, or, where these are the steps of a trajectory, give one "
                "row of features for each trajectory, such as their means"
            )
        else:
            raise InputError(
                f"{self._source}: {n_rows} trajectories or queries are left for one of the two "
                f"pools; expected at least {n_options} trajectories, or one query, for each; add "
                "some"
            )
        order = torch.randperm(len(queries), generator=Generator().manual_seed(seed))
        return queries[order[:n_queries]].unsqueeze(-1)

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`: (… D), of numbers of trajectories (… 1)."""
        return self._features[trajectories.squeeze(-1)]


def _passes(rows: Tensor, count: int, n_options: int, seed: int) -> Tensor:
    """Rows (n) in groups (count K) from as many shufflings of them as it takes; (count) for K=1.

    A group lies within one shuffling, so that no row is in it twice.
    """
    generator, each = Generator().manual_seed(seed), len(rows) // n_options
    n_passes = -(-count // each)
    shuffled = [
        rows[torch.randperm(len(rows), generator=generator)[: each * n_options]]
        for _ in range(n_passes)
    ]
    return torch.cat(shuffled)[: count * n_options].view(count, n_options)
