"""Frames in a replay buffer, without a copy of the pool in each.

Shapes: N queries in the pool, C candidates of a session, K options per query, D features.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import InputError


class PoolOnce(Transform):
    """A transform of a replay buffer: ``queries`` are left out as frames go in, and put back as
    they are sampled.

    A frame of a ``QueryEnv`` that shows 1,000 queries takes 75 kB, and 64 of them are the pool,
    twice. What is sampled is bit for bit what went in.

    Args:
        env: a ``QueryEnv``, transformed or not, whose ``queries`` are as the pool has them.

    Raises:
        InputError: it is no such environment; or, as frames go in, a transform rewrote them.
    """

    features: Tensor

    def __init__(self, env: EnvBase) -> None:
        super().__init__(in_keys=["queries"], out_keys=["queries"])
        if is_feed(env):
            raise InputError(
                "PoolOnce of a feed, whose frames hold no queries: expected a QueryEnv; leave "
                "PoolOnce out"
            )
        self.register_buffer("features", env.features)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        queries = tensordict.get("queries", None)
        if queries is not None and tensordict.numel():
            first = tensordict.select("queries", "candidates", strict=False).reshape(-1)[0]
            if not torch.equal(first["queries"], self._queries_of(first)):
                raise InputError(
                    "PoolOnce with queries that are not the pool's: a transform rewrote them, and "
                    "they could not be put back; leave PoolOnce out, or let the transform write "
                    "another key"
                )
        return tensordict.exclude("queries", ("next", "queries"))

    def _queries_of(self, frames: TensorDictBase) -> Tensor:
        """(… C K D), what frames (…) show."""
        candidates = frames.get("candidates", None)
        if candidates is None:
            return self.features.expand(*frames.shape, *self.features.shape)
        return self.features[candidates]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Put ``queries`` (… C K D) back, at the root and under ``next``."""
        tensordict = tensordict.copy()  # what comes from a storage is the storage's own
        queries = self._queries_of(tensordict)
        tensordict.set("queries", queries)
        if "next" in tensordict.keys():  # noqa: SIM118
            tensordict.set(("next", "queries"), queries)
        return tensordict
