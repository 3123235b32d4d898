"""The options of a question played in a terminal, one moment drawn over the other.

Shapes: K options of a question, T frames.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from torchrl_pref.study.terminal.options import Room, options_as_text
from torchrl_pref.tasks.scene import Scene

SECONDS = 4.0
"""That a play takes."""

MOST_FRAMES = 40
"""Of a play; more than a terminal can draw in that time are left out."""

MOMENTS = 4
"""That are printed where nothing can be drawn over."""


def play(scenes: Sequence[Scene], room: Room, letters: str) -> None:
    """Show how trajectories go on: all at once where the terminal is high enough, else one after
    the other; a few moments below each other where nothing can be drawn over.

    Args:
        scenes: of K options, at one scale.
        room: of the terminal.
        letters: K, of the options; empty for one that needs none.
    """
    groups = [(list(scenes), letters)]
    if len(options_as_text(scenes, room, 0)) >= room.lines:
        groups = [([one], letters[n : n + 1]) for n, one in enumerate(scenes)]
    for group, own in groups:
        high = len(options_as_text(group, room, 0)) >= room.lines
        if high or not sys.stdout.isatty():
            _print_moments(group, room, own)
        else:
            _play(group, room, own)


def steps_of(scenes: Sequence[Scene], most: int) -> list[int]:
    """An even choice of the frames of the longest, the first and the last among them."""
    length = max(len(scene.frames) for scene in scenes)
    count = min(length, most)
    return [round(number * (length - 1) / max(1, count - 1)) for number in range(count)]


def _print_moments(scenes: list[Scene], room: Room, letters: str) -> None:
    length = max(len(scene.frames) for scene in scenes)
    for step in steps_of(scenes, MOMENTS):
        print(f"moment {step + 1} of {length}")
        print("\n".join(options_as_text(scenes, room, step, letters)))


def _play(scenes: list[Scene], room: Room, letters: str) -> None:
    steps = steps_of(scenes, MOST_FRAMES)
    due = time.monotonic()
    for number, step in enumerate(steps):
        rows = options_as_text(scenes, room, step, letters)
        upward = f"\x1b[{len(rows)}A" if number else ""
        print(upward + "\n".join(rows), flush=True)
        due += SECONDS / len(steps)
        time.sleep(max(0.0, due - time.monotonic()))
