"""The scorer: what it sees of each candidate and of the belief, and the networks on top.

Shapes: B sessions, C candidates, M belief samples, K options per query, D features,
F features of a candidate, G features of the belief.
"""

from __future__ import annotations

import math

import torch
from tensordict.nn import (
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from torchrl_pref.acquisition.functions import (
    Acquisition,
    alignment_gain,
    information_gain,
    volume_removal,
)
from torchrl_pref.acquisition.scoring import score_queries, standardise, together
from torchrl_pref.beliefs.per_belief import PerBelief
from torchrl_pref.beliefs.resampling import covariance_of
from torchrl_pref.envs.objectives import OBJECTIVES
from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import check_choice
from torchrl_pref.policies.base import (
    N_BELIEF,
    Layer,
    Policy,
    _actor,
    _belief_critic,
    _belief_features,
    belief_summary,
    compared,
)
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.strategies.feed import OfferRank, asks_over_offers
from torchrl_pref.tensors import directions

N_CANDIDATE = 7
"""F, see :class:`CandidateFeatures`."""


QUERY_SCALE, FEED_SCALE = 8.0, 30.0
"""Logits per standard deviation of the greedy score, and per unit of rank, before training."""

PATIENCE_SCALE = 20.0
"""Patience per unit of its parameters: they are few, and may move further than a weight."""


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
        self.moments = PerBelief(_moments)

    def forward(self, samples: Tensor, queries: Tensor) -> Tensor:
        """From samples (B M D) and candidates (B C K D) to features (B C F)."""
        moments = self.moments(samples)
        mean, covariance = moments[:, 0], moments[:, 1:]
        gain, alignment, removal = score_queries(
            samples,
            queries,
            self.response_model,
            together(information_gain, alignment_gain, volume_removal),
        ).unbind(-1)
        centred = compared(queries)
        variance = ((centred @ covariance.unsqueeze(1)) * centred).sum((-2, -1))
        apart = (centred @ mean[:, None, :, None]).squeeze(-1).norm(dim=-1)
        length = centred.square().sum((-2, -1)).sqrt()
        return torch.stack(
            [gain, alignment, removal, variance.clamp(min=0).sqrt(), variance, apart, length],
            -1,
        )


GREEDY: tuple[Acquisition, ...] = (information_gain, alignment_gain)
"""What greedy strategies ask by, in the order of the candidate features."""


def greedy_feature(objective: str) -> int:
    """Which candidate feature is the objective's forecast: the score of its greedy strategy.

    Raises:
        InputError: there is no such objective.
    """
    check_choice("policy.start", objective, tuple(OBJECTIVES))
    return 1 if objective in ("alignment", "true_alignment") else 0


class QueryScorer(nn.Module):
    """One logit per candidate: scale · (greedy score + learned correction).

    The greedy score is the objective's forecast in standard deviations over the candidates, so that
    one scale serves any objective, noise and stage. The correction is zero at the start: training
    starts from the objective's greedy strategy with a little exploration, not from nothing.
    """

    def __init__(self, greedy: int, n_remaining: int, device: torch.device) -> None:
        super().__init__()
        self.greedy = greedy
        self.log_scale = nn.Parameter(torch.tensor(math.log(QUERY_SCALE), device=device))
        self.network = _zero_headed_mlp(2 * N_CANDIDATE + N_BELIEF + n_remaining, device)

    def forward(self, candidates: Tensor, belief: Tensor) -> Tensor:
        """From candidate features (B C F) and belief features (B G) to logits (B C)."""
        standard = standardise(candidates)
        belief = belief.unsqueeze(-2).expand(*candidates.shape[:-1], -1)
        correction = self.network(torch.cat([candidates, standard, belief], -1)).squeeze(-1)
        return self.log_scale.exp() * (standard[..., self.greedy] + correction)


class OfferScorer(nn.Module):
    """The logits of skip and ask for one offer, started at a budget-aware quantile rule.

    That rule asks if the offer ranks among the best share of a reference sample of the pool, the
    share being asks left over offers left. Here the share is multiplied by exp(*patience* ·
    urgency), two numbers each. The first makes the share larger the more asks are to come, the
    second the less sure the belief is (and smaller once the misalignment it expects is below 1/e).
    The patience is learned; it and a correction of the logits are zero at the start.
    """

    def __init__(self, n_remaining: int, device: torch.device) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(FEED_SCALE), device=device))
        self.patience = nn.Parameter(torch.zeros(2, device=device))
        self.network = _zero_headed_mlp(N_CANDIDATE + 1 + 1 + N_BELIEF + n_remaining, device)

    def forward(
        self, offer: Tensor, rank: Tensor, share: Tensor, urgency: Tensor, belief: Tensor
    ) -> Tensor:
        """From offer features (B F), its rank (B 1), the share of the best that the rule asks
        (B 1), urgency (B 2) and belief features (B G) to logits (B 2)."""
        patience = PATIENCE_SCALE * self.patience
        eager = (share * (urgency @ patience).exp().unsqueeze(-1)).clamp(max=1)
        # At a share of 1 all that are left are asked, for certain.
        margin = rank - (1 - eager) + (share >= 1)
        correction = self.network(torch.cat([offer, rank, share, belief], -1))
        # The correction is in logits: in ranks, as small a step would be a large one.
        ask = self.log_scale.exp() * margin + correction
        return torch.cat([torch.zeros_like(ask), ask], -1)


