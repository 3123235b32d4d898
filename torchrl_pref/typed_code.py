"""Code of the user's, named as ``module:name``, which is imported only if the user typed that."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from torchrl_pref.errors import InputError

_typed: set[str] = set()


def allow(reference: str) -> None:
    """From now on, in this process, ``module:name`` may be imported: the user typed it.

    What a checkpoint names is never imported unless the user types it again.
    """
    _typed.add(reference)


def allowed() -> frozenset[str]:
    """What the user typed, for other processes of the same command to allow."""
    return frozenset(_typed)


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
            f"torchrl_pref.typed_code.allow({reference!r}) before"
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
