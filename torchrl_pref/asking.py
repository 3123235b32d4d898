"""What a live person is asked, and by what: the parts of a session of questions.

Shapes: B people, N queries in the pool, K options per query, D features, O offers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.envs.transition import SessionState, Tree
from torchrl_pref.errors import InputError, check_choice, check_type
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.strategies import MakeStrategy, make_strategy
from torchrl_pref.tensors import as_whole

FIRST_BLOCK = 4
"""Offers that are looked at together at first; twice as many each time that none is asked."""


class NothingToAsk(InputError):
    """The session is over: its budget is used up, or all offers went by."""


class Asked(NamedTuple):
    """A question to show; with one person the leading B is left out."""

    query: Tensor
    """(B), its index in the pool."""
    features: Tensor
    """(B K D), of its options, as in the pool."""
    trajectories: Tensor | None
    """(B K …), what the person is shown, where the pool has it."""


def make_env(
    pool: QueryPool, belief: BeliefBase, setup: str, people: int, seed: int, **options: Any
) -> QueryEnv | FeedEnv:
    """The environment in which a strategy decides; nobody answers there.

    Raises:
        InputError: ``setup`` is another word, or an option cannot be used.
    """
    check_choice("setup", setup, ("query", "feed"))
    nobody = SimulatedHuman(belief.response_model)
    common: dict[str, Any] = {"batch_size": (people,), "seed": seed, "budget": options["budget"]}
    if setup == "query":
        if options["offers"] is not None:
            raise InputError(
                f"offers={options['offers']} with setup='query': queries stream by in a feed "
                "alone; leave offers out, or set setup='feed'"
            )
        return QueryEnv(pool, nobody, belief, repeats=options["repeats"], **common)
    return FeedEnv(pool, nobody, belief, offers=options["offers"], skip="free", **common)


def draw_questions(env: QueryEnv | FeedEnv, size: int, repeats: bool) -> dict[str, Tensor]:
    """What streams by of a feed, for B people: hidden. See :meth:`SessionEnv.draw_questions`.

    Without ``repeats`` a query comes again only after all others.
    """
    if repeats or not is_feed(env):
        return env.draw_questions(size)
    n_queries, n_offers = len(env.features), env.max_steps
    n_passes = -(-n_offers // n_queries)
    keys = torch.rand((size, n_passes, n_queries), generator=env.generator)
    return {"offers": keys.argsort(-1).flatten(1)[:, :n_offers]}


def strategy_of(strategy: str | MakeStrategy, env: EnvBase) -> TensorDictModuleBase:
    """What asks in an environment.

    Args:
        strategy: a name of ``strategies.STRATEGIES``, in a feed of ``FEED_STRATEGIES``;
            ``policy``; or a function from an environment to a module that writes ``action``.
        env: the environment.

    Raises:
        InputError: it is none of these.
    """
    if strategy == "policy":
        from torchrl_pref.pretrained import pretrained_policy  # and all that it takes

        return pretrained_policy(env).strategy
    if isinstance(strategy, str):
        return make_strategy(strategy, env, "policy")
    if not callable(strategy) or isinstance(strategy, TensorDictModuleBase):
        raise InputError(
            f"strategy of type {type(strategy).__name__}: expected a function from an environment "
            "to a module that writes action, such as lambda env: Greedy(env.belief.response_model)"
        )
    made = strategy(env)
    check_type("what strategy makes of an environment", made, TensorDictModuleBase, "Greedy(…)")
    return made


@torch.no_grad()
def next_question(
    env: QueryEnv | FeedEnv,
    strategy: TensorDictModuleBase,
    state: SessionState,
    hidden: Tree,
    luck: int,
) -> tuple[Tensor, Tensor | None]:
    """The pool index (B) of what is asked next, and in a feed how many offers (B 1) went by then.

    Args:
        env: where the strategy decides.
        strategy: writes ``action``.
        state: of the sessions; in a feed with ``n_offered`` (B 1).
        hidden: as :meth:`SessionEnv.draw_questions` drew it.
        luck: seeds the strategy's own generators.

    Raises:
        NothingToAsk: all offers of one of the people went by.
    """
    for module in strategy.modules():
        if isinstance(getattr(module, "generator", None), Generator):
            module.generator.manual_seed(luck)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        if is_feed(env):
            return _let_through(cast(FeedEnv, env), strategy, state, hidden)
        return strategy(env.show(state, hidden))["action"], None


def _let_through(
    env: FeedEnv, strategy: TensorDictModuleBase, state: SessionState, hidden: Tree
) -> tuple[Tensor, Tensor]:
    """See :func:`next_question`: offers go by until each person has one that is asked."""
    if env.batch_size.numel() == 1 and _decides_by_itself(strategy):
        return _first_asked(env, strategy, state, hidden)
    index, n_offered = torch.full(tuple(env.batch_size), -1), state["n_offered"]
    while (waiting := index < 0).any():
        if (n_offered.squeeze(-1)[waiting] >= env.n_offers).any():
            raise _all_went_by(env)
        present: SessionState = {**state, "n_offered": n_offered}
        asks = strategy(env.show(present, hidden))["action"] == 1
        index = torch.where(waiting & asks, env.offered(present, hidden), index)
        n_offered = n_offered + waiting.unsqueeze(-1)
    return index, n_offered


def _decides_by_itself(strategy: TensorDictModuleBase) -> bool:
    """Whether a strategy decides on an offer by what it sees, whoever else it sees beside it.

    One that draws at random does not, and one of the user's may count what it was shown.
    """
    known = {"torchrl_pref", "torch", "tensordict", "torchrl"}
    return all(
        type(module).__module__.partition(".")[0] in known and not hasattr(module, "generator")
        for module in strategy.modules()
    )


def _first_asked(
    env: FeedEnv, strategy: TensorDictModuleBase, state: SessionState, hidden: Tree
) -> tuple[Tensor, Tensor]:
    """:func:`_let_through` for one person: the strategy decides on several offers at once, as if
    they were as many sessions, since all but the first that is asked leave the belief as it is."""
    first, count = int(state["n_offered"]), FIRST_BLOCK
    while first < env.n_offers:
        places = torch.arange(first, min(first + count, env.n_offers)).unsqueeze(-1)
        several = TensorDict({**state}, [1]).expand(len(places))
        present = cast(SessionState, {**several, "n_offered": places})
        each = {key: value.expand(len(places), -1) for key, value in hidden.items()}
        asked = (strategy(env.show(present, each))["action"] == 1).nonzero()
        if len(asked):
            place = int(asked[0])
            return env.offered(present, each)[place : place + 1], places[place : place + 1] + 1
        first, count = first + len(places), 2 * count
    raise _all_went_by(env)


def _all_went_by(env: FeedEnv) -> NothingToAsk:
    return NothingToAsk(
        f"offers={env.n_offers}: all went by; expected more offers where more are to be asked"
    )


def query_indices(env: QueryEnv | FeedEnv, queries: Sequence[int]) -> Tensor:
    """(B), queries of an environment's pool, one for each of its people.

    Raises:
        InputError: one is not of the pool, or there are not B.
    """
    size, n_queries = env.batch_size.numel(), len(env.features)
    given = [as_whole(query) for query in queries]
    if len(given) != size or not all(type(q) is int and 0 <= q < n_queries for q in given):
        raise InputError(
            f"queries {queries!s:.80}: expected {size} of the pool, each a whole number from 0 to "
            f"{n_queries - 1}"
        )
    return torch.tensor(given)


def answers_said(env: QueryEnv | FeedEnv, answers: Sequence[Any]) -> Tensor:
    """(B), answers as the belief is told them; None is one that was refused.

    Raises:
        InputError: there is no such answer, or there are not B.
    """
    size, last = env.batch_size.numel(), env.n_answers - 1
    if len(answers) != size:
        raise InputError(f"answers {answers!s:.60}: expected one for each of {size} people")
    said = [as_whole(one) for one in answers]
    for one in said:
        if one is not None and (type(one) is not int or not 0 <= one <= last):
            raise InputError(
                f"answer={one!r:.40}: expected a whole number from 0 to {last}, or None where the "
                "person would not say"
            )
    return torch.tensor([REFUSED if one is None else one for one in said])


def check_same(content: Mapping[str, Any], made_with: Mapping[str, Any]) -> None:
    """Refuse a saved session that was made with something else.

    Raises:
        InputError: it was.
    """
    for key in ("pool", "response_model", "belief", "strategy", "given"):
        was = content.get(key)  # sessions of earlier versions were given nothing
        if was != made_with[key]:
            raise InputError(
                f"{key}: the session was made with {was!s:.80}, and this is "
                f"{made_with[key]!s:.80}; expected the same"
            )
