"""The literature's tasks against loops over plain numbers, and what the authors' code gave."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Generator, Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.controlled import ControlledTask
from torchrl_pref.tasks.driver import DriverTask, car
from torchrl_pref.tasks.lds import LDSTask
from torchrl_pref.tasks.scene import Disc, Line, Patch

Numbers = Sequence[float]


def drive_by_hand(controls: Numbers) -> list[float]:
    """Driver, one number at a time, by the published constants."""
    robot, other = [0.0, -0.3, math.pi / 2, 0.4], [0.17, 0.0, math.pi / 2, 0.41]
    plan = [(0, 0.41), (1, 0.41), (-1, 0.41), (0, 1.3 * 0.41), (0, 1.3 * 0.41)]
    totals = [0.0] * 4
    for step in range(50):
        part = step // 10
        for state, (steer, gas) in (
            (robot, (controls[2 * part], controls[2 * part + 1])),
            (other, plan[part]),
        ):
            x, y, theta, v = state
            state[0] = x + 0.1 * v * math.cos(theta)
            state[1] = y + 0.1 * v * math.sin(theta)
            state[2] = theta + 0.1 * v * steer
            state[3] = v + 0.1 * (gas - v)
        x, y, theta, v = robot
        off = min((x - 0.17) ** 2, x**2, (x + 0.17) ** 2)
        totals[0] += math.exp(-30 * off)
        totals[1] += (v - 1) ** 2
        totals[2] += math.sin(theta)
        totals[3] += math.exp(-(7 * (x - other[0]) ** 2 + 3 * (y - other[1]) ** 2))
    scales = (0.15343634, 0.42202643, 0.06112367, 0.15258019)
    return [total / 50 / scale for total, scale in zip(totals, scales, strict=True)]


def move_by_hand(controls: Numbers, released: bool = False) -> list[float]:
    """LDS, one number at a time, by the published constants."""
    s, totals = [0.0] * 6, [0.0] * 6
    for step in range(25):
        if released:
            u = [controls[step] if step < 15 else 0.0] * 3
        else:
            u = [controls[3 * (step // 5) + i] for i in range(3)]
        s[0] += s[1]
        s[1] += u[0]
        s[2] += 0.5 * s[3]
        s[3] += 0.3 * u[1]
        s[4] += 1.2 * s[5]
        s[5] += 1.5 * u[2]
        for pair in range(3):
            totals[2 * pair] += abs(s[2 * pair + 1])
            totals[2 * pair + 1] += abs(s[2 * pair] - 1)
    scales = (0.3805254, 4.072655, 0.11415762, 0.94199475, 0.5707881, 7.10111927)
    return [3 * total / 25 / scale for total, scale in zip(totals, scales, strict=True)]


CASES: dict[str, tuple[ControlledTask, Callable[[Numbers], list[float]]]] = {
    "driver": (DriverTask(), drive_by_hand),
    "lds": (LDSTask(), move_by_hand),
    "lds, released inputs": (LDSTask(True), lambda controls: move_by_hand(controls, True)),
}
cases = pytest.mark.parametrize(("task", "by_hand"), CASES.values(), ids=CASES)


def drawn(task: ControlledTask, count: int) -> Tensor:
    """Controls in their bounds (count U), in float64."""
    shares = torch.rand(count, len(task.low), generator=Generator().manual_seed(4)).double()
    return task.low + (task.high - task.low) * shares


def features_of(task: ControlledTask, controls: Tensor) -> Tensor:
    return task.features(task.roll_out(controls))


@cases
def test_features_are_those_of_a_loop(
    task: ControlledTask, by_hand: Callable[[Numbers], list[float]]
) -> None:
    controls = drawn(task, 40)
    expected = torch.tensor([by_hand(each) for each in controls.tolist()], dtype=torch.float64)
    assert torch.allclose(features_of(task, controls), expected, rtol=1e-12, atol=1e-12)
    single = features_of(task, controls.float())
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), expected, rtol=1e-5, atol=1e-5)


@cases
def test_gradients_are_those_of_finite_differences(
    task: ControlledTask, by_hand: Callable[[Numbers], list[float]]
) -> None:
    step, controls = 1e-5, drawn(task, 1)[0]
    found = torch.autograd.functional.jacobian(lambda each: features_of(task, each), controls)
    for index in range(len(controls)):
        up, down = controls.tolist(), controls.tolist()
        up[index] += step
        down[index] -= step
        ends = zip(by_hand(up), by_hand(down), strict=True)
        slope = torch.tensor([(high - low) / (2 * step) for high, low in ends]).double()
        assert torch.allclose(found[:, index], slope, rtol=1e-4, atol=1e-5)


@cases
def test_any_leading_dimensions(
    task: ControlledTask, by_hand: Callable[[Numbers], list[float]]
) -> None:
    controls = drawn(task, 12)
    together = features_of(task, controls)
    nested = features_of(task, controls.unflatten(0, (3, 2, 2)))
    assert nested.shape == (3, 2, 2, len(task.feature_names))
    assert torch.allclose(nested.flatten(0, 2), together, rtol=1e-12)
    singles = torch.stack([features_of(task, each) for each in controls])
    assert torch.allclose(singles, together, rtol=1e-12)


@cases
def test_controls_are_uniform_in_their_bounds(
    task: ControlledTask, by_hand: Callable[[Numbers], list[float]]
) -> None:
    """Told from what is rolled out, which is put aside for this."""
    seen: list[Tensor] = []

    class Watched(type(task)):  # type: ignore[misc]
        def roll_out(self, controls: Tensor) -> Tensor:
            seen.append(controls)
            return super().roll_out(controls)

    Watched().trajectories(4000, 1)
    shares = (seen[0] - task.low) / (task.high - task.low)
    assert 0 <= float(shares.min()) < 0.01
    assert 0.99 < float(shares.max()) <= 1
    assert torch.allclose(shares.mean(0), torch.tensor(0.5), atol=0.02)
    assert torch.allclose(shares.var(0), torch.tensor(1 / 12), atol=0.005)


def test_the_authors_code_gives_the_same() -> None:
    """Copied from what the code that was released with CoRL 2019 prints for these controls."""
    drive = torch.tensor([5, -7, 2, 9, -8, 3, -4, 6, 1, 10]).double() / 10
    printed = torch.tensor([5.58315607325, 1.23002771501, 15.7274685384, 0.841081088445]).double()
    assert torch.allclose(features_of(DriverTask(), drive), printed, rtol=1e-6)
    bounds = torch.tensor([0.1, 0.2, 0.1] * 5).double()
    push = bounds * torch.linspace(-1, 1, 15).double() ** 3
    for task, values in (
        (
            LDSTask(True),
            (
                1.11302301422,
                2.55652313655,
                1.11302301422,
                4.36496648225,
                1.11302301422,
                2.30122963735,
            ),
        ),
        (
            LDSTask(),
            (
                3.96030615709,
                4.87393462677,
                4.22003604435,
                6.38106841318,
                1.30692401678,
                1.73827974283,
            ),
        ),
    ):
        assert torch.allclose(features_of(task, push), torch.tensor(values).double(), rtol=1e-6)


def test_inputs_as_released_are_a_switch() -> None:
    with pytest.raises(InputError, match="released_inputs='yes': expected true or false"):
        LDSTask("yes")  # type: ignore[arg-type]


def test_cars_point_where_they_head() -> None:
    """A car anywhere is one at the origin, turned and moved; one that keeps straight on is seen at
    its length, and its trail begins where it started."""
    expected = [complex(*point) for point in car((0, 0, 0, 1), "#000000").points]
    assert max(point.real for point in expected) == pytest.approx(0.1)
    turned = [complex(*point) for point in car((3, -2, 0.7, 1), "#000000").points]
    assert turned == pytest.approx([3 - 2j + point * cmath.exp(0.7j) for point in expected])
    task = DriverTask()
    scene = task.scene(task.roll_out(torch.tensor([0.0, 1.0] * 5)))
    assert len(scene.frames) == 50
    robot, other = scene.frames[-1]
    assert isinstance(robot, Patch)
    assert isinstance(other, Patch)
    across, up = zip(*robot.points, strict=True)
    assert max(across) - min(across) == pytest.approx(0.09, abs=1e-3)
    assert max(up) - min(up) == pytest.approx(0.2, abs=1e-3)
    trails = [shape.points for shape in scene.still if isinstance(shape, Line)][-2:]
    assert trails[0][0] == (0.0, -0.3)
    assert len(trails[0]) == 51


def test_points_are_seen_to_move() -> None:
    """The first is pushed up as far as it goes, to the edge of its strip; the others stay."""
    task = LDSTask()
    scene = task.scene(task.roll_out(torch.tensor([0.1, 0.0, 0.0] * 5)))
    first = [frame[0] for frame in scene.frames]
    assert isinstance(first[-1], Disc)
    assert first[-1].centre == pytest.approx((1.7, 0.5))
    second = [frame[1] for frame in scene.frames]
    assert {disc.centre[1] for disc in second if isinstance(disc, Disc)} == {-1.07}
