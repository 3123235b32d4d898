"""A policy of your own: a perceptron scores each candidate from its gap and the mean belief.

python ../../train.py setup=query policy=my_policy:perceptron policy.width=32
"""

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, ValueOperator

from torchrl_pref import QueryEnv
from torchrl_pref.policies.base import Layer, Policy


class Scores(nn.Module):
    """One logit per candidate: how much its options differ for the mean belief, and at all.

    Args:
        width: of the hidden layer.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.network = MLP(2, 1, num_cells=[width], activation_class=nn.Tanh)

    def forward(self, mean: Tensor, queries: Tensor) -> Tensor:
        """From the mean belief (B D) and candidates (B C K D) to logits (B C)."""
        gap = queries[..., 0, :] - queries[..., 1, :]
        seen = torch.stack([(gap @ mean.unsqueeze(-1)).squeeze(-1).abs(), gap.norm(dim=-1)], -1)
        return self.network(seen).squeeze(-1)


def perceptron(env: QueryEnv, width: int = 32) -> Policy:
    """An actor and a critic for an environment."""
    logits = Layer(Scores(width), in_keys=["mean", "queries"], out_keys=["logits"])
    actor = ProbabilisticActor(
        TensorDictSequential(logits),
        in_keys={"logits": "logits", "mask": "action_mask"},
        distribution_class=MaskedCategorical,
        return_log_prob=False,
    )
    n_features = env.observation_spec["mean"].shape[-1]
    critic = ValueOperator(MLP(n_features, 1, num_cells=[width]), in_keys=["mean"])
    return Policy(observe=None, actor=actor, critic=critic)
