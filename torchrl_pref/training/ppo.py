"""Proximal policy optimisation (PPO): several gradient steps on a batch, held near its policy."""

from __future__ import annotations

from statistics import fmean

import torch
from tensordict import TensorDictBase
from torchrl.objectives import ClipPPOLoss

from torchrl_pref.config.checks import positive
from torchrl_pref.errors import check_count
from torchrl_pref.policies.base import Policy
from torchrl_pref.training.actor_critic import ActorCritic
from torchrl_pref.training.settings import TrainingSettings


class PPO(ActorCritic):
    """What A2C does, in several steps: an action gains nothing by becoming more likely, or less,
    than by a factor of ``1 ± clip_epsilon`` beside the policy that chose it.

    Advantages stay in units of the reward, so that ``training.entropy`` means what it does for A2C.

    Args:
        policy: what learns.
        settings: the constants of the training.
        clip_epsilon: how far the probability of an action is followed, as a share of what it was.
        epochs: passes over a batch.
        minibatches: parts of a batch, drawn anew in each pass; a gradient step is made on each.

    Raises:
        InputError: a constant is out of range.
    """

    def __init__(
        self,
        policy: Policy,
        settings: TrainingSettings,
        clip_epsilon: float = 0.2,
        epochs: int = 4,
        minibatches: int = 4,
    ) -> None:
        positive(1.0)("algorithm.clip_epsilon", clip_epsilon)
        self.epochs = check_count("algorithm.epochs", epochs, 1)
        self.minibatches = check_count("algorithm.minibatches", minibatches, 1)
        loss = ClipPPOLoss(
            actor_network=policy.actor,
            critic_network=policy.value,
            clip_epsilon=clip_epsilon,
            entropy_bonus=settings.entropy > 0,
            entropy_coeff=settings.entropy,
            critic_coeff=settings.critic,
            loss_critic_type="l2",
            functional=False,  # as in A2C
            log_explained_variance=False,  # the trainer measures it, over the whole batch
        )
        super().__init__(policy, loss, settings)

    def learn(self, flat: TensorDictBase, only_critic: bool) -> dict[str, float]:
        """A step on each part of a batch (F), in each pass over it."""
        keys = {*self.policy.actor.in_keys, *self.policy.value.in_keys, "action"}
        shown = flat.select(*keys, "advantage", "value_target")
        shown["action_log_prob"] = self.acted(flat).log_prob(flat["action"])
        steps = [
            self.step(shown[part], only_critic)
            for _ in range(self.epochs)
            for part in torch.randperm(len(shown)).chunk(self.minibatches)
        ]
        return {name: fmean(step[name] for step in steps) for name in steps[0]}
