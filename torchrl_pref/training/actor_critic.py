"""What A2C and PPO share: TorchRL's loss of an actor and its critic, the optimizer, gradient steps.

Shapes: F frames, the steps of all sessions of a batch in one row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.utils import clip_grad_norm_
from torchrl.objectives import LossModule

from torchrl_pref.policies.base import Policy
from torchrl_pref.training.settings import TrainingSettings


class ActorCritic(ABC):
    """An actor and its critic, and how they learn from a batch.

    Args:
        policy: what learns.
        loss: TorchRL's, of this policy: it gives ``loss_objective`` (the actor's), ``loss_critic``
            and, where entropy is rewarded, ``loss_entropy``, each with its coefficient.
        settings: the constants of the training.

    Attributes:
        learned: all weights that the loss depends on.
        optimizer: of these.
    """

    def __init__(self, policy: Policy, loss: LossModule, settings: TrainingSettings) -> None:
        self.policy, self.loss, self.settings = policy, loss, settings
        self.optimizer: torch.optim.Optimizer
        self.learned = list(loss.parameters())
        # All weights in one call ("foreach") are the same numbers in two thirds of the time.
        rate = settings.learning_rate
        if settings.optimizer == "adam":
            self.optimizer = torch.optim.Adam(self.learned, rate, foreach=True)
        else:
            self.optimizer = torch.optim.RMSprop(
                self.learned, rate, alpha=0.99, eps=1e-5, foreach=True
            )

    @abstractmethod
    def learn(self, flat: TensorDictBase, only_critic: bool) -> dict[str, float]:
        """The gradient steps of one update.

        Args:
            flat: a batch (F) with its advantages and returns.
            only_critic: whether the actor is to stay as it is.

        Returns:
            What :meth:`step` does, the mean over the steps.
        """

    def acted(self, flat: TensorDictBase) -> Distribution:
        """What the actions (F) were drawn from, by the logits that the batch has kept of them."""
        return self.policy.actor[-1].get_dist(flat)

    def step(self, flat: TensorDictBase, only_critic: bool) -> dict[str, float]:
        """One gradient step on a batch or a part of it (F).

        Returns:
            ``actor_loss``, as TorchRL defines it for the algorithm; ``critic_loss``, the critic's
            mean squared error; ``gradient_norm``, the gradient's length before it is clipped.
        """
        losses = self.loss(flat)
        learning = "loss_critic" if only_critic else "loss_"
        total = sum(value for key, value in losses.items() if key.startswith(learning))
        norm = self._descend(total)
        return {
            "actor_loss": losses["loss_objective"].item(),
            "critic_loss": losses["loss_critic"].item() / self.settings.critic,
            "gradient_norm": norm.item(),
        }

    def fit_critic(self, flat: TensorDictBase) -> None:
        """Bring the critic nearer to the returns of a batch (F), in one pass over it."""
        if self.settings.critic_steps:
            shown = flat.select(*self.policy.value.in_keys, "value_target")
            for part in torch.randperm(len(shown)).chunk(self.settings.critic_steps):
                self._descend(self.loss.loss_critic(shown[part])[0].mean())

    def _descend(self, loss: Tensor) -> Tensor:
        """One step of the optimizer, for the weights that the loss depends on.

        Returns:
            The length of the gradient before it is clipped.
        """
        self.optimizer.zero_grad()
        loss.backward()
        norm = clip_grad_norm_(self.learned, self.settings.grad_norm)
        self.optimizer.step()
        return norm