class OfferFeatures(nn.Module):
    """The features of the one offered query, and its rank among a reference sample of the pool.

    Args:
        env: gives the response model, the pool and the budgets.
        start: the objective by whose greedy score it is ranked; None: by information gain at the
            first ask, and all but 1/H by expected alignment gain at the last.
    """

    def __init__(self, env: EnvBase, start: str | None = None) -> None:
        super().__init__()
        self.features = CandidateFeatures(env.belief.response_model)
        self.budget, self.n_offers = env.budget, env.n_offers
        if start is None:
            self.rank = OfferRank(env, information_gain, late=alignment_gain)
        else:
            self.rank = OfferRank(env, GREEDY[greedy_feature(start)])
        self.unsure = PerBelief(_unsure)

    def forward(
        self, samples: Tensor, offer: Tensor, n_asked: Tensor, n_offered: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """From samples (B M D), offer (B K D) and counts (B 1) to offer features (B F), the rank
        (B 1), asks left over offers left (B 1), and urgency (B 2): the log of the mean number of
        the asks left over that of the next, and one plus the log of the misalignment 1 - ‖E[ω]‖²
        that the belief expects."""
        rank = self.rank(samples, offer, 1 - n_asked / self.budget)
        share = asks_over_offers(n_asked, n_offered, self.budget, self.n_offers)
        later = (0.5 + 0.5 * self.budget / (n_asked + 1)).clamp(min=1)
        urgency = torch.cat([later.log(), self.unsure(samples)], -1)
        return self.features(samples, offer.unsqueeze(1)).squeeze(1), rank, share, urgency


def _moments(samples: Tensor) -> Tensor:
    """Mean, and below it covariance (B 1+D D), of the directions of samples (B M D)."""
    samples = directions(samples)
    return torch.cat([samples.mean(1, keepdim=True), covariance_of(samples)], 1)


def _unsure(samples: Tensor) -> Tensor:
    """One plus the log of the misalignment (B 1) that a belief (B M D) expects."""
    misaligned = 1 - directions(samples).mean(1).square().sum(-1, keepdim=True)
    # Plus one: a log that is never above 0 could only lower the share, not raise it. The floor
    # bounds what a belief that is all but certain can ask of the patience.
    return misaligned.clamp(min=1e-3).log() + 1


def _zero_headed_mlp(n_inputs: int, device: torch.device) -> MLP:
    """A small perceptron whose output is zero until it learns."""
    network = MLP(n_inputs, 1, num_cells=[32], activation_class=nn.Tanh, device=device)
    nn.init.zeros_(network[-1].weight)
    nn.init.zeros_(network[-1].bias)
    return network


def scorer_policy(env: EnvBase, start: str | None = None) -> Policy:
    """The default policy: a shared network scores each candidate, so any pool of any size will do.

    Args:
        env: gives the response model of the belief, the objective and the kind of decision.
        start: the objective whose greedy strategy it starts from, in a feed its quantile rule. By
            default it is the environment's own, and in a feed information gain first and alignment
            last.

    Raises:
        InputError: there is no such objective.
    """
    device = torch.device(env.device)
    n_shares = env.observation_spec["remaining"].shape[-1]
    if not is_feed(env):
        features = Layer(
            CandidateFeatures(env.belief.response_model),
            in_keys=["samples", "queries"],
            out_keys=["candidate_features"],
        )
        greedy = greedy_feature(env.objective if start is None else start)
        network: nn.Module = QueryScorer(greedy, n_shares, device)
    else:
        features = Layer(
            OfferFeatures(env, start),
            in_keys=["samples", "offer", "n_asked", "n_offered"],
            out_keys=["offer_features", "rank", "share", "urgency"],
        )
        network = OfferScorer(n_shares, device)
    logits = Layer(network, in_keys=[*features.out_keys, "belief_features"], out_keys=["logits"])
    observe = TensorDictSequential(features, _belief_features(PerBelief(belief_summary)))
    return Policy(observe, _actor(logits, env), _belief_critic(n_shares, device))
