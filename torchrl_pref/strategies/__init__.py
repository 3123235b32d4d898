"""Strategies that are not learned: modules that read a session and write ``action``.

A strategy is any TensorDictModule that writes ``action``; these and the learned policies run
through the same ``env.rollout``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.acquisition.batch import BATCHES, Select
from torchrl_pref.acquisition.functions import Acquisition
from torchrl_pref.acquisition.knowledge_gradient import KnowledgeGradient
from torchrl_pref.acquisition.pairs import max_regret
from torchrl_pref.acquisition.per_second import Cost, PerSecond
from torchrl_pref.envs.session import is_feed
from torchrl_pref.envs.setups import setups_of
from torchrl_pref.errors import OtherSetup, check_choice
from torchrl_pref.strategies.batches import BatchOf
from torchrl_pref.strategies.feed import OfferRank, QuantileAsk, RandomAsk, ThresholdAsk
from torchrl_pref.strategies.lookahead import AlignmentLookahead, Lookahead, check_followed
from torchrl_pref.strategies.query import Greedy, RandomQuery, Thompson

__all__ = [
    "BATCH_STRATEGIES",
    "FEED_STRATEGIES",
    "STRATEGIES",
    "AlignmentLookahead",
    "BatchOf",
    "Greedy",
    "Lookahead",
    "MakeStrategy",
    "OfferRank",
    "QuantileAsk",
    "RandomAsk",
    "RandomQuery",
    "Thompson",
    "ThresholdAsk",
    "make_strategy",
]


def _greedy(env: EnvBase, acquisition: Acquisition) -> TensorDictModuleBase:
    """What asks greedily in an environment."""
    return Greedy(env.belief.response_model, acquisition)


def _by_knowledge(env: EnvBase) -> Acquisition:
    """The knowledge gradient of whatever an environment's pool shows."""
    return KnowledgeGradient(env.features.flatten(0, 1))


def _looking_ahead(
    env: EnvBase, kind: type[Lookahead] | type[AlignmentLookahead]
) -> TensorDictModuleBase:
    """What looks ahead in an environment, refused where its questions have too many answers."""
    check_followed(env.belief.response_model, env.features.shape[1])
    return kind(env.belief.response_model)


def _batch_of(env: EnvBase, select: Select) -> TensorDictModuleBase:
    """What asks batches in an environment."""
    return BatchOf(env.belief.response_model, env.batch, select)


MakeStrategy = Callable[[EnvBase], TensorDictModuleBase]
"""From an environment to what asks in it."""

STRATEGIES: dict[str, MakeStrategy] = {
    "random": lambda env: RandomQuery(batch=env.batch),
    **{name: partial(_greedy, acquisition=each) for name, each in ACQUISITIONS.items()},
    "knowledge_gradient": lambda env: _greedy(env, _by_knowledge(env)),
    "thompson": lambda env: Thompson(_greedy(env, max_regret)),
    "lookahead": partial(_looking_ahead, kind=Lookahead),
    "alignment_lookahead": partial(_looking_ahead, kind=AlignmentLookahead),
}
"""Strategies that choose from candidates, by name: greedy ones by that of what they maximise."""

FEED_STRATEGIES: dict[str, MakeStrategy] = {
    "random": lambda env: RandomAsk(),
    **{name: partial(QuantileAsk, acquisition=each) for name, each in ACQUISITIONS.items()},
    "knowledge_gradient": lambda env: QuantileAsk(env, _by_knowledge(env)),
    "thompson": lambda env: Thompson(QuantileAsk(env, max_regret)),
}
"""Strategies that ask or skip what is offered, by name: all that is offered, or the best share."""

BATCH_STRATEGIES: dict[str, MakeStrategy] = {
    "random": STRATEGIES["random"],
    **{name: partial(_batch_of, select=each) for name, each in BATCHES.items()},
}
"""Strategies that choose n candidates of an environment with ``batch=n``, by name."""


def make_strategy(
    name: str, env: EnvBase, *beside: str, cost: Cost | None = None
) -> TensorDictModuleBase:
    """The strategy of that name in an environment's setup.

    Args:
        name: of the setup's table.
        env: says which setup.
        beside: what else the caller knows by name, for the message.
        cost: how long a question takes, for the strategies that ask by what it is worth for each
            second; None: as long as :class:`Cost` has it.

    Raises:
        InputError: there is none.
        OtherSetup: there is one for the other setup alone.
    """
    here, there = setups_of(env)
    tables = {"feed": FEED_STRATEGIES, "query": STRATEGIES}
    known = tables[here]
    if name in tables[there] and name not in known:
        raise OtherSetup(
            f"strategy={name} with setup={here}: it is for setup={there} alone; type that, or "
            "another strategy"
        )
    make = known[check_choice("strategy", name, (*known, *beside))]
    acquisition = ACQUISITIONS.get(name)
    if cost is None or not isinstance(acquisition, PerSecond):
        return make(env)
    acquisition = replace(acquisition, cost=cost)
    return (QuantileAsk if is_feed(env) else _greedy)(env, acquisition)
