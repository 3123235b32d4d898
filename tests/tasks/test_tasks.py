"""What every task keeps to: the package's, and one written outside of it."""

from collections.abc import Callable
from itertools import chain
from pathlib import Path

import my_task
import pytest
import torch
from recordings import DATASET, grid, reach, write_csv, write_minari

from torchrl_pref.errors import InputError
from torchrl_pref.pool import Normalizer
from torchrl_pref.tasks import TASKS
from torchrl_pref.tasks.base import Task, make_pool
from torchrl_pref.tasks.gridworld import GridworldTask, gridworld_pool
from torchrl_pref.tasks.scene import Disc, Label, Line, Patch, Scene, Shape, corners

GIVEN: dict[str, dict[str, object]] = {
    "gymnasium": {"length": 20},
    "torchrl": {"make": grid, "features": reach, "length": 10},
    "files": {"path": "table.csv"},
    "minari": {"id": DATASET},
}
"""What tasks need to be told."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    write_csv(folder / "table.csv")
    write_minari(folder / "minari")
    return folder


@pytest.fixture(params=[*TASKS, "own"])
def make(
    request: pytest.FixtureRequest, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[], Task]:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    if request.param == "own":
        return my_task.Table
    return lambda: TASKS[request.param](**GIVEN.get(request.param, {}))


def test_a_seed_fixes_the_trajectories(make: Callable[[], Task]) -> None:
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first, again = make().trajectories(20, 5), make().trajectories(20, 5)
    assert torch.equal(first, again)
    assert not torch.equal(first, make().trajectories(20, 6))
    assert torch.equal(torch.get_rng_state(), state)  # nobody else's luck is used


def test_features_have_names_and_vary(make: Callable[[], Task]) -> None:
    task = make()
    trajectories = task.trajectories(60, 0)
    features = task.features(trajectories)
    assert features.shape == (60, len(task.feature_names))
    assert len(set(task.feature_names)) == len(task.feature_names)
    Normalizer.fit(features)  # finite, and each varies
    singles = torch.stack([task.features(one) for one in trajectories])
    assert torch.allclose(features, singles, atol=1e-6)
    assert torch.allclose(features[:7], task.features(trajectories[:7]), atol=1e-6)
    pairs = task.features(trajectories.unflatten(0, (30, 2)))
    assert torch.equal(pairs.flatten(0, 1), features)


def test_pools(make: Callable[[], Task]) -> None:
    pool = make_pool(make(), 7, 3, seed=1)
    assert pool.features.shape[:2] == (7, 3)
    assert pool.feature_names == make().feature_names
    assert pool.trajectories is not None
    assert torch.allclose(make().features(pool.trajectories).float(), pool.features)
    for bad in ((0, 2), (5, 0)):
        with pytest.raises(InputError):
            make_pool(make(), *bad, seed=0)


def test_a_scene_stays_within_its_corners(make: Callable[[], Task]) -> None:
    task = make()
    for trajectory in task.trajectories(20, 3):
        scene = task.scene(trajectory)
        assert scene.frames
        (left, low), (right, high) = scene.low, scene.high
        assert left < right
        assert low < high
        for x, y in chain(*(points_of(shape) for frame in scene.frames for shape in frame)):
            assert left - 1e-6 <= x <= right + 1e-6
            assert low - 1e-6 <= y <= high + 1e-6


def points_of(shape: Shape) -> list[tuple[float, float]]:
    """The outermost points of a shape."""
    match shape:
        case Line() | Patch():
            return list(shape.points)
        case Disc():
            (x, y), radius = shape.centre, shape.radius
            return [(x - radius, y - radius), (x + radius, y + radius)]
        case Label():
            return [shape.at]
    return []


def test_scenes_are_shown_at_one_scale() -> None:
    near, far = Scene((0, -1), (1, 2), (), ((),)), Scene((-3, 0), (0.5, 5), (), ((),))
    assert corners([near, far]) == ((-3, -1), (1, 5))


def test_training_and_test_pools_share_no_trajectory(make: Callable[[], Task]) -> None:
    train, test = make().split(3)
    pools = make_pool(train, 60, 2, seed=12), make_pool(test, 60, 2, seed=14)
    seen, unseen = (
        {tuple(row) for row in pool.trajectories.flatten(0, 1).flatten(1).tolist()}  # type: ignore[union-attr]
        for pool in pools
    )
    assert not seen & unseen


def test_the_gridworlds_pool_is_the_tasks() -> None:
    assert gridworld_pool(9, 2, 5, 7, 3).digest == make_pool(GridworldTask(5, 7), 9, 2, 3).digest


def test_a_walk_is_seen_where_it_was() -> None:
    """Two steps in the first row, from its second cell to the right; the third cell twice."""
    scene = GridworldTask(4, 3).scene(torch.tensor([[0, 1], [0, 2], [0, 2]]))
    discs = [frame[0] for frame in scene.frames]
    assert [disc.centre for disc in discs if isinstance(disc, Disc)] == [(1, 0), (2, 0), (2, 0)]
    cells = [shape for shape in scene.still if isinstance(shape, Patch)]
    shades = {middle_of(cell): int(cell.colour[1:], 16) for cell in cells}
    assert set(shades) == {(column, -row) for row in range(4) for column in range(4)}
    assert shades[2, 0] < shades[1, 0] < shades[0, 0]  # there twice, once and never
    assert len(set(shades.values())) == 3


def middle_of(cell: Patch) -> tuple[int, int]:
    across, up = zip(*cell.points, strict=True)
    return round(sum(across) / 4), round(sum(up) / 4)
