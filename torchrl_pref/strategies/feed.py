"""Strategies that ask or skip what is offered.

Shapes: B sessions, M belief samples, N queries in a sample of the pool, V scores of a query, K
options per query, D features.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor
from torchrl.envs import EnvBase

from torchrl_pref.acquisition.functions import Acquisition, information_gain
from torchrl_pref.acquisition.scoring import moments_among, score_queries, together
from torchrl_pref.beliefs.per_belief import PerBelief
from torchrl_pref.errors import check_share

REFERENCE = 500
"""Queries of the pool among which a feed strategy ranks an offer."""


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
