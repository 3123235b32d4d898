"""Learned strategies, each an actor and a critic: the scorer, attention, and the paper's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, ValueOperator

from torchrl_pref.attention import TOKENS, AttentionScorer, OfferAttention
from torchrl_pref.envs import FeedEnv, QueryEnv
from torchrl_pref.errors import InputError, check_choice
from torchrl_pref.per_belief import PerBelief
from torchrl_pref.scorer import (
    N_BELIEF,
    BeliefFeatures,
    CandidateFeatures,
    OfferFeatures,
    OfferScorer,
    QueryScorer,
    belief_summary,
    greedy_feature,
)


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
        """The whole policy, as the collector and the evaluation run it."""
        if self.observe is None:
            return self.actor
        return TensorDictSequential(self.observe, self.actor)

    @property
    def weights(self) -> nn.ModuleDict:
        """All that is learned, to be saved and loaded by its ``state_dict``."""
        return nn.ModuleDict({"actor": self.actor, "critic": self.critic})


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


def scorer_policy(env: QueryEnv | FeedEnv, start: str | None = None) -> Policy:
    """The default policy: a shared network scores each candidate, so any pool of any size will do.

    Args:
        env: gives the response model of the belief, the objective and the kind of decision.
        start: the objective whose greedy strategy it starts from in the query setup; by default the
            environment's own. In the feed it starts from the quantile rule.

    Raises:
        InputError: there is no such objective, or ``start`` is given for a feed.
    """
    device = torch.device(env.device)
    n_shares = env.observation_spec["remaining"].shape[-1]
    if isinstance(env, QueryEnv):
        features = Layer(
            CandidateFeatures(env.belief.response_model),
            in_keys=["samples", "queries"],
            out_keys=["candidate_features"],
        )
        greedy = greedy_feature(env.objective if start is None else start)
        network: nn.Module = QueryScorer(greedy, n_shares, device)
    else:
        if start is not None:
            raise InputError(
                f"policy.start={start}: in the feed the scorer starts from the quantile rule; "
                "leave policy.start out, or set setup=query"
            )
        features = Layer(
            OfferFeatures(env),
            in_keys=["samples", "offer", "n_asked", "n_offered"],
            out_keys=["offer_features", "rank", "share", "urgency"],
        )
        network = OfferScorer(n_shares, device)
    logits = Layer(network, in_keys=[*features.out_keys, "belief_features"], out_keys=["logits"])
    observe = TensorDictSequential(features, _belief_features(PerBelief(belief_summary)))
    return Policy(observe, _actor(logits, env), _belief_critic(n_shares, device))


def attention_policy(env: QueryEnv | FeedEnv, tokens: str = "samples") -> Policy:
    """Learned from nothing: options attend to the belief, and no greedy score is among the inputs.

    Args:
        env: gives D and the kind of decision.
        tokens: what of the belief the policy sees: ``samples``, ``covariance`` or ``mean``.

    Raises:
        InputError: ``tokens`` is another word.
    """
    device = torch.device(env.device)
    check_choice("policy.tokens", tokens, TOKENS)
    n_shares = env.observation_spec["remaining"].shape[-1]
    kind, shown = (
        (AttentionScorer, "queries") if isinstance(env, QueryEnv) else (OfferAttention, "offer")
    )
    network = kind(env.features.shape[-1], n_shares, tokens, device)
    logits = Layer(network, in_keys=["samples", shown, "remaining"], out_keys=["logits"])
    observe = _belief_features(PerBelief(belief_summary))
    return Policy(observe, _actor(logits, env), _belief_critic(n_shares, device))


def _belief_features(summary: Callable[[Tensor], Tensor]) -> Layer:
    """What the critic reads of the belief."""
    return Layer(
        BeliefFeatures(summary), in_keys=["samples", "remaining"], out_keys=["belief_features"]
    )


def _belief_critic(n_shares: int, device: torch.device) -> TensorDictSequential:
    """The critic, from the session on: its own features remember nothing, so that it can be called
    on any batch and under ``torch.vmap``, as TorchRL's advantages do."""
    value = ValueOperator(
        MLP(N_BELIEF + n_shares, 1, num_cells=[32, 32], activation_class=nn.Tanh, device=device),
        in_keys=["belief_features"],
    )
    return TensorDictSequential(_belief_features(belief_summary), value)


def paper_policy(env: QueryEnv | FeedEnv) -> Policy:
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
    if isinstance(env, FeedEnv):
        size += env.features[0].numel()
        state_keys = ["mean", "flat_offer"]
        observe = Layer(lambda offer: offer.flatten(-2), in_keys=["offer"], out_keys=["flat_offer"])
    cells = {"num_cells": [64, 64], "activation_class": nn.Tanh, "device": device}
    network = MLP(size, env.action_spec.space.n, **cells)
    logits = Layer(network, in_keys=state_keys, out_keys=["logits"])
    critic: TensorDictModuleBase = ValueOperator(MLP(size, 1, **cells), in_keys=state_keys)
    if observe is not None:
        critic = TensorDictSequential(observe, critic)
    return Policy(observe, _actor(logits, env), critic)


def _actor(logits: Layer, env: QueryEnv | FeedEnv) -> ProbabilisticActor:
    """A categorical actor, masked where the environment says what may be asked."""
    masked = isinstance(env, QueryEnv)
    return ProbabilisticActor(
        logits,
        in_keys={"logits": "logits", "mask": "action_mask"} if masked else ["logits"],
        distribution_class=MaskedCategorical if masked else torch.distributions.Categorical,
        return_log_prob=False,
    )
