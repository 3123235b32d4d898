"""The options of a question as text: side by side where there is room, else below each other.

Shapes: K options of a question, T frames.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from string import ascii_uppercase
from typing import NamedTuple, TextIO

from torchrl_pref.study.terminal.drawing import MARKS, Size, as_text, draw, ways_of
from torchrl_pref.study.terminal.lines import TOGETHER
from torchrl_pref.tasks.scene import Label, Patch, Picture, Scene, corners

GAP = 3
"""Cells between two options."""

NARROWEST, WIDEST = 24, 44
"""Cells of a drawing across, where it is not higher than there is room for."""

LOWEST, HIGHEST = 18, 40
"""Cells of a drawing up that there is always room for, and at most."""

AROUND = 12
"""Rows of a terminal that a question takes beside the drawings."""

BAR, WIDEST_NAME = 10, 40
"""Cells of a bar to either side of its zero, and of what stands before it."""


class Room(NamedTuple):
    """What a terminal can show."""

    columns: int
    lines: int
    colours: int
    """2²⁴, 256, or 0 for none."""


class Bar(NamedTuple):
    """A feature as a bar."""

    name: str
    """And its value."""
    size: float
    """From -1 to 1."""


def room_of(terminal: TextIO) -> Room:
    """What there is room for in a terminal; 80 by 24 letters without colour in what is none."""
    columns, lines = shutil.get_terminal_size()
    plain = "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"
    colours = 2**24 if os.environ.get("COLORTERM") in ("truecolor", "24bit") else 256
    return Room(columns, lines, colours if terminal.isatty() and not plain else 0)


def at_one_scale(scenes: Sequence[Scene]) -> list[Scene]:
    """The same scenes, all of which show all that one does."""
    low, high = corners(scenes)
    return [replace(scene, low=low, high=high) for scene in scenes]


def options_as_text(
    scenes: Sequence[Scene], room: Room, step: int | None = None, letters: str = ascii_uppercase
) -> list[str]:
    """K options in rows of text.

    Args:
        scenes: of the options, at one scale; of pictures the names of their files are given.
        room: what they have to fit into.
        step: the frame that is shown; of one that is shorter its last. None: whole trajectories.
        letters: K, of the options; empty for one that needs none.
    """
    pictures = [files_of(scene) for scene in scenes]
    if any(pictures):
        return [
            f"  {letters[n : n + 1]}  {printable(', '.join(files))}"
            for n, files in enumerate(pictures)
        ]
    bars = [found for scene in scenes if (found := bars_of(scene)) is not None]
    if len(bars) == len(scenes):
        name = min(WIDEST_NAME, max(len(bar.name) for one in bars for bar in one))
        width = name + 2 * BAR + 2
        blocks = [[_bar_row(bar, name) for bar in one] for one in bars]
    else:
        size = _size_of(scenes, room)
        width, blocks = size.columns, []
        for scene in scenes:
            moment = None if step is None else min(step, len(scene.frames) - 1)
            blocks.append(as_text(draw(scene, size, moment), room.colours))
    framed = [_framed(block, letters[n : n + 1], width) for n, block in enumerate(blocks)]
    beside = max(1, (room.columns + GAP) // (width + 2 + GAP))
    rows: list[str] = []
    for first in range(0, len(framed), beside):
        rows += [(" " * GAP).join(row) for row in zip(*framed[first : first + beside], strict=True)]
    return rows


def marks_of(scenes: Sequence[Scene]) -> str | None:
    """What marks the start and the end of what moves; None where nothing does."""
    most = max(len(ways_of(scene)) for scene in scenes)
    if not most or any(map(files_of, scenes)):
        return None
    starts, ends = zip(*MARKS[:most], strict=True)
    return f"{' '.join(starts)} start   {' '.join(ends)} end"


def files_of(scene: Scene) -> list[str]:
    """The image files that a scene shows, in order; of many the first and the last."""
    shapes = [*scene.still, *(shape for frame in scene.frames for shape in frame)]
    found = list(dict.fromkeys(one.path for one in shapes if isinstance(one, Picture)))
    return found if len(found) < 3 else [found[0], f"… {len(found)} files …", found[-1]]


def bars_of(scene: Scene) -> list[Bar] | None:
    """The features of a scene of :func:`tasks.base.feature_bars`; None of any other."""
    shapes = scene.frames[0]
    bars, labels = shapes[::2], shapes[1::2]
    if scene.still or scene.equal or len(scene.frames) > 1 or len(bars) != len(labels):
        return None
    reach, found = max(abs(scene.low[0]), abs(scene.high[0])), []
    for bar, label in zip(bars, labels, strict=True):
        if not isinstance(bar, Patch) or not isinstance(label, Label):
            return None
        far = max((x for x, _ in bar.points), key=abs)
        found.append(Bar(printable(label.text), far / reach))
    return found or None


def printable(text: str) -> str:
    """A text without what a terminal would act upon."""
    return "".join(one if one.isprintable() or one == TOGETHER else "?" for one in text)


def _bar_row(bar: Bar, width: int) -> str:
    name, length = bar.name, round(abs(bar.size) * BAR)
    if len(name) > width:
        name = f"{name[: width // 2]}…{name[len(name) + 1 - (width - width // 2) :]}"
    left, right = ("", "▇" * length) if bar.size > 0 else ("▇" * length, "")
    return f"{name:<{width}} {left:>{BAR}}│{right:<{BAR}}"


def _size_of(scenes: Sequence[Scene], room: Room) -> Size:
    """Of each drawing: as many side by side as are not too narrow."""
    (left, low), (right, high) = corners(scenes)
    up = (high - low) / (right - left) / 2 if scenes[0].equal else 0.375  # a cell is 1 by 2
    most_up = min(HIGHEST, max(LOWEST, room.lines - AROUND))
    widest = min(WIDEST, max(8, int(most_up / up)), max(8, room.columns - 2))
    least = min(NARROWEST, widest)
    beside = min(len(scenes), max(1, (room.columns + GAP) // (least + 2 + GAP)))
    columns = min(widest, (room.columns + GAP) // beside - GAP - 2)
    return Size(max(8, columns), min(most_up, max(2, round(columns * up))))


def _framed(rows: list[str], letter: str, width: int) -> list[str]:
    """Rows of some width with a line around them, and a letter above."""
    title = f"─ {letter} " if letter else ""
    middle = [f"│{row}│" for row in rows]
    return [f"┌{title:─<{width}}┐", *middle, f"└{'─' * width}┘"]
