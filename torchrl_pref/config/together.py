"""What settings may not be together, though each is right alone."""

from __future__ import annotations

from torchrl_pref.config.sections import Plain
from torchrl_pref.errors import InputError, check_count

OF_ONE = ("approve", "own")
"""Kinds of question that may be about one option."""


def check_together(settings: Plain) -> None:
    """Refuse values that are right one by one and wrong together.

    Raises:
        InputError: there are some.
    """
    pool, setup, belief = settings["pool"], settings["setup"], settings["belief"]
    _check_demonstrations(settings)
    _check_inferring(settings)
    given = [name for name in ("train", "test") if pool[name] is not None]
    if len(given) == 1 and settings.get("checkpoint") is None:
        raise InputError(
            f"pool.{given[0]}={pool[given[0]]} alone: the other pool would be the task's; "
            "expected both pool.train and pool.test of your own, or neither"
        )
    if settings["question"]["name"] not in OF_ONE:
        check_count("pool.options", pool["options"], 2)
    budget = setup["budget"]
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
    if settings["objective"] == "entropy" and belief.get("samples", 4) < 4:
        raise InputError(
            f"objective=entropy with belief.samples={belief['samples']}: expected at least 4, as "
            "the entropy is told by the third nearest sample; raise belief.samples"
        )


def _check_inferring(settings: Plain) -> None:
    """Refuse beliefs that have no use for what is assumed of the human."""
    name, lapse = settings["belief"]["name"], settings["belief"]["lapse"]
    taus = settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]
    if name in ("rationality", "laplace") and "optimal" in taus:
        raise InputError(
            f"belief={name} with tau=optimal: it is for people who err; set tau=noisy or a number"
        )
    if name == "rationality" and lapse >= 0.25:
        raise InputError(
            f"belief.lapse={lapse} with belief=rationality: expected less than 0.25, as some "
            "people are taken to have four times that; lower it"
        )


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
    taus = settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]
    if shown["tau"] is not None and "optimal" in taus:
        raise InputError(
            f"demonstrations.tau={shown['tau']} with tau=optimal: to a belief in a human who never "
            "errs nothing is shown less carefully; leave demonstrations.tau out, or set tau=noisy"
        )
