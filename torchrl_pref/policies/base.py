"""Learned strategies, each an actor and a critic: the scorer, attention, and the paper's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor

from torchrl_pref.beliefs.resampling import covariance_of
from torchrl_pref.envs.session import is_feed
from torchrl_pref.tensors import directions


@dataclass(frozen=True)
class Policy:
    """An actor-critic pair that fits one environment.

    Attributes:
        observe: what the networks read and no session holds, computed once a step and stored with
            the data; None where they read the session itself.
        actor: from what ``observe`` wrote to ``action``; the A2C loss calls it again.
        critic: from the session to ``state_value``.
    """

    observe: TensorDictModuleBase | None
    actor: ProbabilisticTensorDictSequential
    critic: TensorDictModuleBase

    @property
    def value(self) -> TensorDictModuleBase:
        """The critic's network alone: from what ``observe`` wrote to ``state_value``."""
        last: TensorDictModuleBase = self.critic
        return last.module[-1] if isinstance(last, TensorDictSequential) else last

    @property
    def strategy(self) -> TensorDictModuleBase:
        """The whole policy, as a collector, a rollout and the evaluation run it. A training calls
        ``observe`` and the actor's modules, and draws from the distribution of the last."""
        modules = (self.actor,) if self.observe is None else (self.observe, self.actor)
        return Acting(*modules)

    @cached_property
    def weights(self) -> nn.ModuleDict:
        """All that is learned, to be saved and loaded by its ``state_dict``."""
        return nn.ModuleDict({"actor": self.actor, "critic": self.critic})


class Acting(TensorDictSequential):
    """Modules that act one after the other, and keep no gradients: a loss calls the actor again."""

    @torch.no_grad()
    def forward(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """Write ``action``, and what it was chosen by."""
        return super().forward(*args, **kwargs)


class PolicyKind(NamedTuple):
    """A way to make policies, and the sizes of a pool that a trained one is bound to."""

    make: Callable[..., Policy]
    """From an environment, and settings of its own, to an untrained policy."""
    query: str = ""
    """Which of N, K and D may not change where it chooses from candidates. One that is bound to N
    picks an index of its training pool, which means nothing on another."""
    feed: str = ""
    """The same where it decides on offers."""


class Layer(TensorDictModuleBase):
    """A module from tensors to tensors, read from a tensordict and written into it.

    TensorDictModule also takes what is no tensor, which costs it a search of the disk for h5py each
    time: a tenth of a step of one session.

    Args:
        module: what it gives is one tensor for each of ``out_keys``.
        in_keys, out_keys: names of its inputs and outputs.
    """

    def __init__(self, module: Callable[..., Any], in_keys: list[str], out_keys: list[str]) -> None:
        super().__init__()
        self.module, self.in_keys, self.out_keys = module, in_keys, out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Read, compute, write."""
        values = self.module(*(tensordict.get(key) for key in self.in_keys))
        values = (values,) if len(self.out_keys) == 1 else values
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict


def compared(queries: Tensor) -> Tensor:
    """Features of options (… K D) less their mean, so that only differences count; of a single
    option as they are: it is compared with the average trajectory, whose features are 0."""
    return queries if queries.shape[-2] == 1 else queries - queries.mean(-2, keepdim=True)


def _belief_features(summary: Callable[[Tensor], Tensor]) -> Layer:
    """What the critic reads of the belief."""
    return Layer(
        BeliefFeatures(summary), in_keys=["samples", "remaining"], out_keys=["belief_features"]
    )


def _belief_critic(n_shares: int, device: torch.device) -> TensorDictSequential:
    """The critic, from the session on: its own features remember nothing, so that it can be called
    on any batch and under ``torch.vmap``, as TorchRL's advantages do."""
    network = MLP(
        N_BELIEF + n_shares, 1, num_cells=[32, 32], activation_class=nn.Tanh, device=device
    )
    value = Layer(network, in_keys=["belief_features"], out_keys=["state_value"])
    return TensorDictSequential(_belief_features(belief_summary), value)


def _actor(logits: Layer, env: EnvBase) -> ProbabilisticActor:
    """A categorical actor, masked where the environment says what may be asked."""
    masked = not is_feed(env)
    return ProbabilisticActor(
        logits,
        in_keys={"logits": "logits", "mask": "action_mask"} if masked else ["logits"],
        distribution_class=MaskedCategorical if masked else torch.distributions.Categorical,
        return_log_prob=False,
    )


N_BELIEF = 4
"""G less the shares that remain, see :class:`BeliefFeatures`."""


class BeliefFeatures(nn.Module):
    """How far the session is and how sure the belief: the shares of asks (and offers) left, the
    length of the mean, and the log of the largest, mean and smallest variance of the samples.

    Args:
        summary: :func:`belief_summary`, or what remembers it.
    """

    def __init__(self, summary: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.summary = summary

    def forward(self, samples: Tensor, remaining: Tensor) -> Tensor:
        """From samples (B M D) and shares (B 1 or 2) to features (B G)."""
        return torch.cat([remaining, self.summary(directions(samples))], -1)


def belief_summary(samples: Tensor) -> Tensor:
    """Length of the mean and logs of variances (B 4) of samples (B M D)."""
    # Far below any spread of samples on the sphere, far above the rounding of float32.
    variances = torch.linalg.eigvalsh(covariance_of(samples)).clamp(min=1e-8)
    spread = [variances[..., -1], variances.mean(-1), variances[..., 0]]
    length = samples.mean(-2).norm(dim=-1, keepdim=True)
    return torch.cat([length, torch.stack(spread, -1).log() / 4], -1)
