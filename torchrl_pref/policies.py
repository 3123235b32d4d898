"""Learned strategies: the paper's and the scorer, each an actor and a critic.

Shapes: B sessions, C candidates, M belief samples, K options per query, D features,
F features of a candidate, G features of the belief.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import MLP, MaskedCategorical, ProbabilisticActor, ValueOperator

from torchrl_pref.acquisition import (
    expected_alignment,
    information_gain,
    score_queries,
    volume_removal,
)
from torchrl_pref.belief import covariance_of
from torchrl_pref.envs import FeedEnv, QueryEnv
from torchrl_pref.responses import Prediction, ResponseModel

N_CANDIDATE = 7
"""F, see :class:`CandidateFeatures`."""

N_BELIEF = 4
"""G less the shares that remain, see :class:`BeliefFeatures`."""


@dataclass(frozen=True)
class Policy:
    """An actor-critic pair that fits one environment.

    Attributes:
        observe: what the networks read, computed once per step and stored with the data, or None.
        actor: from what ``observe`` wrote to ``action``; the A2C loss calls it again.
        critic: from the session to ``state_value``.
    """

    observe: TensorDictModuleBase | None
    actor: ProbabilisticTensorDictSequential
    critic: TensorDictModuleBase

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


class CandidateFeatures(nn.Module):
    """What the belief knows about each candidate, whichever option is listed first.

    Information gain (bits), expected gain in alignment, volume removal, standard deviation and
    variance under the belief of how the options' returns differ, how the mean belief tells them
    apart, and how their features differ. Nothing depends on D, on C or on the order of the options.

    Args:
        response_model: how the belief thinks the human answers.
    """

    def __init__(self, response_model: ResponseModel) -> None:
        super().__init__()
        self.response_model = response_model

    def forward(self, samples: Tensor, queries: Tensor) -> Tensor:
        """From samples (B M D) and candidates (B C K D) to features (B C F)."""
        mean = samples.mean(1)

        gain, alignment, removal = score_queries(
            samples, queries, self.response_model, _all_acquisitions
        ).unbind(-1)
        centred = queries - queries.mean(-2, keepdim=True)
        covariance = covariance_of(samples)
        variance = ((centred @ covariance.unsqueeze(1)) * centred).sum((-2, -1))
        apart = (centred @ mean[:, None, :, None]).squeeze(-1).norm(dim=-1)
        now = mean.square().sum(-1, keepdim=True)
        length = centred.square().sum((-2, -1)).sqrt()
        return torch.stack(
            [gain, alignment - now, removal, variance.sqrt(), variance, apart, length], -1
        )


def _all_acquisitions(predicted: Prediction, samples: Tensor) -> Tensor:
    """Information gain, expected alignment and volume removal, (B C 3)."""
    functions = (information_gain, expected_alignment, volume_removal)
    return torch.stack([function(predicted, samples) for function in functions], -1)


class BeliefFeatures(nn.Module):
    """How far the session is and how sure the belief: the shares of asks (and offers) left, the
    length of the mean, and the log of the largest, mean and smallest variance of the samples."""

    def forward(self, samples: Tensor, remaining: Tensor) -> Tensor:
        """From samples (B M D) and shares (B 1 or 2) to features (B G)."""
        # Far below any spread of samples on the sphere, far above the rounding of float32.
        variances = torch.linalg.eigvalsh(covariance_of(samples)).clamp(min=1e-8)
        summary = [variances[..., -1], variances.mean(-1), variances[..., 0]]
        logs = torch.stack(summary, -1).log() / 4
        return torch.cat([remaining, samples.mean(-2).norm(dim=-1, keepdim=True), logs], -1)


class QueryScorer(nn.Module):
    """One number per candidate: its information gain, scaled, plus a learned correction.

    The correction is zero at the start, so that training starts from greedy information gain with a
    little exploration, not from nothing.
    """

    def __init__(self, n_remaining: int, device: torch.device) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(4.0, device=device))
        self.network = _zero_headed_mlp(N_CANDIDATE + N_BELIEF + n_remaining, device)

    def forward(self, candidates: Tensor, belief: Tensor) -> Tensor:
        """From candidate features (B C F) and belief features (B G) to logits (B C)."""
        belief = belief.unsqueeze(-2).expand(*candidates.shape[:-1], -1)
        correction = self.network(torch.cat([candidates, belief], -1)).squeeze(-1)
        gain = candidates[..., 0]
        return self.log_scale.exp() * (gain - gain.amax(-1, keepdim=True)) + correction


class OfferScorer(nn.Module):
    """The logits of skip and ask from the features of the one candidate that is offered."""

    def __init__(self, n_remaining: int, device: torch.device) -> None:
        super().__init__()
        self.network = _zero_headed_mlp(N_CANDIDATE + N_BELIEF + n_remaining, device)

    def forward(self, candidates: Tensor, belief: Tensor) -> Tensor:
        """From offer features (B 1 F) and belief features (B G) to logits (B 2)."""
        ask = self.network(torch.cat([candidates.squeeze(-2), belief], -1))
        return torch.cat([torch.zeros_like(ask), ask], -1)


def scorer_policy(env: QueryEnv | FeedEnv) -> Policy:
    """The default policy: a shared network scores each candidate, so any pool of any size will do.

    Args:
        env: gives the response model of the belief and the kind of decision.
    """
    device = torch.device(env.device)
    features = CandidateFeatures(env.belief.response_model)
    n_remaining = env.observation_spec["remaining"].shape[-1]
    belief_features = TensorDictModule(
        BeliefFeatures(), in_keys=["samples", "remaining"], out_keys=["belief_features"]
    )
    network: nn.Module
    if isinstance(env, QueryEnv):
        candidates = TensorDictModule(
            features, in_keys=["samples", "queries"], out_keys=["candidate_features"]
        )
        network = QueryScorer(n_remaining, device)
    else:
        candidates = TensorDictModule(
            lambda samples, offer: features(samples, offer.unsqueeze(-3)),
            in_keys=["samples", "offer"],
            out_keys=["candidate_features"],
        )
        network = OfferScorer(n_remaining, device)
    logits = TensorDictModule(
        network, in_keys=["candidate_features", "belief_features"], out_keys=["logits"]
    )
    value = ValueOperator(
        MLP(N_BELIEF + n_remaining, 1, num_cells=[32, 32], activation_class=nn.Tanh, device=device),
        in_keys=["belief_features"],
    )
    critic = TensorDictSequential(belief_features, value)
    return Policy(TensorDictSequential(candidates, belief_features), _actor(logits, env), critic)


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
        observe = TensorDictModule(
            lambda offer: offer.flatten(-2), in_keys=["offer"], out_keys=["flat_offer"]
        )
    cells = {"num_cells": [64, 64], "activation_class": nn.Tanh, "device": device}
    network = MLP(size, env.action_spec.space.n, **cells)
    logits = TensorDictModule(network, in_keys=state_keys, out_keys=["logits"])
    critic: TensorDictModuleBase = ValueOperator(MLP(size, 1, **cells), in_keys=state_keys)
    if observe is not None:
        critic = TensorDictSequential(observe, critic)
    return Policy(observe, _actor(logits, env), critic)


def _actor(logits: TensorDictModule, env: QueryEnv | FeedEnv) -> ProbabilisticActor:
    """A categorical actor, masked where the environment says what may be asked."""
    masked = isinstance(env, QueryEnv)
    return ProbabilisticActor(
        logits,
        in_keys={"logits": "logits", "mask": "action_mask"} if masked else ["logits"],
        distribution_class=MaskedCategorical if masked else torch.distributions.Categorical,
        return_log_prob=False,
    )


def _zero_headed_mlp(n_inputs: int, device: torch.device) -> MLP:
    """A small perceptron whose output is zero until it learns."""
    network = MLP(n_inputs, 1, num_cells=[32, 32], activation_class=nn.Tanh, device=device)
    nn.init.zeros_(network[-1].weight)
    nn.init.zeros_(network[-1].bias)
    return network
