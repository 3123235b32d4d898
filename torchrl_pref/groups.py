"""What a name in the settings stands for: the tables of the folders, and what the user brings.

A *group* is a section of the settings that chooses one of several things by its ``name`` and holds
that thing's own settings, which are the arguments of its constructor.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

from torchrl_pref.beliefs import BELIEFS
from torchrl_pref.config.sections import CODE
from torchrl_pref.errors import InputError, check_choice
from torchrl_pref.humans import HUMANS
from torchrl_pref.policies import POLICIES
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.tasks import TASKS
from torchrl_pref.typed_code import load_typed

TABLES: dict[str, Mapping[str, Callable[..., Any]]] = {
    "task": TASKS,
    "question": QUESTIONS,
    "human": HUMANS,
    "belief": BELIEFS,
    "policy": {name: kind.make for name, kind in POLICIES.items()},
}
"""What there is to choose from, by group."""

OWN = "own"
"""The name in any group of what the user brings, by ``make``: ``module:name``."""


def make(group: str, section: Mapping[str, Any], *given: Any, without: tuple[str, ...] = ()) -> Any:
    """The thing that a section chooses, made with its settings.

    Args:
        group: a key of ``TABLES``.
        section: its settings.
        given: what is handed to the constructor before them.
        without: settings that the constructor does not take.

    Raises:
        InputError: there is no such thing, or it cannot be made with these settings.
    """
    constructor = find(group, section)
    own = section["name"] == OWN
    left_out = {"name", "make", *without} if own else {"name", *without}
    keys = {key: value for key, value in section.items() if key not in left_out}
    for key in () if own else CODE.get(group, ()):
        if keys.get(key) is not None:
            keys[key] = load_typed(f"{group}.{key}", keys[key])
    try:
        inspect.signature(constructor).bind(*given, **keys)
    except TypeError as error:
        raise InputError(
            f"{group}={section['name']} with {', '.join(keys) or 'no settings'}: {error}; expected "
            f"those of {constructor.__name__}{inspect.signature(constructor)}"
        ) from None
    try:
        return constructor(*given, **keys)
    except InputError as error:
        # What was made knows its settings by their names alone.
        named = re.compile(rf"(?<!\S)({'|'.join(map(re.escape, keys))})=")
        raise InputError(named.sub(rf"{group}.\1=", str(error)) if keys else str(error)) from None


def keys_of(group: str, name: str) -> list[str]:
    """The settings of what a table holds under a name; of what it does not hold, none."""
    constructor = TABLES[group].get(name)
    if constructor is None:
        return []
    # The first argument is what it is made for: an environment, or a response model.
    first = 1 if group in ("policy", "human", "belief") else 0
    return list(inspect.signature(constructor).parameters)[first:]


def find(group: str, section: Mapping[str, Any]) -> Callable[..., Any]:
    """The class or function that a section chooses.

    Raises:
        InputError: there is none.
    """
    if section["name"] != OWN:
        table = TABLES[group]
        return table[check_choice(group, section["name"], tuple(table))]
    return load_typed(group, section.get("make"))
