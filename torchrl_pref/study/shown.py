"""What a person in a study was shown, and what they said.

Letters: K options of a question.
"""

from __future__ import annotations

from dataclasses import dataclass

QUESTION, REPEAT, ATTENTION = "question", "repeat", "attention"
"""Why something is shown: to learn from it; to see whether the same is said again; to see whether
the person reads. The belief is told answers to the first alone."""


@dataclass(frozen=True)
class Shown:
    """A question as a person sees it.

    Attributes:
        key: names this showing of it, and no other.
        purpose: ``QUESTION``, ``REPEAT`` or ``ATTENTION``.
        query: its index in the pool.
        order: K, the option at each place.
        again: whether an answer to it was taken back.
        wanted: what an attention check asks for, an answer in terms of places.
        of: of a repetition, the key of what it repeats.
    """

    key: str
    purpose: str
    query: int
    order: tuple[int, ...]
    again: bool = False
    wanted: int | None = None
    of: str | None = None


@dataclass(frozen=True)
class Said:
    """An answer.

    Attributes:
        shown: to what.
        said: the answer in terms of places; None where the person could not say.
        answer: the answer in terms of options.
        seconds: that it took, as far as the page could tell.
        replays: how often something was watched again.
        at: when, by the clock of the machine.
    """

    shown: Shown
    said: int | None
    answer: int | None
    seconds: float
    replays: int
    at: str

    @property
    def passed(self) -> bool | None:
        """Whether an attention check was answered as it asks; None where it is no such."""
        return None if self.shown.wanted is None else self.said == self.shown.wanted
