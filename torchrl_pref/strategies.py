"""Strategies that are not learned: modules that read a session and write ``action``.

Shapes: B sessions, C candidates, M belief samples, K options per query, D features, n questions
asked at once.

A strategy is any TensorDictModule that writes ``action``; these and the learned policies run
through the same ``env.rollout``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor
from torchrl.envs import EnvBase

from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.acquisition.functions import Acquisition, information_gain
from torchrl_pref.acquisition.knowledge_gradient import KnowledgeGradient
from torchrl_pref.acquisition.pairs import max_regret
from torchrl_pref.acquisition.scoring import moments_among, predict_answers, score_queries, together
from torchrl_pref.beliefs.per_belief import PerBelief
from torchrl_pref.envs.session import is_feed
from torchrl_pref.envs.transition import OPEN
from torchrl_pref.errors import check_choice, check_count, check_share
from torchrl_pref.questions.response_model import ResponseModel

REFERENCE = 500
"""Queries of the pool among which a feed strategy ranks an offer."""


class RandomQuery(TensorDictModuleBase):
    """Ask any allowed candidate, uniformly.

    Args:
        seed: seeds the strategy's own generator.
        batch: n, different candidates in one action.
    """

    in_keys = ["action_mask"]
    out_keys = ["action"]

    def __init__(self, seed: int = 0, batch: int = 1) -> None:
        super().__init__()
        self.batch = check_count("batch", batch, 1)
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B), or (B n) of a batch."""
        mask = tensordict["action_mask"]
        keys = torch.rand(mask.shape, generator=self.generator).to(mask.device)
        keys = keys.masked_fill(~mask, -1)
        if self.batch == 1:
            return tensordict.set("action", keys.argmax(-1))
        return tensordict.set("action", keys.topk(self.batch, -1).indices)


class Greedy(TensorDictModuleBase):
    """Ask the allowed candidate of highest acquisition value; the first one where they tie.

    Args:
        response_model: how the belief thinks the human answers.
        acquisition: the value of a candidate; information gain by default.
    """

    in_keys = ["samples", "queries", "action_mask"]
    out_keys = ["action"]

    def __init__(
        self,
        response_model: ResponseModel,
        acquisition: Acquisition = information_gain,
    ) -> None:
        super().__init__()
        self.response_model = response_model
        self.acquisition = acquisition

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        values = score_queries(
            tensordict["samples"], tensordict["queries"], self.response_model, self.acquisition
        )
        allowed = values.masked_fill(~tensordict["action_mask"], -math.inf)
        return tensordict.set("action", allowed.argmax(-1))


