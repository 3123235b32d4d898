"""What is seen of a simulator's episodes."""

import math

import pytest
import torch

from torchrl_pref.tasks.scene import Disc, Line, Patch
from torchrl_pref.tasks.viewers import MOST_STRIPS, ROOM, lunar_lander, mountain_car, strips


def test_the_car_stands_on_its_hill() -> None:
    scene = mountain_car(torch.tensor([[-0.5, 0.0], [0.2, 0.01]]))
    (first,), (last,) = scene.frames
    assert isinstance(first, Disc)
    assert isinstance(last, Disc)
    for disc, x in ((first, -0.5), (last, 0.2)):
        height = math.sin(3 * x) * 0.45 + 0.55
        assert disc.centre == pytest.approx((x, height + disc.radius), abs=1e-6)


def test_the_lander_leans_as_it_flies() -> None:
    rows = torch.zeros(2, 8)
    rows[1, :2] = torch.tensor([0.5, 1.0])
    rows[1, 4] = math.pi / 2
    upright, lying = (frame[0] for frame in lunar_lander(rows).frames)
    assert isinstance(upright, Patch)
    assert isinstance(lying, Patch)
    for (x, y), (a, b) in zip(upright.points, lying.points, strict=True):
        assert (a, b) == pytest.approx((0.5 - y, 1.0 + x), abs=1e-6)  # turned to the left


def test_numbers_over_time_are_drawn_at_the_scale_that_is_given() -> None:
    rows = torch.stack([torch.tensor([0.0, 5.0, 10.0])] * 12, -1)
    scene = strips(rows, torch.zeros(12), torch.full((12,), 20.0))
    curves = [shape for shape in scene.still if isinstance(shape, Line)]
    assert len(curves) == MOST_STRIPS
    for row, curve in enumerate(curves):
        base = -1.1 * row
        expected = [base, base + ROOM / 4, base + ROOM / 2]
        assert [y for _, y in curve.points] == pytest.approx(expected)
    assert [x for x, _ in curves[0].points] == [0.0, 1.0, 2.0]
    assert len(scene.frames) == 3
