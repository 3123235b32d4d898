"""Values of settings that are right one by one and wrong together."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from torchrl_pref.config.sections import Plain
from torchrl_pref.errors import InputError, check_batch, check_count

OF_ONE = ("approve", "own")
"""Kinds of question that may be about one option."""

OF_ONE_DIMENSION = ("attention", "paper")
"""Policies whose weights are for one number of features."""

LARGEST_RATE = 4.0
"""Of the lapse rates that are thought possible, in units of their mean, see ``beliefs.lapses``."""


def check_together(settings: Plain) -> None:
    """Refuse values that are right one by one and wrong together.

    Raises:
        InputError: some are.
    """
    pool, setup = settings["pool"], settings["setup"]
    _check_demonstrations(settings)
    check_belief(settings)
    given = [name for name in ("train", "test") if pool[name] is not None]
    if len(given) == 1 and settings.get("checkpoint") is None:
        raise InputError(
            f"pool.{given[0]}={pool[given[0]]} alone: the other pool would be the task's; "
            "expected both pool.train and pool.test of your own, or neither"
        )
    check_options(settings)
    budget = setup["budget"]
    _check_batches(settings)
    if setup["name"] == "feed":
        if setup["offers"] is not None:
            check_count("setup.offers", setup["offers"], budget)
    elif not setup["repeats"] and pool["train"] is None:
        shown = min(pool["size"], setup["candidates"] or pool["size"])
        if shown < budget:
            raise InputError(
                f"setup.repeats=false with {shown} candidates and setup.budget={budget}: expected "
                "at least as many candidates as asks; raise one or lower the other"
            )


def _check_batches(settings: Plain) -> None:
    """Refuse batches that the budget is no multiple of, or whose extra is not installed."""
    batch = settings["setup"].get("batch", 1)
    check_batch(batch, settings["setup"]["budget"])
    if batch > 1 and find_spec("kmedoids") is None:
        raise InputError(
            f"setup.batch={batch}: kmedoids is not installed; install it by "
            "pip install -c constraints.txt -e '.[batch]', or set setup.batch=1"
        )


def refuse_batches(settings: Plain, who: str) -> None:
    """Refuse several questions at once of somebody who chooses one.

    Raises:
        InputError: they are asked for.
    """
    batch = settings["setup"].get("batch", 1)
    if batch > 1:
        raise InputError(
            f"setup.batch={batch}: {who} chooses one query at a time; set setup.batch=1, or "
            "compare batches by evaluate.py setup=query"
        )


def check_drawn(settings: Plain) -> None:
    """Refuse what a training over many problems cannot be made with.

    Raises:
        InputError: the policy is bound to one number of features, batches are no whole sessions,
            pools of the user's are named, or the belief does not say how many samples it has.
    """
    policy, pool = settings["policy"]["name"], settings["pool"]
    if settings["training"]["problems"] != "drawn":
        return
    if policy in OF_ONE_DIMENSION:
        raise InputError(
            f"training.problems=drawn with policy={policy}: problems differ in their number of "
            "features, and this policy has weights for each; type policy=scorer"
        )
    if settings["training"]["steps"] is not None:
        raise InputError(
            f"training.problems=drawn with training.steps={settings['training']['steps']}: each "
            "update is about another problem, from the first question to the last; leave "
            "training.steps out"
        )
    if pool["train"] is not None:
        raise InputError(
            f"training.problems=drawn with pool.train={pool['train']}: each update draws a pool of "
            "its own; remove the pools, or type training.problems=one"
        )
    if "samples" not in settings["belief"]:
        raise InputError(
            "training.problems=drawn with a belief that has no belief.samples: the belief is "
            "drawn, too, with as many samples as that says; type belief=sampled"
        )


def check_options(settings: Plain) -> None:
    """Refuse queries of one option for a question about several.

    Raises:
        InputError: there are such.
    """
    if settings["question"]["name"] not in OF_ONE:
        check_count("pool.options", settings["pool"]["options"], 2)


def _check_demonstrations(settings: Plain) -> None:
    """Refuse demonstrations that the pool has not enough trajectories for, or the belief no tau."""
    shown, pool = settings["demonstrations"], settings["pool"]
    if not shown["count"]:
        return
    walks = pool["size"] * pool["options"]
    if pool["train"] is None and shown["alternatives"] >= walks:
        raise InputError(
            f"demonstrations.alternatives={shown['alternatives']} with {walks} trajectories in the "
            "pool: expected fewer; lower it, or raise pool.size"
        )
    if shown["tau"] is not None and "optimal" in _taus(settings):
        raise InputError(
            f"demonstrations.tau={shown['tau']} with tau=optimal: to a belief in a human who never "
            "errs nothing is shown less carefully; leave demonstrations.tau out, or set tau=noisy"
        )


def check_belief(settings: Plain) -> None:
    """Refuse a human whom the belief cannot infer.

    Raises:
        InputError: it cannot.
    """
    belief = settings["belief"]
    name = belief["name"]
    if name in ("rationality", "laplace") and "optimal" in _taus(settings):
        raise InputError(
            f"belief={name} with tau={_typed(settings['tau'])}: it can infer nothing of humans who "
            "never err; type tau=noisy, or belief=sampled"
        )
    if name == "rationality" and belief["lapse"] * LARGEST_RATE >= 1:
        raise InputError(
            f"belief.lapse={belief['lapse']} with belief=rationality: some people are taken to "
            f"lapse {LARGEST_RATE:g} times as often; expected less than {1 / LARGEST_RATE:g}; "
            "lower it, or type belief=sampled"
        )


def _taus(settings: Plain) -> list[Any]:
    """The kinds of human, one or several."""
    return settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]


def _typed(value: Any) -> str:
    """A value, or a list of them, as it is typed."""
    return f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