class Thompson(TensorDictModuleBase):
    """Draw two samples of the belief, and let a strategy decide as if there were no others.

    Thompson sampling where options are compared (Novoseller, Wei, Sui, Yue and Burdick, *Dueling
    posterior sampling for preference-based reinforcement learning*, 2020) shows the best trajectory
    of each of two samples. Of queries that are there already, the one is asked by whose options the
    two have most at stake: max regret of a belief in these two alone.

    Args:
        strategy: decides by two samples; greedily by max regret, or in a feed by its quantile.
        seed: seeds the strategy's own generator.
    """

    out_keys = ["action"]

    def __init__(self, strategy: TensorDictModuleBase, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.strategy = strategy.in_keys, strategy
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        samples = tensordict["samples"]
        keys = torch.rand(samples.shape[:2], generator=self.generator).to(samples.device)
        drawn = keys.topk(min(2, keys.shape[1])).indices.unsqueeze(-1)
        two = tensordict.select(*self.in_keys).set("samples", samples.take_along_dim(drawn, 1))
        return tensordict.set("action", self.strategy(two)["action"])


class Lookahead(TensorDictModuleBase):
    """Ask the candidate whose information gain and best successor's sum to most: two steps ahead.

    The belief after each answer to the first query is the present one reweighted, so that all
    second steps are matrix products. Only the ``beam`` best first steps are followed.

    Args:
        response_model: how the belief thinks the human answers.
        beam: first steps to follow.
    """

    in_keys = ["samples", "queries", "action_mask", ("session", "history", "answers")]
    out_keys = ["action"]

    def __init__(self, response_model: ResponseModel, beam: int = 20) -> None:
        super().__init__()
        self.response_model = response_model
        self.beam = check_count("beam", beam, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        # One session at a time: the table of all second steps is large.
        actions = [self._choose(session) for session in tensordict.select(*self.in_keys).unbind(0)]
        return tensordict.set("action", torch.stack(actions))

    def _choose(self, session: TensorDictBase) -> Tensor:
        samples = session["samples"].unsqueeze(0)
        predicted = predict_answers(samples, session["queries"].unsqueeze(0), self.response_model)
        gain = information_gain(predicted, samples)[0]
        gain = gain.masked_fill(~session["action_mask"], -math.inf)
        probs = predicted.probs[0]  # (C M R)
        entropy = torch.special.entr(probs).sum(-1)
        value, first = gain.topk(min(self.beam, len(gain)))
        n_open = (session["session", "history", "answers"] == OPEN).sum()
        if n_open <= 1:  # no second step after the last
            return first[0]
        joint = probs[first].mT / probs.shape[1]  # (beam R M): P(answer and sample)
        of_answer = joint.sum(-1, keepdim=True)
        weights = joint / of_answer.clamp(min=1e-30)
        later = torch.stack([weights @ answer.T for answer in probs.unbind(-1)])
        # (beam R C), information gain of every second query after every first answer
        second = torch.special.entr(later).sum(0) - weights @ entropy.T
        best = second.masked_fill(~session["action_mask"], 0.0).amax(-1) / math.log(2)
        return first[(value + (of_answer.squeeze(-1) * best).sum(-1)).argmax()]


class RandomAsk(TensorDictModuleBase):
    """Ask each offer with a fixed probability; 1 asks everything.

    Args:
        probability: of asking, from 0 to 1.
        seed: seeds the strategy's own generator.

    Raises:
        InputError: ``probability`` is not between 0 and 1.
    """

    in_keys = ["offer"]
    out_keys = ["action"]

    def __init__(self, probability: float = 1.0, seed: int = 0) -> None:
        super().__init__()
        self.probability = check_share("probability", probability)
        self.generator = Generator().manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        offer = tensordict["offer"]
        uniform = torch.rand(offer.shape[:-2], generator=self.generator).to(offer.device)
        return tensordict.set("action", (uniform < self.probability).long())


class ThresholdAsk(TensorDictModuleBase):
    """Ask an offer of at least a fixed acquisition value, or when all that are left must be asked.

    Args:
        env: gives the response model and the budgets.
        threshold: in the units of the acquisition function.
        acquisition: the value of an offer; information gain by default.
    """

    in_keys = ["samples", "offer", "n_asked", "n_offered"]
    out_keys = ["action"]

    def __init__(
        self, env: EnvBase, threshold: float, acquisition: Acquisition = information_gain
    ) -> None:
        super().__init__()
        self.response_model, self.acquisition = env.belief.response_model, acquisition
        self.budget, self.n_offers, self.threshold = env.budget, env.n_offers, threshold

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        samples, offer, n_asked, n_offered = (tensordict[key] for key in self.in_keys)
        queries = offer.unsqueeze(1)
        value = score_queries(samples, queries, self.response_model, self.acquisition)
        share = asks_over_offers(n_asked, n_offered, self.budget, self.n_offers)
        ask = (value >= self.threshold) | (share >= 1)
        return tensordict.set("action", ask.squeeze(-1).long())


class QuantileAsk(TensorDictModuleBase):
    """Ask an offer that ranks among the best asks-left-over-offers-left of what may be offered.

    Args:
        env: gives the response model, the pool and the budgets.
        acquisition: the value of an offer; information gain by default.
        late: what takes its place, a share 1/H more with each ask; None: nothing does.
    """

    in_keys = ["samples", "offer", "n_asked", "n_offered"]
    out_keys = ["action"]

    def __init__(
        self,
        env: EnvBase,
        acquisition: Acquisition = information_gain,
        late: Acquisition | None = None,
    ) -> None:
        super().__init__()
        self.rank = OfferRank(env, acquisition, late)
        self.budget, self.n_offers = env.budget, env.n_offers

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        samples, offer, n_asked, n_offered = (tensordict[key] for key in self.in_keys)
        rank = self.rank(samples, offer, 1 - n_asked / self.budget)
        share = asks_over_offers(n_asked, n_offered, self.budget, self.n_offers)
        return tensordict.set("action", (rank >= 1 - share).squeeze(-1).long())


class OfferRank:
    """Where an offered query ranks in a sample of what the environment may offer.

    With two acquisition functions, each is standardised over the sample; the first is weighted by
    the share of asks left (1 at the first ask, 1/H at the last), the other by the rest. The
    sample's scores are kept for as long as a session's belief stays the same, as it does with each
    skip.

    Args:
        env: gives the response model and the pool; the sample is spread evenly over it.
        acquisition: what makes the score.
        late: what takes its place, a share 1/H more with each ask; None: nothing does.
    """

    def __init__(
        self, env: EnvBase, acquisition: Acquisition, late: Acquisition | None = None
    ) -> None:
        self.response_model = env.belief.response_model
        both = (acquisition,) if late is None else (acquisition, late)
        self.acquisition, self.n_scores = together(*both), len(both)
        places = torch.linspace(0, len(env.features) - 1, min(REFERENCE, len(env.features)))
        self.reference = env.features[places.long().to(env.features.device)]
        self.sizes = [len(self.reference), 1, 1]
        self._reference = PerBelief(self._score_reference)

    def __call__(self, samples: Tensor, offer: Tensor, left: Tensor) -> Tensor:
        """The share of the sample that the offer scores above, and half a step beyond, so that no
        rounding decides whether it reaches another share.

        Args:
            samples: (B M D), the belief.
            offer: (B K D), the offered query.
            left: (B 1), the share of the asks that is left.

        Returns:
            (B 1), from 1/2N to 1 + 1/2N for a sample of N.
        """
        standard, mean, deviation = self._reference(samples).split_with_sizes(self.sizes, -1)
        score = (self._score(samples, offer.unsqueeze(1)).mT - mean) / deviation
        weights = torch.stack([left, 1 - left], 1) if self.n_scores == 2 else left.new_ones(1, 1, 1)
        value = (weights * score).sum(1)
        # A thousandth of a standard deviation keeps a query from outranking itself by rounding.
        above = value > (weights * standard).sum(1) + 1e-3
        return (above.sum(1, keepdim=True) + 0.5) / len(self.reference)

    def _score_reference(self, samples: Tensor) -> Tensor:
        """The standardised scores of the sample (B V N), and after them mean and deviation."""
        reference = self.reference.expand(len(samples), *self.reference.shape)
        scores = self._score(samples, reference)
        moments = torch.cat(moments_among(scores), 1)
        return torch.cat([(scores - moments[:, :1]) / moments[:, 1:], moments], 1).mT.contiguous()

    def _score(self, samples: Tensor, queries: Tensor) -> Tensor:
        return score_queries(samples, queries, self.response_model, self.acquisition)


def asks_over_offers(n_asked: Tensor, n_offered: Tensor, budget: int, n_offers: int) -> Tensor:
    """Asks left over offers left, at most 1, from counts (B 1)."""
    return ((budget - n_asked) / (n_offers - n_offered).clamp(min=1)).clamp(max=1)


def _greedy(env: EnvBase, acquisition: Acquisition) -> TensorDictModuleBase:
    """What asks greedily in an environment."""
    return Greedy(env.belief.response_model, acquisition)


def _by_knowledge(env: EnvBase) -> Acquisition:
    """The knowledge gradient of whatever an environment's pool shows."""
    return KnowledgeGradient(env.features.flatten(0, 1))


MakeStrategy = Callable[[EnvBase], TensorDictModuleBase]
"""From an environment to what asks in it."""

STRATEGIES: dict[str, MakeStrategy] = {
    "random": lambda env: RandomQuery(batch=env.batch),
    **{name: partial(_greedy, acquisition=each) for name, each in ACQUISITIONS.items()},
    "knowledge_gradient": lambda env: _greedy(env, _by_knowledge(env)),
    "thompson": lambda env: Thompson(_greedy(env, max_regret)),
    "lookahead": lambda env: Lookahead(env.belief.response_model),
}
"""Strategies that choose from candidates, by name: greedy ones by that of what they maximise."""

FEED_STRATEGIES: dict[str, MakeStrategy] = {
    "random": lambda env: RandomAsk(),
    **{name: partial(QuantileAsk, acquisition=each) for name, each in ACQUISITIONS.items()},
    "knowledge_gradient": lambda env: QuantileAsk(env, _by_knowledge(env)),
    "thompson": lambda env: Thompson(QuantileAsk(env, max_regret)),
}
"""Strategies that ask or skip what is offered, by name: all that is offered, or the best share."""


def make_strategy(name: str, env: EnvBase, *beside: str) -> TensorDictModuleBase:
    """The strategy of that name in an environment's setup.

    Args:
        name: of the setup's table.
        env: says which setup.
        beside: what else the caller knows by name, for the message.

    Raises:
        InputError: there is none.
    """
    known = FEED_STRATEGIES if is_feed(env) else STRATEGIES
    return known[check_choice("strategy", name, (*known, *beside))](env)
