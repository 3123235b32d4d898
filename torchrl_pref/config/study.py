"""The settings of a study, checked before anything is made of them."""

from __future__ import annotations

import re
from typing import Any

from torchrl_pref.config.checks import (
    COST,
    LARGEST_THREADS,
    Check,
    check_path,
    check_strategy,
    check_tau,
    choice,
    count,
    one_or_more,
    optional,
)
from torchrl_pref.config.sections import Plain
from torchrl_pref.config.settings import OTHERS, check_keys
from torchrl_pref.config.together import check_belief, check_options
from torchrl_pref.errors import (
    InputError,
    check_between,
    check_count,
    check_flag,
    check_seed,
    check_share,
)

CODE = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""What a participant can be called."""

MOST_QUESTIONS = 1000
"""Nobody answers more in one study."""

LARGEST_POOL = 10**6


def check_code(name: str, value: Any) -> None:
    """Refuse what no participant can be called.

    Raises:
        InputError: it is no text of letters, digits, - and _.
    """
    if not isinstance(value, str) or not CODE.fullmatch(value):
        raise InputError(
            f"{name}={value!s:.40}: expected a code of up to 32 letters, digits, - and _, as in "
            f"{name}=P1"
        )


def _check_text(name: str, value: Any) -> None:
    """Refuse what is no line of text."""
    if not isinstance(value, str) or not 0 < len(value.strip()) <= 200 or not value.isprintable():
        raise InputError(f"{name}={value!s:.80}: expected a line of text, of at most 200 letters")


def _check_host(name: str, value: Any) -> None:
    """Refuse what is no address or name of a machine."""
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9.:-]{1,253}", value):
        raise InputError(
            f"{name}={value!s:.80}: expected an address of this machine, such as {name}=127.0.0.1, "
            f"or {name}=0.0.0.0 for all of them"
        )


KEYS: dict[str, Check] = {
    "resume": optional(check_path),
    "export": optional(check_path),
    "ui": choice("browser", "terminal"),
    "participant": check_code,
    "host": _check_host,
    "port": count(0, 65535),
    "open": check_flag,
    "strategy": check_strategy,
    "tau": check_tau,
    "seed": check_seed,
    "threads": count(1, LARGEST_THREADS),
    "pool.size": count(1, LARGEST_POOL),
    "pool.options": count(1, 26),
    "pool.seed": check_seed,
    "pool.file": optional(check_path),
    "study.title": _check_text,
    "study.instructions": optional(check_path),
    "study.consent": check_flag,
    "study.participants": optional(one_or_more(check_code)),
    "study.attention": count(0, 20),
    "study.repeats": count(0, 20),
    "study.worth": lambda name, value: check_between(name, value, 0.0, 1.0),
    "belief.lapse": check_share,
    **COST,
}

ONLY_SIMULATED = ("setup.candidates", "setup.repeats", "setup.batch", "setup.on_skip")
"""Of simulations alone: people see the whole pool, one question at a time, and nothing twice."""

SETUPS: dict[str, dict[str, Check]] = {
    "query": {
        "setup.budget": count(1, MOST_QUESTIONS),
        "setup.candidates": lambda name, value: None,
        "setup.repeats": lambda name, value: None,
        "setup.batch": lambda name, value: None,
    },
    "feed": {
        "setup.budget": count(1, MOST_QUESTIONS),
        "setup.offers": optional(count(1)),
        "setup.on_skip": lambda name, value: None,
    },
}
"""By setup; what is not checked is of simulations alone."""


def _check_expected(settings: Plain) -> None:
    """Refuse somebody in the terminal whom the study does not expect."""
    person, named = settings["participant"], settings["study"]["participants"]
    if settings["ui"] == "terminal" and named is not None and person not in named:
        raise InputError(
            f"participant={person}: expected one of {', '.join(named)}, whom study.participants "
            "names"
        )


def check_ask_settings(settings: Plain) -> Plain:
    """Refuse what ask.py cannot do.

    Raises:
        InputError: a key is missing, unknown or out of its range, or two do not go together.
    """
    groups = {name: OTHERS[name] for name in ("task", "question", "belief")}
    check_keys(settings, KEYS, {"setup": SETUPS, **groups})
    setup, pool = settings["setup"], settings["pool"]
    if setup["name"] == "feed":
        if setup["offers"] is not None:
            check_count("setup.offers", setup["offers"], setup["budget"])
        offers = setup["offers"] or 5 * setup["budget"]
        if pool["file"] is None and pool["size"] < offers:
            raise InputError(
                f"pool.size={pool['size']} with {offers} offers: expected at least as many "
                "questions as stream by, as nobody is asked one twice; raise it, or lower "
                "setup.offers"
            )
    elif pool["file"] is None and pool["size"] < setup["budget"]:
        raise InputError(
            f"pool.size={pool['size']} with setup.budget={setup['budget']}: expected at least as "
            "many questions as are asked; raise one or lower the other"
        )
    _check_expected(settings)
    for key in ("attention", "repeats"):
        number, budget = settings["study"][key], setup["budget"]
        if number > max(0, budget - 3):
            raise InputError(
                f"study.{key}={number} with setup.budget={budget}: expected at most 3 fewer than "
                "questions, to be spread among them; lower it"
            )
    check_belief(settings)
    if pool["file"] is None:
        check_options(settings)
    return settings
