"""Trajectories of Gymnasium and TorchRL, against the simulators played by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from recordings import grid, lean, pendulum, reach
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.gridworld import MOVES
from torchrl_pref.tasks.gymnasium import GymnasiumTask
from torchrl_pref.tasks.rollouts import READY
from torchrl_pref.tasks.torchrl import TorchRLTask

LANDER = "LunarLanderContinuous-v3"
# Gymnasium's environments of Box2D import both.
needs_box2d = pytest.mark.skipif(
    not (find_spec("Box2D") and find_spec("pygame")), reason="the extra box2d is not installed"
)


def replayed(
    id: str, start: np.ndarray, actions: np.ndarray, kind: Callable[[Any], Any]
) -> list[np.ndarray]:
    """What is observed when actions are taken again from a start; of one that holds its state."""
    env = gymnasium.make(id, max_episode_steps=10_000)
    env.reset(seed=0)
    env.unwrapped.state = np.array(start, dtype=np.float64)  # type: ignore[attr-defined]
    seen = [start]
    for action in actions:
        seen.append(env.step(kind(action))[0])
    return seen


@pytest.mark.parametrize("policy", [None, lean])
def test_mountain_car_as_played_by_hand(policy: object) -> None:
    rows = GymnasiumTask(length=30, policy=policy).trajectories(40, 7)  # type: ignore[arg-type]
    assert rows.shape == (40, 30, 4)
    assert (rows[:, :-1, 2] != 0).all()
    assert (rows[:, -1, 2] == 0).all()
    for one in rows[::13].numpy():
        seen = replayed("MountainCarContinuous-v0", one[0, :2], one[:-1, 2:3], np.asarray)
        assert np.allclose(np.stack(seen), one[:, :2], atol=1e-4)
    assert len(rows[:, 0, 0].unique()) == 40  # no start comes again


def test_an_episode_that_ends_is_told() -> None:
    rows = GymnasiumTask("CartPole-v1", 120, features=reach).trajectories(40, 0)
    steps = rows[..., -1].sum(1)
    assert 20 < steps.max() < 120  # random pushes let it fall
    for one, count in zip(rows, steps.int().tolist(), strict=True):
        last = one[count - 1, :4]
        assert last[0].abs() > 2.4 or last[2].abs() > math.radians(12)
        before = one[: count - 1]
        assert (before[:, 2].abs() <= math.radians(12)).all()
        assert (one[count:, :4] == last).all()
        assert (one[count - 1 :, 4] == 0).all()
        assert set(before[:, 4].tolist()) <= {0.0, 1.0}
        assert (one[count:, 5] == 0).all()
    one = rows[3, : int(steps[3])].numpy()
    seen = replayed("CartPole-v1", one[0, :4], one[:-1, 4], int)
    assert np.allclose(np.stack(seen), one[:, :4], atol=1e-4)


def test_apreles_numbers_of_mountain_car() -> None:
    """Its demo standardises by these means and deviations of random trajectories of 300 steps."""
    task = GymnasiumTask()
    features = task.features(task.trajectories(150, 1))
    spread = torch.tensor([0.075, 0.074, 0.003])
    gaps = (features.mean(0) - torch.tensor([-0.703, -0.344, 0.007])) / spread
    assert gaps.abs().max() < 4 / math.sqrt(150) + 0.2  # they are rounded
    assert (features.std(0) / spread).sub(1).abs().max() < 0.3


@needs_box2d
def test_lunar_lander_in_numpy() -> None:
    task = GymnasiumTask(LANDER, length=150)
    rows = task.trajectories(12, 2)
    assert (rows[:, -1, -1] == 0).any()  # some are over sooner
    for one, features in zip(rows.numpy(), task.features(rows), strict=True):
        steps = int(one[:, -1].sum())
        seen = one[:steps, :8]
        path = turned = 0.0
        for before, after in pairwise(seen):
            path += math.dist(before[:2], after[:2])
            turned += abs(after[4] - before[4])
        expected = [np.abs(seen[:, 4]).mean(), math.hypot(*seen[-1, :2]), turned, path]
        assert np.allclose(features.numpy(), [*expected, seen[-1, 3], steps - 1], rtol=1e-4)


def test_torchrls_grid_as_played_by_hand() -> None:
    rows = TorchRLTask(grid, length=12, features=reach).trajectories(20, 3)
    assert rows.shape == (20, 12, 2 + 1 + 1 + 1)  # a position, a count, an action
    assert (rows[..., -1].sum(1) == 10).all()  # its episodes have 9 actions
    for one in rows.int().tolist():
        for before, after in pairwise(one[:10]):
            moved = [x + dx for x, dx in zip(before[:2], MOVES[before[3]], strict=True)]
            assert after[:2] == [min(max(x, 0), 4) for x in moved]
    assert len(rows[:, 0, :2].unique(dim=0)) > 8


def test_torchrls_pendulum_ends_when_it_is_truncated() -> None:
    task = TorchRLTask(pendulum, length=20, features=reach)
    rows = task.trajectories(35, 3)
    assert rows.shape == (35, 20, 3 + 1 + 1 + 1)
    assert (rows[..., -1].sum(1) == 8).all()
    assert torch.allclose(rows[..., :2].norm(dim=-1), torch.ones(35, 20), atol=1e-4)
    assert len(rows[:, 0, 0].unique()) == 35
    assert rows[:, :7, 4].abs().max() <= 2
    assert torch.equal(rows, task.trajectories(35, 3))


def broken(observations: Tensor, actions: Tensor, alive: Tensor) -> Tensor:
    raise IndexError("no such column")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"id": "NoSuchThing-v0"}, "cannot be made"),
        ({"id": "os:Thing-v0"}, "type make=<module>"),
        ({"id": "CartPole-v1"}, "type features=<module>"),
        ({"id": "Blackjack-v1"}, "expected observations of Box"),
        ({"length": 1}, "length=1"),
        ({"features": broken}, "no such column"),
        ({"features": lambda o, a, alive: o}, "expected a tensor"),
    ],
)
def test_what_cannot_be_played_is_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        GymnasiumTask(**given)  # type: ignore[arg-type]


def test_a_policy_of_another_shape_is_refused() -> None:
    task = GymnasiumTask(length=5, policy=lambda seen, generator: seen)
    with pytest.raises(InputError, match="expected a tensor"):
        task.trajectories(3, 0)
    with pytest.raises(InputError, match="make=null"):
        TorchRLTask()


def test_ready_features_are_named() -> None:
    assert {len(features.names) for features in READY.values()} == {3, 6}  # type: ignore[attr-defined]
