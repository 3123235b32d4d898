"""Strategies that choose from candidates, by what is known now.

Shapes: B sessions, C candidates, M belief samples, n questions asked at once.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator

from torchrl_pref.acquisition.functions import Acquisition, information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.errors import check_count
from torchrl_pref.questions.response_model import ResponseModel


class RandomQuery(TensorDictModuleBase):
    """Ask any allowed candidate, uniformly.

    Args:
        seed: seeds the strategy's own generator.
        batch: n, different candidates in one action.
    """

    in_keys = ["action_mask"]
    out_keys = ["action"]

    def __init__(self, seed: int = 0, batch: int = 1) -> None:
        super().__init__()
        self.batch = check_count("batch", batch, 1)
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B), or (B n) of a batch."""
        mask = tensordict["action_mask"]
        keys = torch.rand(mask.shape, generator=self.generator).to(mask.device)
        keys = keys.masked_fill(~mask, -1)
        if self.batch == 1:
            return tensordict.set("action", keys.argmax(-1))
        return tensordict.set("action", keys.topk(self.batch, -1).indices)


class Greedy(TensorDictModuleBase):
    """Ask the allowed candidate of highest acquisition value; the first one where they tie.

    Args:
        response_model: how the belief thinks the human answers.
        acquisition: the value of a candidate; information gain by default.
    """

    in_keys = ["samples", "queries", "action_mask"]
    out_keys = ["action"]

    def __init__(
        self,
        response_model: ResponseModel,
        acquisition: Acquisition = information_gain,
    ) -> None:
        super().__init__()
        self.response_model = response_model
        self.acquisition = acquisition

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        values = score_queries(
            tensordict["samples"], tensordict["queries"], self.response_model, self.acquisition
        )
        allowed = values.masked_fill(~tensordict["action_mask"], -math.inf)
        return tensordict.set("action", allowed.argmax(-1))


class Thompson(TensorDictModuleBase):
    """Draw two samples of the belief, and let a strategy decide as if there were no others.

    Thompson sampling where options are compared (Novoseller, Wei, Sui, Yue and Burdick, *Dueling
    posterior sampling for preference-based reinforcement learning*, 2020) shows the best trajectory
    of each of two samples. Of queries that are there already, the one is asked by whose options the
    two have most at stake: max regret of a belief in these two alone.

    Args:
        strategy: decides by two samples; greedily by max regret, or in a feed by its quantile.
        seed: seeds the strategy's own generator.
    """

    out_keys = ["action"]

    def __init__(self, strategy: TensorDictModuleBase, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.strategy = strategy.in_keys, strategy
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        samples = tensordict["samples"]
        keys = torch.rand(samples.shape[:2], generator=self.generator).to(samples.device)
        drawn = keys.topk(min(2, keys.shape[1])).indices.unsqueeze(-1)
        two = tensordict.select(*self.in_keys).set("samples", samples.take_along_dim(drawn, 1))
        return tensordict.set("action", self.strategy(two)["action"])
