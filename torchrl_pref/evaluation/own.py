"""Strategies that the user names, to be judged beside the baselines: ``max_regret``, ``mine:rule``.

A name alone is one of the package's (``strategies.STRATEGIES``, in a feed ``FEED_STRATEGIES``). Of
others, named as ``module:name``, ``name`` is called with the environment, a :class:`QueryEnv` or a
:class:`FeedEnv`, and gives a TensorDictModule that writes ``action``: for each session the number
of a candidate (with ``setup.batch=n`` the numbers of n), or 0 to skip and 1 to ask. Where it is a
probabilistic actor its most likely action is taken.

Only what the user typed is imported: names come from the command line and never from a file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.acquisition.per_second import Cost
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.envs.setups import refuse_other_setup
from torchrl_pref.errors import InputError, OtherSetup, check_choice
from torchrl_pref.evaluation.side_by_side import Entrant
from torchrl_pref.evaluation.style import is_there
from torchrl_pref.strategies import FEED_STRATEGIES, STRATEGIES, make_strategy
from torchrl_pref.typed_code import load, where

Maker = Callable[[QueryEnv | FeedEnv], TensorDictModuleBase]


def find_makers(typed: Sequence[str], settings: Settings | None = None) -> dict[str, Maker]:
    """What makes each strategy; for the user's own the current directory is looked in last.

    Args:
        typed: a name of the package, or ``module:name``, of each.
        settings: the section ``cost``, for those of the package that count seconds; without it a
            question takes as long as :class:`Cost` has it.

    Returns:
        What was found or imported, by the same names.

    Raises:
        InputError: there is no such module or name, or it cannot be called.
    """
    section = None if settings is None else settings.get("cost")
    cost = None if section is None else Cost(**section)
    known = tuple(dict.fromkeys((*STRATEGIES, *FEED_STRATEGIES)))
    for name in typed:
        if ":" not in name:
            check_choice("strategy", name, known)
    return {
        name: load(f"strategy={name}", name)
        if ":" in name
        else partial(make_strategy, name, cost=cost)
        for name in typed
    }


def make_own(
    makers: Mapping[str, Maker],
    env: QueryEnv | FeedEnv,
    seed: int,
    beside: Sequence[str] = (),
) -> list[Entrant]:
    """The strategies, each made for an environment, with a generator seeded alike; but for those
    that are beside them already, as baselines with these keys.

    Raises:
        InputError: making one fails, or makes something else.
    """
    entrants = []
    for typed, maker in makers.items():
        if is_there(typed, is_feed(env), beside):
            continue
        torch.manual_seed(seed)
        try:
            strategy = maker(env)
        except Exception as error:
            if ":" not in typed or isinstance(error, InputError):  # which says so itself
                raise
            raise InputError(
                f"strategy={typed}: making it for a {type(env).__name__} fails ({where(error)}); "
                "expected a function of the environment, or a class made with it"
            ) from error
        if not isinstance(strategy, TensorDictModuleBase):
            raise InputError(
                f"strategy={typed}: made something of type {type(strategy).__name__}; expected a "
                "TensorDictModule that writes action"
            )
        entrants.append(Entrant(f"own:{typed}", strategy))
    return entrants


def try_own(makers: Mapping[str, Maker], env: QueryEnv | FeedEnv) -> None:
    """Let each strategy decide once, so that one which cannot is refused before anything is run.

    Args:
        makers: as found.
        env: a small one of its own, which is used up.

    Raises:
        InputError: a strategy cannot be made, fails, or writes no action of this environment.
        OtherSetup: it is for the other setup.
    """
    for typed, entrant in zip(makers, make_own(makers, env, 0), strict=True):
        refuse_other_setup(f"strategy={typed}", entrant.strategy, env)
        try:
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                decided = entrant.strategy(env.reset())
                if not isinstance(decided, TensorDictBase) or decided.get("action", None) is None:
                    raise InputError("it writes no action")
                env.step(decided)
        except Exception as error:
            raise InputError(
                f"strategy={typed}: its first decision in a {type(env).__name__} fails "
                f"({where(error)}); expected a TensorDictModule that writes action, "
                f"{'one whole number' if env.batch == 1 else f'{env.batch} whole numbers'} for "
                "each session"
            ) from error


def of_this_setup(makers: Mapping[str, Maker], env: QueryEnv | FeedEnv) -> tuple[str, ...]:
    """Those of the strategies that are not for the other setup alone; each is tried as by
    :func:`try_own`.

    Raises:
        InputError: one cannot decide here.
    """
    fitting = []
    for typed, maker in makers.items():
        with suppress(OtherSetup):
            try_own({typed: maker}, env)
            fitting.append(typed)
    return tuple(fitting)
