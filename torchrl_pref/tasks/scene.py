"""A trajectory as shapes on a plane: what a person is shown, whoever draws it.

A task says what there is to see, and nothing of how it is drawn: the same scene becomes a picture,
frames, an animation, or a page in a browser.

Shapes: T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TypeAlias

Point: TypeAlias = tuple[float, float]
"""x to the right and y up, in the task's own unit."""


@dataclass(frozen=True)
class Line:
    """A line through points."""

    points: tuple[Point, ...]
    colour: str = "#555555"
    width: float = 1.5
    dashed: bool = False


@dataclass(frozen=True)
class Patch:
    """A filled polygon."""

    points: tuple[Point, ...]
    colour: str = "#555555"


@dataclass(frozen=True)
class Disc:
    """A filled circle, its radius in the task's unit."""

    centre: Point
    radius: float
    colour: str = "#555555"


@dataclass(frozen=True)
class Label:
    """Words, centred at a point."""

    at: Point
    text: str
    colour: str = "#333333"


@dataclass(frozen=True)
class Picture:
    """An image file in the scene, as large as fits: PNG, JPEG or GIF, by its absolute path."""

    path: str


Shape: TypeAlias = Line | Patch | Disc | Label | Picture


@dataclass(frozen=True)
class Scene:
    """What is seen of one trajectory.

    Attributes:
        low, high: corners of what is seen.
        still: what does not move; the ground may go on beyond the corners, where it is cut off.
        frames: T, what is seen of each moment beside it, drawn on top.
        equal: whether a unit is as long across as up, as on a map.
    """

    low: Point
    high: Point
    still: tuple[Shape, ...]
    frames: tuple[tuple[Shape, ...], ...]
    equal: bool = True

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """All that is seen, whenever."""
        return (*self.still, *chain(*self.frames))


def corners(scenes: Sequence[Scene]) -> tuple[Point, Point]:
    """The corners of what is seen of several trajectories, to show them at one scale."""
    lows, highs = ([scene.low for scene in scenes], [scene.high for scene in scenes])
    return (
        (min(x for x, _ in lows), min(y for _, y in lows)),
        (max(x for x, _ in highs), max(y for _, y in highs)),
    )
