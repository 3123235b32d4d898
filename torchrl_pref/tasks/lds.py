"""LDS: a linear dynamical system of three points, each pushed along a line of its own.

From Bıyık et al. (*Asking easy questions: a user-friendly approach to active reward learning*, CoRL
2019) and their released code, which sends each of its 15 inputs to all three points. The released
scales are the spread of the features under those inputs; the three speed features are then one and
the same. Under either inputs the features are those that their code gives, see
``benchmarks/authors.py``.

Shapes: T = 25 steps, D = 6 features, ``…`` any leading dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_pref.errors import check_flag
from torchrl_pref.tasks.controlled import ControlledTask
from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Scene, Shape

SEGMENTS, STEPS = 5, 5
"""The inputs are constant in each of 5 segments of 5 steps."""

CARRY = (1.0, 0.5, 1.2)
"""What a point moves in a step, for a speed of 1."""

GAIN = (1.0, 0.3, 1.5)
"""What a point's speed rises in a step, for an input of 1."""

BOUNDS = (0.1, 0.2, 0.1)
"""The inputs are between minus these and these."""

SPEED_SCALES = (0.3805254, 0.11415762, 0.5707881)
POSITION_SCALES = (4.072655, 0.94199475, 7.10111927)
"""By which a third of each feature is divided."""

TARGET = 1.0
"""Where each point ought to be."""


def push(inputs: Tensor) -> Tensor:
    """Move the points from rest at 0: first each position by its old speed, then the speed.

    Args:
        inputs: (… T 3).

    Returns:
        (… T 6), position and speed of the first point, the second and the third after each step.
    """
    carry, gain = inputs.new_tensor(CARRY), inputs.new_tensor(GAIN)
    position = speed = torch.zeros_like(inputs[..., 0, :])
    states = []
    for each in inputs.unbind(-2):
        position, speed = position + carry * speed, speed + gain * each
        states.append(torch.stack([position, speed], -1).flatten(-2))
    return torch.stack(states, -2)


class LDSTask(ControlledTask):
    """Motions under random inputs: three of them in five segments, drawn between their bounds.

    The features are, for one point after the other, three times the mean size of its speed and of
    its distance to 1, over the released scales.

    Args:
        released_inputs: move the points as the released code does, which sends the 15 inputs one by
            one to all three points, a step each, and none in the last ten steps.

    Raises:
        InputError: ``released_inputs`` is neither true nor false.
    """

    feature_names = ("speed 1", "distance 1", "speed 2", "distance 2", "speed 3", "distance 3")

    low = -torch.tensor(BOUNDS * SEGMENTS)
    high = torch.tensor(BOUNDS * SEGMENTS)

    def __init__(self, released_inputs: bool = False) -> None:
        self.released_inputs = check_flag("released_inputs", released_inputs)

    def roll_out(self, controls: Tensor) -> Tensor:
        """See :meth:`ControlledTask.roll_out`: (… 25 6), see :func:`push`, under inputs (… 15), the
        three of the first segment first."""
        if self.released_inputs:
            one_by_one = controls.unsqueeze(-1).expand(*controls.shape, 3)
            rest = torch.zeros_like(one_by_one[..., : SEGMENTS * STEPS - len(self.low), :])
            return push(torch.cat([one_by_one, rest], -2))
        return push(controls.unflatten(-1, (SEGMENTS, 3)).repeat_interleave(STEPS, -2))

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`: (… 6)."""
        positions, speeds = trajectories[..., ::2], trajectories[..., 1::2]
        scales = trajectories.new_tensor([SPEED_SCALES, POSITION_SCALES])
        each = [speeds.abs().mean(-2), (positions - TARGET).abs().mean(-2)]
        return (3 * torch.stack(each, -2) / scales).mT.flatten(-2)

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: a strip for each point, in which time runs to the right, with the
        line of where it ought to be. A strip is as high as that point can go."""
        reach = self.roll_out(self.high)[..., ::2].abs().amax(0).tolist()
        still: list[Shape] = []
        curves = []
        for row, (values, far) in enumerate(zip(trajectory[:, ::2].T.tolist(), reach, strict=True)):
            middle = -row * (1 + GAP)
            across = [LENGTH * (step + 1) / len(trajectory) for step in range(len(values))]
            up = [middle + value / far / 2 for value in values]
            curves.append(list(zip(across, up, strict=True)))
            still += strip(row + 1, middle, middle + TARGET / far / 2)
            still.append(Line(((0.0, middle), *curves[-1]), COLOURS[row], 1.8))
        frames = tuple(
            tuple(Disc(curve[step], 0.06, COLOURS[row]) for row, curve in enumerate(curves))
            for step in range(len(trajectory))
        )
        low, high = (-0.1, -2 * (1 + GAP) - 0.6), (LENGTH + 0.1, 0.6)
        return Scene(low, high, tuple(still), frames)


LENGTH, GAP = 1.7, 0.07
"""Of a strip, and between two, in heights of a strip."""

COLOURS = ("#0072b2", "#d55e00", "#009e73")


def strip(number: int, middle: float, target: float) -> list[Shape]:
    """The ground of a point's strip, and its target."""
    low, high = middle - 0.5, middle + 0.5
    return [
        Patch(((0.0, low), (LENGTH, low), (LENGTH, high), (0.0, high)), "#f0f0f0"),
        Line(((0.0, target), (LENGTH, target)), "#777777", 1.0, dashed=True),
        Label((0.4, high - 0.12), f"point {number}"),
    ]
