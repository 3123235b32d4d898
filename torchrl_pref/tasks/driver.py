"""Driver: a car on a road of three lanes, beside another one that changes lanes.

The task of Sadigh et al. (*Active preference-based learning of reward functions*, RSS 2017) as it
was released with Bıyık and Sadigh (*Batch active preference-based learning of reward functions*,
CoRL 2018) and Bıyık et al. (*Asking easy questions*, CoRL 2019). The features are those that their
code gives, see ``benchmarks/authors.py``.

Shapes: T = 50 steps of 0.1 s, D = 4 features, ``…`` any leading dimensions. The unit of length is
the authors' own, in which a lane is 0.17 wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_pref.tasks.controlled import ControlledTask
from torchrl_pref.tasks.scene import Line, Patch, Point, Scene, Shape

STEP = 0.1
"""Seconds."""

SEGMENTS, STEPS = 5, 10
"""The controls of a drive are constant in each of 5 segments of 10 steps."""

LANE = 0.17
"""Width of a lane."""

LANES = (-LANE, 0.0, LANE)
"""x of the middle of each lane; the road runs along y."""

START = (0.0, -0.3, math.pi / 2, 0.4)
"""x, y, heading in radians and speed of the car, before the first step."""

OTHER_START = (LANE, 0.0, math.pi / 2, 0.41)
OTHER_CONTROLS = ((0.0, 0.41), (1.0, 0.41), (-1.0, 0.41), (0.0, 0.533), (0.0, 0.533))
"""The other car's, by segment: it moves over to the middle lane, straightens and speeds up."""

SCALES = (0.15343634, 0.42202643, 0.06112367, 0.15258019)
"""What the features are divided by in CoRL 2019."""


def drive(start: tuple[float, ...], controls: Tensor) -> Tensor:
    """Move a car: x += v cos θ dt, y += v sin θ dt, θ += v steer dt, v += (push - v) dt.

    Args:
        start: x, y, heading and speed.
        controls: (… T 2), steering and push of each step.

    Returns:
        (… T 4), x, y, heading and speed after each step.
    """
    blank = torch.zeros_like(controls[..., 0, 0])
    x, y, heading, speed = (blank + value for value in start)
    states = []
    for steer, push in (control.unbind(-1) for control in controls.unbind(-2)):
        x, y, heading, speed = (
            x + STEP * speed * heading.cos(),
            y + STEP * speed * heading.sin(),
            heading + STEP * speed * steer,
            speed + STEP * (push - speed),
        )
        states.append(torch.stack([x, y, heading, speed], -1))
    return torch.stack(states, -2)


class DriverTask(ControlledTask):
    """Drives under random controls: steering and push of five segments, each from -1 to 1.

    The features are means over the states after each step: nearness to the middle of a lane,
    squared difference of the speed to 1, sine of the heading (1 along the road), and nearness to
    the other car; each over its scale of CoRL 2019.
    """

    feature_names = ("lane keeping", "speed error", "heading", "near other car")

    low = torch.full((2 * SEGMENTS,), -1.0)
    high = torch.full((2 * SEGMENTS,), 1.0)

    def __init__(self) -> None:
        controls = torch.tensor(OTHER_CONTROLS, dtype=torch.float64)
        self.other = drive(OTHER_START, controls.repeat_interleave(STEPS, 0))

    def roll_out(self, controls: Tensor) -> Tensor:
        """See :meth:`ControlledTask.roll_out`: (… 50 4), x, y, heading and speed after each step,
        under controls (… 10), steering and push of the segments by turns."""
        segments = controls.unflatten(-1, (SEGMENTS, 2))
        return drive(START, segments.repeat_interleave(STEPS, -2))

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`: (… 4)."""
        x, y, heading, speed = trajectories.unbind(-1)
        other_x, other_y = self.other.to(trajectories)[:, :2].unbind(-1)
        from_lane = torch.stack([(x - middle).square() for middle in LANES]).amin(0)
        from_other = 7 * (x - other_x).square() + 3 * (y - other_y).square()
        each = [(-30 * from_lane).exp(), (speed - 1).square(), heading.sin(), (-from_other).exp()]
        return torch.stack(each, -1).mean(-2) / trajectories.new_tensor(SCALES)

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: the road from above, both cars, where each was second by second,
        and their ways."""
        ways = (
            (START, trajectory.tolist(), "#d55e00", "#efb183"),
            (OTHER_START, self.other.tolist(), "#33628f", "#9fb6cf"),
        )
        trails: list[Shape] = []
        for _, states, _, pale in ways:
            trails += [car(state, pale) for state in states[STEPS - 1 : -1 : STEPS]]
        for start, states, colour, _ in ways:
            trails.append(Line(tuple((x, y) for x, y, *_ in (start, *states)), colour, 1.0))
        frames = tuple(
            tuple(car(states[step], colour) for _, states, colour, _ in ways)
            for step in range(len(trajectory))
        )
        seen = [point for frame in frames for shape in frame for point in shape.points]
        xs, ys = zip(*seen, (-0.42, -0.45), (0.42, 2.4), strict=True)
        return Scene((min(xs), min(ys)), (max(xs), max(ys)), (*road(), *trails), frames)


CAR = (0.2, 0.09)
"""Length and width that a car is drawn with; to the features it is a point."""


def car(state: Sequence[float], colour: str) -> Patch:
    """A car seen from above, pointing where it heads."""
    x, y, heading, _ = state
    along = (math.cos(heading) / 2, math.sin(heading) / 2)
    length, width = CAR
    corners: list[Point] = [
        (
            x + a * length * along[0] - b * width * along[1],
            y + a * length * along[1] + b * width * along[0],
        )
        for a, b in ((1, 0.6), (0.6, 1), (-1, 1), (-1, -1), (0.6, -1), (1, -0.6))
    ]
    return Patch(tuple(corners), colour)


def road() -> tuple[Shape, ...]:
    """The lanes, longer than any drive, and what is beside them."""
    end, edge, between = 30.0, 1.5 * LANE, 0.5 * LANE
    verge = Patch(((-end, -end), (end, -end), (end, end), (-end, end)), "#e7eee3")
    tar = Patch(((-edge, -end), (edge, -end), (edge, end), (-edge, end)), "#d9d9d9")
    sides = [Line(((x, -end), (x, end)), "#8c8c8c") for x in (-edge, edge)]
    dashes = [Line(((x, -end), (x, end)), "#ffffff", dashed=True) for x in (-between, between)]
    return verge, tar, *sides, *dashes
