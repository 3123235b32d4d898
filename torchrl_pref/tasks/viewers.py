"""What is seen of a simulator's trajectories, from the numbers that it observes.

Shapes: T observations in a trajectory, S numbers of an observation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

from torch import Tensor

from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Point, Scene, Shape

Viewer: TypeAlias = Callable[[Tensor], Scene]
"""From the observations (T S) of an episode to what is seen of it."""

OURS, PALE = "#d55e00", "#efb183"

MOST_STRIPS = 8
"""Numbers of an observation that are drawn."""

ROOM = 0.72
"""Of a strip for its curve, below its name."""


def mountain_car(observations: Tensor) -> Scene:
    """The car on its hill, sin(3x), and where it has been; the flag is the goal."""
    hill = tuple((x / 50, _height(x / 50)) for x in range(-60, 31))
    ground = Patch(((-1.2, -0.1), *hill, (0.6, -0.1)), "#e7eee3")
    pole = Line(((0.45, _height(0.45)), (0.45, _height(0.45) + 0.2)), "#333333")
    flag = Patch(((0.45, 1.2), (0.55, 1.16), (0.45, 1.12)), "#009e73")
    places: list[Point] = [(float(x), _height(float(x)) + 0.05) for x in observations[:, 0]]
    trail = Line(tuple(places), PALE, 3.0)
    frames = tuple((Disc(place, 0.05, OURS),) for place in places)
    return Scene((-1.2, -0.1), (0.6, 1.25), (ground, Line(hill), pole, flag, trail), frames)


def _height(x: float) -> float:
    """Of the hill, as Gymnasium draws it."""
    return 0.45 * math.sin(3 * x) + 0.55


def lunar_lander(observations: Tensor) -> Scene:
    """The lander, turned by its tilt, its way, and the pad."""
    ground = Patch(((-3.0, -0.4), (3.0, -0.4), (3.0, 0.0), (-3.0, 0.0)), "#d9d9d9")
    pad = Line(((-0.2, 0.0), (0.2, 0.0)), "#009e73", 4.0)
    places = [(float(x), float(y)) for x, y in observations[:, :2]]
    frames = tuple(
        (_lander(place, float(tilt)),)
        for place, tilt in zip(places, observations[:, 4], strict=True)
    )
    xs, ys = zip(*(point for (body,) in frames for point in body.points), strict=True)
    low, high = (min(*xs, -1.0), min(*ys, -0.2)), (max(*xs, 1.0), max(*ys, 1.6))
    return Scene(low, high, (ground, pad, Line(tuple(places), PALE)), frames)


def _lander(place: Point, tilt: float) -> Patch:
    """A lander with its feet apart."""
    (x, y), cosine, sine = place, math.cos(tilt), math.sin(tilt)
    body = ((-0.05, 0.12), (0.05, 0.12), (0.1, -0.04), (-0.1, -0.04))
    return Patch(tuple((x + a * cosine - b * sine, y + a * sine + b * cosine) for a, b in body))


def strips(observations: Tensor, low: Tensor, high: Tensor) -> Scene:
    """Each number of the observations (T S) over time, in a strip from ``low`` to ``high`` (S)."""
    still: list[Shape] = []
    curves: list[list[Point]] = []
    across = [step / max(1, len(observations) - 1) * 2 for step in range(len(observations))]
    for row in range(min(MOST_STRIPS, observations.shape[1])):
        base = -1.1 * row
        share = (observations[:, row] - low[row]) / (high[row] - low[row]).clamp(min=1e-9)
        up = [base + ROOM * float(one) for one in share.clamp(0, 1)]
        curves.append(list(zip(across, up, strict=True)))
        corners = ((0.0, base), (2.0, base), (2.0, base + 1), (0.0, base + 1))
        still += [Patch(corners, "#f0f0f0"), Line(tuple(curves[-1]), OURS)]
        still.append(Label((0.7, base + 0.86), f"observation {row + 1}"))
    frames = tuple(
        tuple(Disc(curve[step], 0.06, OURS) for curve in curves)
        for step in range(len(observations))
    )
    return Scene((-0.1, -1.1 * len(curves) + 1.0), (2.1, 1.1), tuple(still), frames)


VIEWERS: dict[str, Viewer] = {
    "MountainCarContinuous-v0": mountain_car,
    "LunarLander-v3": lunar_lander,
    "LunarLanderContinuous-v3": lunar_lander,
}
"""Of the environments that have a picture of their own."""
