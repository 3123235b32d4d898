"""What the value of a setting may be: checks of one value, and how they are put together.

Each check takes the name of a key and its value, and raises an InputError where they do not fit.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl_pref.errors import InputError, check_choice, check_count, check_positive

Check = Callable[[str, Any], object]
"""From a key and its value; raises an InputError where the key cannot have that value."""

LARGEST_COUNT = 2**53
LARGEST_TAU = 1e6
LARGEST_THREADS = max(64, os.cpu_count() or 1)

LOGGERS = ("csv", "tensorboard", "wandb", "mlflow")
EXTRAS = ("wandb", "mlflow")
"""Loggers whose packages are extras, of the same names."""


PER_SECOND = ("information_per_second", "alignment_per_second")
"""Strategies that count the seconds a question takes."""


def check_tau(name: str, value: Any) -> None:
    """Refuse what is no kind of human.

    Raises:
        InputError: it is neither ``noisy`` nor ``optimal`` nor a number that float32 can use.
    """
    if isinstance(value, str):
        if value not in ("noisy", "optimal"):
            raise InputError(
                f"{name}={value!r}: expected noisy, optimal or a number above 0, as in {name}=2"
            )
        return
    check_positive(name, value)
    if not 1 / LARGEST_TAU <= value <= LARGEST_TAU:
        raise InputError(
            f"{name}={value!r}: expected a number from {1 / LARGEST_TAU:g} to {LARGEST_TAU:g}; "
            f"{name}=optimal is the limit of large ones"
        )


def check_spread(name: str, value: Any) -> None:
    """Refuse what is no factor by which tau may differ.

    Raises:
        InputError: it is not a number from 1 to a million.
    """
    check_positive(name, value)
    if not 1 <= value <= LARGEST_TAU:
        raise InputError(
            f"{name}={value!r}: expected a factor of at least 1, and at most {LARGEST_TAU:g}; "
            "1 is no spread"
        )


def check_device(name: str, value: Any) -> None:
    """Refuse a device that is not there.

    Raises:
        InputError: it is no name of a device, or the device is not on this machine.
    """
    if not isinstance(value, str) or not re.fullmatch(r"[a-z]+(:\d{1,9})?", value):
        raise InputError(f"{name}={value!r}: expected cpu, cuda or cuda:<number>")
    kind, _, number = value.partition(":")
    if kind not in ("cpu", "cuda") or (kind == "cpu" and int(number or 0)):
        raise InputError(f"{name}={value!r}: expected cpu, cuda or cuda:<number>; set {name}=cpu")
    if kind == "cuda":
        import torch  # a second or more, and only this needs it

        if int(number or 0) >= torch.cuda.device_count():
            raise InputError(
                f"{name}={value}: this machine has {torch.cuda.device_count()} CUDA devices; "
                f"set {name}=cpu, or install a CUDA build of torch where there is one"
            )


def check_path(name: str, value: Any) -> None:
    """Refuse a path at which there is nothing.

    Raises:
        InputError: it is no path, or nothing is there.
    """
    if isinstance(value, (bool, list, dict)) or not str(value).strip():
        raise InputError(f"{name}={value!r}: expected a path; name a file, or a folder of a run")
    try:
        found = Path(str(value)).exists()
    except (OSError, ValueError):  # too long, or with characters that no path can have
        found = False
    if not found:
        raise InputError(f"{name}={value}: no such file or folder; check the path")


def check_loggers(name: str, value: Any) -> None:
    """Refuse what is no list of loggers, or one whose package is not installed.

    Raises:
        InputError: it is no list, names none or one twice, or a package is missing.
    """
    if not isinstance(value, list):
        raise InputError(
            f"{name}={value!r}: expected a list, such as {name}=[csv,tensorboard], or {name}=[] "
            "for no logs"
        )
    if value:
        one_or_more(choice(*LOGGERS))(name, value)
    for package in [extra for extra in EXTRAS if extra in value]:
        found = find_spec(package)
        # A folder of that name, as wandb makes them, is found as a package without a file.
        if found is None or found.origin is None:
            raise InputError(
                f"{name}: {package} is not installed; install it by "
                f"pip install -c constraints.txt -e '.[{package}]', or leave {package} out"
            )


def check_strategy(name: str, value: Any) -> None:
    """Refuse what is neither a name, which the package is to know, nor ``module:name``.

    Raises:
        InputError: it is neither.
    """
    if not isinstance(value, str) or not re.fullmatch(r"([^\W\d][\w.]*:)?[^\W\d]\w*", value):
        raise InputError(
            f"{name}={value!s:.80}: expected a name of docs/strategies.md, such as alignment_gain, "
            f"or <module>:<name> of yours, as in {name}=mine:Rule for what Rule of mine.py makes "
            "of the environment"
        )


def optional(check: Check) -> Check:
    """The check, or null."""
    return lambda name, value: None if value is None else check(name, value)


def one_or_more(check: Check) -> Check:
    """The check of one value, or of each in a list of different ones."""

    def check_all(name: str, value: Any) -> None:
        values = value if isinstance(value, list) else [value]
        if not values:
            raise InputError(f"{name}=[]: expected at least one; leave {name} out for its default")
        for one in values:
            check(name, one)
        if len(set(map(str, values))) < len(values):
            raise InputError(f"{name}={value}: names the same twice; remove one of them")

    return check_all


def list_of(*names: str) -> Check:
    """A list of different ones of some words, which may be empty."""

    def check(name: str, value: Any) -> None:
        values = value if isinstance(value, list) else [value]
        known = [one for one in names if one in values]
        if values != value or len(known) < len(values):
            example = ",".join(known or names[:1])
            raise InputError(
                f"{name}={value!s:.80}: expected a list of different ones of {', '.join(names)}, "
                f"in brackets and quotes, as in '{name}=[{example}]', or '{name}=[]' for none"
            )

    return check


def count(minimum: int, maximum: int = LARGEST_COUNT) -> Check:
    """A whole number from a minimum to a maximum."""

    def check_both(name: str, value: Any) -> None:
        if check_count(name, value, minimum) > maximum:
            raise InputError(
                f"{name}={value}: expected a whole number of at most {maximum}; lower it"
            )

    return check_both


def choice(*names: str) -> Check:
    """One of some words."""
    return partial(check_choice, choices=names)


def positive(maximum: float) -> Check:
    """A number above 0, up to a maximum beyond which float32 loses it."""

    def check_both(name: str, value: Any) -> None:
        if check_positive(name, value) > maximum:
            raise InputError(
                f"{name}={value!r}: expected a number above 0 and at most {maximum:g}; lower it"
            )

    return check_both


COST: dict[str, Check] = {"cost.watch": positive(1e6), "cost.decide": positive(1e6)}
"""How long a question takes, see ``acquisition.per_second.Cost``."""
