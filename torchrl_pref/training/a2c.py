"""Advantage actor-critic (A2C): one gradient step on each batch."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.objectives import A2CLoss

from torchrl_pref.policies.base import Policy
from torchrl_pref.training.actor_critic import ActorCritic
from torchrl_pref.training.settings import TrainingSettings


class A2C(ActorCritic):
    """Actions become more likely by as much as they turned out better than the critic foresaw.

    Args:
        policy: what learns.
        settings: the constants of the training.
    """

    def __init__(self, policy: Policy, settings: TrainingSettings) -> None:
        loss = A2CLoss(
            actor_network=policy.actor,
            critic_network=policy.value,
            entropy_coeff=settings.entropy,
            critic_coeff=settings.critic,
            loss_critic_type="l2",
            functional=False,  # no copy of the weights is asked for, and a loss takes a third less
        )
        super().__init__(policy, loss, settings)

    def learn(self, flat: TensorDictBase, only_critic: bool) -> dict[str, float]:
        """One step on a whole batch (F)."""
        return self.step(flat, only_critic)
