"""Frames in a replay buffer, without a copy of the pool in each.

Shapes: N queries in the pool, C candidates of a session, K options per query, D features.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform


class PoolOnce(Transform):
    """A transform of a replay buffer: ``queries`` are left out as frames go in, and put back as
    they are sampled.

    A frame of a ``QueryEnv`` that shows 1,000 queries takes 75 kB, and 64 of them are the pool,
    twice. What is sampled is bit for bit what went in.

    Args:
        env: a ``QueryEnv``, transformed or not, whose ``queries`` are as the pool has them.
    """

    features: Tensor

    def __init__(self, env: EnvBase) -> None:
        super().__init__(in_keys=["queries"], out_keys=["queries"])
        self.register_buffer("features", env.features)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.exclude("queries", ("next", "queries"))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Put ``queries`` (… C K D) back, at the root and under ``next``."""
        tensordict = tensordict.copy()  # what comes from a storage is the storage's own
        candidates = tensordict.get("candidates", None)
        if candidates is None:
            queries = self.features.expand(*tensordict.shape, *self.features.shape)
        else:
            queries = self.features[candidates]
        tensordict.set("queries", queries)
        if "next" in tensordict.keys():  # noqa: SIM118
            tensordict.set(("next", "queries"), queries)
        return tensordict
