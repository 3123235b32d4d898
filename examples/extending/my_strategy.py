"""A strategy of your own: ask about the two options that look most different, wherever they are.

python ../../evaluate.py setup=query strategy=my_strategy:most_different
"""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_pref import QueryEnv


class MostDifferent(TensorDictModuleBase):
    """Ask the allowed candidate whose options' features spread most, never one twice in a row."""

    in_keys = ["queries", "action_mask", "n_asked"]
    out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        spread = tensordict["queries"].std(-2).norm(dim=-1)  # (B C)
        allowed = spread.masked_fill(~tensordict["action_mask"], -1.0)
        ranked = allowed.argsort(-1, descending=True)
        place = tensordict["n_asked"] % ranked.shape[-1]
        return tensordict.set("action", torch.gather(ranked, -1, place).squeeze(-1))


def most_different(env: QueryEnv) -> TensorDictModuleBase:
    """A strategy for an environment."""
    return MostDifferent()
