"""The paper's policy: perceptrons on the belief mean."""

from __future__ import annotations

import torch
from tensordict.nn import (
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from torchrl_pref.envs.session import is_feed
from torchrl_pref.policies.base import (
    Layer,
    Policy,
    _actor,
)


def paper_policy(env: EnvBase) -> Policy:
    """The paper's policy: perceptrons on the belief mean, and in the feed on the offered query.

    In the query setup an action is an index of the training pool and means nothing on another one.
    The networks are those of Stable-Baselines3's ``MlpPolicy``, two hidden layers of 64 tanh units
    for the actor and as many for the critic (https://stable-baselines3.readthedocs.io), but with
    torch's initialisation and not the orthogonal one.

    Args:
        env: gives the sizes.
    """
    device = torch.device(env.device)
    size = env.features.shape[-1]
    state_keys = ["mean"]
    observe = None
    if is_feed(env):
        size += env.features[0].numel()
        state_keys = ["mean", "flat_offer"]
        observe = Layer(lambda offer: offer.flatten(-2), in_keys=["offer"], out_keys=["flat_offer"])
    cells = {"num_cells": [64, 64], "activation_class": nn.Tanh, "device": device}
    network = MLP(size, env.action_spec.space.n, **cells)
    logits = Layer(network, in_keys=state_keys, out_keys=["logits"])
    critic: TensorDictModuleBase = Layer(
        MLP(size, 1, **cells), in_keys=state_keys, out_keys=["state_value"]
    )
    if observe is not None:
        critic = TensorDictSequential(observe, critic)
    return Policy(observe, _actor(logits, env), critic)
