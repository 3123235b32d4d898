"""Columns of numbers, whatever file they were in: which are read, and why a file is refused."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from torchrl_pref.tensors import default_names

Columns: TypeAlias = dict[str, "np.ndarray[Any, Any]"]
"""By name, numbers or texts (N) or (N K)."""

RATIO, ALWAYS = 100, 2**26
"""What is read may take so many times the file's size, and always so many bytes."""

VALUE, TEXT = 16, 200
"""Bytes of a number, or of where a text is: twice 8, as what is read is copied once, to be put
together; and what is kept of another text beside its letters, to find it again."""

ARRAY = "features"
NAMES = "feature_names"

KIND = "file of features"


MAX_COLUMNS = 10_000


class Refused(Exception):
    """Why a file is refused, without its path."""


class Room:
    """How many bytes the columns of a file may still take, all together.

    Args:
        limit: of all.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self._taken = limit, 0
        self._texts: dict[str, str] = {}

    def take(self, name: str, count: int) -> None:
        """Make room for a column of so many numbers, or texts that are kept elsewhere.

        Raises:
            Refused: there is none.
        """
        self.take_bytes(f"column {name!r:.80} of {count:,} values", VALUE * count)

    def text(self, name: str, text: str) -> str:
        """A text of a column, which takes room once, however often it comes.

        Raises:
            Refused: there is none.
        """
        if text not in self._texts:
            self.take_bytes(f"the texts of column {name!r:.80}", sys.getsizeof(text) + TEXT)
        return self._texts.setdefault(text, text)

    def take_bytes(self, what: str, size: int) -> None:
        """Make room for something else of a file.

        Raises:
            Refused: there is none.
        """
        self._taken += size
        if self._taken > self.limit:
            raise Refused(
                f"with {what} it would take {self._taken / 1e6:.0f} MB; expected at most "
                f"{self.limit / 1e6:.0f} MB from a file of its size; leave some out"
            )


class Choice(NamedTuple):
    """Which columns are read."""

    wanted: Collection[str] | None
    """Those of numbers; None: all but that of texts."""
    texts: str | None
    """That of texts; None: there is none."""

    def pick(self, there: Sequence[str]) -> list[str]:
        """The names to read, of those that are there.

        Raises:
            Refused: one is there twice, or is not there, or there are too many.
        """
        if len(there) > MAX_COLUMNS:
            raise Refused(f"holds {len(there)} columns; expected at most {MAX_COLUMNS}")
        for name, count in Counter(there).items():
            if count > 1:
                raise Refused(f"holds the column {name!r:.80} twice; rename one")
        wanted = list(there if self.wanted is None else self.wanted)
        if self.texts is not None:
            wanted = [name for name in wanted if name != self.texts] + [self.texts]
        missing = [name for name in wanted if name not in there]
        if missing:
            raise Refused(
                f"holds no column {missing[0]!r:.80}; expected one of {', '.join(there)!s:.300}"
            )
        return wanted


def of_arrays(
    there: list[str],
    load: Callable[[str], np.ndarray[Any, Any]],
    labels: list[str] | None,
    choice: Choice,
) -> Columns:
    """Columns from arrays: each is one, or one holds them all."""
    if ARRAY not in there:
        return {name: load(name) for name in choice.pick(there)}
    features = load(ARRAY)
    if features.ndim not in (2, 3) or features.shape[-1] > MAX_COLUMNS:
        raise Refused(
            f"{ARRAY} of shape {features.shape}; expected (N trajectories, D) or "
            f"(N queries, K options, D), with D at most {MAX_COLUMNS}"
        )
    names = default_names(features.shape[-1]) if labels is None else labels
    if not isinstance(names, (list, tuple)) or len(names) != features.shape[-1]:
        count = len(names) if isinstance(names, (list, tuple)) else "no list"
        raise Refused(f"{NAMES}: {count} for {features.shape[-1]} features; expected one of each")
    names = [str(name) for name in names]
    beside = [name for name in there if name == choice.texts]
    chosen = choice.pick([*names, *beside])
    return {
        name: features[..., names.index(name)] if name in names else load(name) for name in chosen
    }
