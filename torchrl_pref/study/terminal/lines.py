"""What a person types in the terminal, and what it means.

Letters: R possible answers.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from string import ascii_lowercase
from typing import Any, NamedTuple

TOGETHER = "\N{NO-BREAK SPACE}"
"""Keeps what can be typed in one line with what it does."""


class Command(NamedTuple):
    """What can be typed beside answers."""

    key: str
    """Short; it is none where an answer has the same."""
    word: str
    short: str
    """What it does, in the line below a question."""
    help: str


COMMANDS = (
    Command("r", "replay", "replay", "watch the options again"),
    Command("?", "s", "cannot say", "you cannot say; s is the same"),
    Command("u", "undo", "undo", "take an answer back; u 3 takes back the third"),
    Command("w", "what", "learned so far", "what has been learned so far"),
    Command("h", "help", "help", "this list, and what you read before the first question"),
    Command("q", "quit", "stop", "stop here; you can go on later"),
)

BESIDE = ("u", "w", "h", "q")
"""Keys of what can be done where no question is open."""


class Typed(NamedTuple):
    """What a line means."""

    command: str
    """The key of a command, or ``answer``."""
    number: int | None = None
    """Of an answer, or what was typed behind the command."""


def keys_of(answers: list[dict[str, Any]]) -> dict[str, int]:
    """R answers (:func:`state.possible_answers`) by what is typed for each: its key, or the letters
    of the places that a person points at, or its number."""
    found = {}
    for one in answers:
        letters = "".join(ascii_lowercase[place] for place in one["places"] or ())
        found[one["key"] or letters or str(one["answer"] + 1)] = one["answer"]
    return found


def understood(line: str, answers: Mapping[str, int], commands: Collection[str]) -> Typed | None:
    """What a line means; None where it means nothing.

    Args:
        line: as typed.
        answers: numbers of answers, by what is typed for them.
        commands: keys of the commands that there are.
    """
    line = line.strip().lower()
    together = re.sub(r"[\s,>]+", "", line)
    if together in answers:
        return Typed("answer", answers[together])
    begun = [number for typed, number in answers.items() if typed.startswith(together)]
    if len(begun) == 1:  # as of a ranking where one option is left, which is the last
        return Typed("answer", begun[0])
    parts = re.fullmatch(r"(\?|[a-z]+)\s*(\d{0,9})", line)
    if parts is None:
        return None
    word, number = parts.groups()
    for one in COMMANDS:
        if one.key in commands and word in (one.key, one.word) and (one.key == "u" or not number):
            return Typed(one.key, int(number) if number else None)
    return None


def hint(answers: list[dict[str, Any]], commands: Collection[str]) -> str:
    """What can be typed, in few words, each of which keeps :data:`TOGETHER`."""
    keys = keys_of(answers)
    letters, others, in_order = [], [], []
    for typed, one in zip(keys, answers, strict=True):
        if one["label"].lower() == typed:
            letters.append(typed)
        elif one["key"] is None and one["places"] is not None:
            in_order.append(f"letters in order, as “{' '.join(typed)}” for {one['label']}")
        else:
            others.append(f"{typed} {one['label']}")
    parts = [", ".join(letters)] * bool(letters) + others
    parts += in_order[len(in_order) // 2 :][:1]  # one is enough, and not that of the order shown
    for command in COMMANDS:
        if command.key in commands:
            key = command.word if command.key in keys else command.key
            parts.append(f"{key} {command.short}")
    return " · ".join(part.replace(" ", TOGETHER) for part in parts)
