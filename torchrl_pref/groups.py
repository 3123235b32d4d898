"""What a name in the settings stands for: the tables of the folders, and what the user brings.

A *group* is a section of the settings that chooses one of several things by its ``name`` and holds
that thing's own settings, which are the arguments of its constructor.
"""

from __future__ import annotations

import inspect
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from torchrl_pref.beliefs import BELIEFS
from torchrl_pref.config.sections import CODE
from torchrl_pref.errors import InputError, check_choice
from torchrl_pref.humans import HUMANS
from torchrl_pref.policies import POLICIES
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.tasks import TASKS

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

_typed: set[str] = set()


def allow(reference: str) -> None:
    """From now on, in this process, ``module:name`` may be imported: the user typed it.

    What a checkpoint names is never imported unless the user types it again.
    """
    _typed.add(reference)


def allowed() -> frozenset[str]:
    """What the user typed, for other processes of the same command to allow."""
    return frozenset(_typed)


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
        first = str(error).partition("=")[0]
        raise InputError(f"{group}.{error}" if first in keys else str(error)) from None


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


def load_typed(key: str, reference: Any) -> Callable[..., Any]:
    """Import what a setting names as ``module:name``, if the user typed it.

    Raises:
        InputError: it is nothing of this form, was not typed, or cannot be imported.
    """
    if not isinstance(reference, str) or reference.count(":") != 1:
        raise InputError(f"{key}={reference!r}: expected <module>:<name>")
    if reference not in _typed:
        raise InputError(
            f"{key}={reference}: a file names code of yours, which is run only if you type it; "
            f"add {key}={reference} to the command, or in Python call "
            f"torchrl_pref.groups.allow({reference!r}) before"
        )
    return load(f"{key}={reference}", reference)


def load(what: str, reference: str) -> Callable[..., Any]:
    """Import ``module:name``, where the present folder is looked in too.

    Args:
        what: was typed, for messages.
        reference: ``module:name``.

    Raises:
        InputError: there is no such module or name, or what it names cannot be called.
    """
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)  # not first: a file of the user's must not hide a module of ours
    module_name, _, name = reference.partition(":")
    try:
        module = import_module(module_name)
    except (Exception, SystemExit) as error:
        # Of packages on the way, too.
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            raise InputError(
                f"{what}: no module {module_name} in {here} or among what is installed; expected "
                "<module>:<name>; check the spelling, or change the folder"
            ) from None
        raise InputError(
            f"{what}: importing {module_name} fails ({where(error)}); mend it"
        ) from error
    found = getattr(module, name, None)
    if found is None:
        raise InputError(
            f"{what}: {getattr(module, '__file__', module_name)} has no {name}; expected the name "
            "of a function or class there"
        )
    if not callable(found):
        raise InputError(
            f"{what}: {name} is of type {type(found).__name__}; expected a function or a class"
        )
    return found


def where(error: BaseException) -> str:
    """An error and where it was raised, in one line."""
    if isinstance(error, InputError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    frames = traceback.extract_tb(error.__traceback__)
    return f"{text}, {Path(frames[-1].filename).name} line {frames[-1].lineno}" if frames else text
