"""What a user did wrong, said in one line: what came, what was expected, how to mend it."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

LONGEST = 1200
"""Letters of an error that are shown."""

UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""What a terminal would act upon, or cannot write; other blanks may be of a path, and stay."""


def in_one_line(text: str) -> str:
    """A text that may quote anything, in one line that can be printed."""
    return UNPRINTABLE.sub("?", re.sub(r"\s*\n\s*", " ", text).strip())


class InputError(ValueError):
    """Input that cannot be used. The message is one line, written for the person who gave it.

    Args:
        message: what came, what was expected and how to mend it; what it quotes of a file or of a
            library may hold anything, and is made printable here.
    """

    def __init__(self, message: str) -> None:
        super().__init__(in_one_line(message))


class OtherSetup(InputError):
    """A strategy that is for the other setup alone."""


def check_count(name: str, value: Any, minimum: int) -> int:
    """Return ``value`` if it is a whole number of at least ``minimum``.

    Raises:
        InputError: it is not.
    """
    if isinstance(value, float) and value.is_integer() and value >= minimum:
        raise InputError(
            f"{name}={value!r}: expected a whole number, without a point or an exponent; "
            f"set {name}={value:.0f}"
        )
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise InputError(
            f"{name}={value!r}: expected a whole number of at least {minimum}; "
            f"set {name}={minimum} or more"
        )
    return value


def check_batch(batch: int, budget: int) -> int:
    """Return n, how many questions are asked at once, if the budget H is a multiple of it.

    Raises:
        InputError: it is not, or it is below 1.
    """
    if budget % check_count("setup.batch", batch, 1):
        raise InputError(
            f"setup.budget={budget} with setup.batch={batch}: expected a budget of whole batches; "
            f"set setup.budget={batch * max(1, round(budget / batch))}, or another batch"
        )
    return batch


def check_type(name: str, value: Any, kind: type, example: str) -> None:
    """Refuse a value that is not an object of ``kind``.

    Raises:
        InputError: it is not.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIO" else "a"
        raise InputError(
            f"{name} of type {type(value).__name__}: expected {article} {kind.__name__}, such as "
            f"{example}"
        )


def check_seed(name: str, value: Any, bits: int = 31) -> int:
    """Return ``value`` if it is a whole number from 0 to 2³¹ - 1, or of so many bits.

    Raises:
        InputError: it is not.
    """
    if check_count(name, value, 0) >= 2**bits:
        raise InputError(f"{name}={value}: expected a whole number below {2**bits}")
    return int(value)


def check_flag(name: str, value: Any) -> bool:
    """Return ``value`` if it is true or false.

    Raises:
        InputError: it is not.
    """
    if not isinstance(value, bool):
        raise InputError(f"{name}={value!r}: expected true or false")
    return value


def _is_number(value: Any) -> bool:
    """Whether it is a number, and neither true nor false."""
    return not isinstance(value, bool) and isinstance(value, (int, float))


def check_positive(name: str, value: Any) -> float:
    """Return ``value`` as a float if it is a finite number above zero.

    Raises:
        InputError: it is not.
    """
    if not _is_number(value) or not math.isfinite(value) or value <= 0:
        raise InputError(f"{name}={value!r}: expected a finite number above 0, such as {name}=1.0")
    return float(value)


def check_not_negative(name: str, value: Any) -> float:
    """Return ``value`` as a float if it is a finite number of at least zero.

    Raises:
        InputError: it is not.
    """
    if not _is_number(value) or not math.isfinite(value) or value < 0:
        raise InputError(f"{name}={value!r}: expected a finite number of at least 0")
    return float(value)


def check_between(name: str, value: Any, low: float, high: float) -> float:
    """Return ``value`` as a float if it is a number from ``low`` to ``high``.

    Raises:
        InputError: it is not.
    """
    if not _is_number(value) or not low <= value <= high:
        raise InputError(f"{name}={value!r}: expected a number from {low:g} to {high:g}")
    return float(value)


def check_finite_number(name: str, value: Any) -> float:
    """Return ``value`` as a float if it is a finite number.

    Raises:
        InputError: it is not.
    """
    if not _is_number(value) or not math.isfinite(value):
        raise InputError(f"{name}={value!r}: expected a finite number, such as {name}=0.5")
    return float(value)


def check_share(name: str, value: Any) -> float:
    """Return ``value`` as a float if it is a number from 0 to 1.

    Raises:
        InputError: it is not.
    """
    if not _is_number(value) or not 0 <= value <= 1:
        raise InputError(f"{name}={value!r}: expected a number from 0 to 1, such as {name}=0.5")
    return float(value)


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    """Return ``value`` if it is one of ``choices``.

    Raises:
        InputError: it is not.
    """
    if value not in choices:
        close = difflib.get_close_matches(str(value), choices, 1)
        some = close or choices[: 1 if len(choices) > 3 else None]
        options = " or ".join(f"{name}={choice}" for choice in some)
        mend = f"did you mean {options}?" if close else f"set {options}"
        raise InputError(f"{name}={value!r}: expected one of {', '.join(choices)}; {mend}")
    return str(value)


def one_line(error: Exception) -> str:
    """What an error says, in one line that can be printed, without the middle of what is too
    long."""
    text = in_one_line(str(error))
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} … {text[-LONGEST // 2 :]}"


@contextmanager
def one_line_errors() -> Iterator[None]:
    """End the program with status 2 and one line on stderr where the input was at fault.

    Everything else is a defect of ours and keeps its traceback.
    """
    try:
        yield
    except (InputError, OSError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        raise SystemExit(2) from None
