"""The algorithms that ``algorithm=`` names."""

from __future__ import annotations

from collections.abc import Callable

from torchrl_pref.training.a2c import A2C
from torchrl_pref.training.actor_critic import ActorCritic
from torchrl_pref.training.ppo import PPO

ALGORITHMS: dict[str, Callable[..., ActorCritic]] = {"a2c": A2C, "ppo": PPO}
"""Each is made from a policy, the constants of the training and the keys of its own group."""
