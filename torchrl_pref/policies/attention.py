"""The attention policy's network: candidates look at the belief, with no greedy score to lean on.

Shapes: B sessions, C candidates, M belief samples, K options per query, D features, W width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from torchrl_pref.beliefs.per_belief import PerBelief
from torchrl_pref.beliefs.resampling import covariance_of
from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import check_choice
from torchrl_pref.policies.base import (
    Layer,
    Policy,
    _actor,
    _belief_critic,
    _belief_features,
    belief_summary,
    compared,
)
from torchrl_pref.tensors import directions

WIDTH, HEADS = 32, 4

TOKENS = ("samples", "covariance", "mean")


def belief_tokens(samples: Tensor, kind: str) -> Tensor:
    """What of the belief a policy may look at, as points (B T D).

    ``samples`` are all M of them; ``covariance`` keeps mean and covariance, as the 2D + 1 points
    m, m ± √λ v for each eigenvector v of eigenvalue λ; ``mean`` keeps the mean alone.
    """
    if kind == "samples":
        return samples
    mean = samples.mean(1, keepdim=True)
    if kind == "mean":
        return mean
    variances, axes = torch.linalg.eigh(covariance_of(samples))
    steps = (axes * variances.clamp(min=0).sqrt().unsqueeze(-2)).mT
    return torch.cat([mean, mean + steps, mean - steps], 1)


class AttentionScorer(nn.Module):
    """One number per candidate: each option attends to the belief's points, options are summed.

    Args:
        n_features: D; unlike the scorer, the network is made for one D.
        n_shares: how many shares of the session (asks left, offers left) it is told.
        tokens: what of the belief it may look at, see :func:`belief_tokens`.
        device: where the weights live.
    """

    def __init__(self, n_features: int, n_shares: int, tokens: str, device: torch.device) -> None:
        super().__init__()
        self.tokens = tokens
        cells = {"num_cells": [WIDTH], "activation_class": nn.Tanh, "device": device}
        self.option = MLP(n_features, WIDTH, **cells)
        self.point = MLP(n_features, 2 * WIDTH, **cells)
        self.head = MLP(2 * WIDTH + n_shares, WIDTH, **cells)
        self.value = nn.Linear(WIDTH, 1, device=device)
        # Every candidate is as good as any other until it learns.
        nn.init.zeros_(self.value.weight)

    def forward(self, samples: Tensor, queries: Tensor, shares: Tensor) -> Tensor:
        """From samples (B M D), candidates (B C K D) and shares (B s) to scores (B C)."""
        candidates, options = queries.shape[1:3]
        shown = self.option(compared(queries).flatten(1, 2))
        keys, values = self.point(belief_tokens(directions(samples), self.tokens)).chunk(2, -1)
        split = [part.unflatten(-1, (HEADS, -1)).transpose(1, 2) for part in (shown, keys, values)]
        seen = F.scaled_dot_product_attention(*split).transpose(1, 2).flatten(2)
        shares = shares.unsqueeze(1).expand(-1, seen.shape[1], -1)
        hidden = self.head(torch.cat([shown, seen, shares], -1)).tanh()
        return self.value(hidden.unflatten(1, (candidates, options)).sum(2)).squeeze(-1)


class OfferAttention(AttentionScorer):
    """The logits of skip and ask from the score of the one candidate that is offered."""

    def forward(self, samples: Tensor, offer: Tensor, shares: Tensor) -> Tensor:
        """From samples (B M D), offer (B K D) and shares (B s) to logits (B 2)."""
        ask = super().forward(samples, offer.unsqueeze(1), shares)
        return torch.cat([torch.zeros_like(ask), ask], -1)


def attention_policy(env: EnvBase, tokens: str = "samples") -> Policy:
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
    kind, shown = (OfferAttention, "offer") if is_feed(env) else (AttentionScorer, "queries")
    network = kind(env.features.shape[-1], n_shares, tokens, device)
    logits = Layer(network, in_keys=["samples", shown, "remaining"], out_keys=["logits"])
    observe = _belief_features(PerBelief(belief_summary))
    return Policy(observe, _actor(logits, env), _belief_critic(n_shares, device))
