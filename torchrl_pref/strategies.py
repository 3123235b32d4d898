"""Strategies that are not learned: modules that read a session and write ``action``.

Shapes: B sessions, C candidates, M belief samples, K options per query, D features.

A strategy is any TensorDictModule that writes ``action``; these and the learned policies run
through the same ``env.rollout``.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator

from torchrl_pref.acquisition import Acquisition, information_gain, score_queries
from torchrl_pref.errors import check_share
from torchrl_pref.responses import ResponseModel


class RandomQuery(TensorDictModuleBase):
    """Ask any allowed candidate, uniformly.

    Args:
        seed: seeds the strategy's own generator.
    """

    in_keys = ["action_mask"]
    out_keys = ["action"]

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        mask = tensordict["action_mask"]
        keys = torch.rand(mask.shape, generator=self.generator).to(mask.device)
        return tensordict.set("action", keys.masked_fill(~mask, -1).argmax(-1))


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


class RandomAsk(TensorDictModuleBase):
    """Ask each offer with a fixed probability; 1 asks everything.

    Args:
        probability: of asking, from 0 to 1.
        seed: seeds the strategy's own generator.

    Raises:
        InputError: ``probability`` is not between 0 and 1.
    """

    in_keys = ["offer"]
    out_keys = ["action"]

    def __init__(self, probability: float = 1.0, seed: int = 0) -> None:
        super().__init__()
        self.probability = check_share("probability", probability)
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        offer = tensordict["offer"]
        uniform = torch.rand(offer.shape[:-2], generator=self.generator).to(offer.device)
        return tensordict.set("action", (uniform < self.probability).long())
