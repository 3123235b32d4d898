import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Generator
from torchrl.envs.utils import check_env_specs

from torchrl_pref.errors import InputError
from torchrl_pref.pool import Normalizer, QueryPool, check_alike, save_atomically
from torchrl_pref.tasks.gridworld import (
    MOVES,
    Gridworld,
    corner_distances,
    gridworld_pool,
    random_walks,
)


def test_gridworld_moves_and_walls() -> None:
    env = Gridworld(size=5, length=15, batch_size=(40,), seed=1)
    check_env_specs(env)
    data = env.rollout(130, break_when_any_done=False)
    for before, action, after in zip(
        data["position"].flatten(0, 1).tolist(),
        data["action"].flatten().tolist(),
        data["next", "position"].flatten(0, 1).tolist(),
        strict=True,
    ):
        moved = [x + dx for x, dx in zip(before, MOVES[action], strict=True)]
        assert after == [min(max(x, 0), 4) for x in moved]
    assert (data["next", "truncated"].squeeze(-1).nonzero()[:8, 1] % 15 == 14).all()
    assert (data["next", "reward"] == 0).all()


def test_random_walks_are_uniform_and_seeded() -> None:
    walks = random_walks(4000, size=4, length=6, seed=5)
    assert walks.shape == (4000, 6, 2)
    starts = (walks[:, 0, 0] * 4 + walks[:, 0, 1]).bincount(minlength=16) / 4000
    assert (starts - 1 / 16).abs().max() < 5 * math.sqrt(1 / 16 / 4000)
    steps = walks[:, 1:] - walks[:, :-1]
    inside = ((walks[:, :-1] > 0) & (walks[:, :-1] < 3)).all(-1)
    for move in MOVES:
        share = (steps[inside] == torch.tensor(move)).all(-1).float().mean()
        assert abs(float(share) - 0.25) < 5 * math.sqrt(0.25 * 0.75 / int(inside.sum()))
    assert torch.equal(walks, random_walks(4000, size=4, length=6, seed=5))
    assert not torch.equal(walks, random_walks(4000, size=4, length=6, seed=6))


def test_corner_distances_by_hand() -> None:
    positions = torch.tensor([[[0, 0], [0, 3]], [[1, 2], [1, 2]]])
    expected = [[1.5, 1.5, (3 + math.sqrt(18)) / 2, (math.sqrt(18) + 3) / 2]]
    expected.append([math.hypot(1, 2), math.hypot(1, 1), math.hypot(2, 2), math.hypot(2, 1)])
    assert np.allclose(corner_distances(positions, 4).numpy(), expected)


def test_normalizer_uses_the_training_statistics_only(generator: Generator) -> None:
    train, test = torch.randn(2, 50, 2, 3, generator=generator) * 7 + 2
    normalize = Normalizer.fit(train)
    flat = normalize(train).flatten(0, 1)
    assert torch.allclose(flat.mean(0), torch.zeros(3), atol=1e-5)
    assert torch.allclose(flat.std(0, correction=0), torch.ones(3), atol=1e-5)
    flat_train = train.flatten(0, 1).numpy()
    expected = (test.numpy() - flat_train.mean(0)) / flat_train.std(0)
    assert np.allclose(normalize(test).numpy(), expected, atol=1e-4)


def test_constant_feature_is_refused() -> None:
    features = torch.rand(10, 2, 3)
    features[..., 1] = 4.2
    with pytest.raises(InputError, match="feature 2 never varies"):
        Normalizer.fit(features)
    with pytest.raises(InputError, match="D=2: expected D=3"):
        Normalizer.fit(torch.rand(10, 2, 3))(torch.rand(10, 2, 2))


def test_features_of_any_unit_are_normalised() -> None:
    features = torch.randn(30, 2, 3, dtype=torch.float64) * torch.tensor([5e-7, 1.0, 1e20])
    flat = Normalizer.fit(features)(features).flatten(0, 1)
    assert torch.allclose(flat.std(0, correction=0), torch.ones(3, dtype=torch.float64))
    with pytest.raises(InputError, match="feature 2 varies by less than a millionth of its mean"):
        Normalizer.fit(torch.rand(30, 2, 2) + torch.tensor([0.0, 1e7]))
    for bad in (torch.rand(0, 2, 3), torch.tensor(1.0), 1e300 * features):
        with pytest.raises(InputError, match="features"):
            Normalizer.fit(bad)
    with pytest.raises(InputError, match="ndarray"):
        Normalizer.fit(features)(features.numpy())


def test_pools_belong_together_by_number_and_names() -> None:
    train, names = QueryPool(torch.rand(9, 2, 3), None, ("a", "b", "c")), ("b", "a", "c")
    check_alike(train, train)
    check_alike(train, QueryPool(torch.rand(9, 2, 3)))
    with pytest.raises(InputError, match="the features b, a, c, and the training pool a, b, c"):
        check_alike(train, QueryPool(torch.rand(9, 2, 3), None, names))
    with pytest.raises(InputError, match="D=4: expected D=3"):
        check_alike(train, QueryPool(torch.rand(9, 2, 4)))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_features_that_are_not_finite_are_refused(bad: float) -> None:
    features = torch.rand(10, 2, 3)
    features[4, 1, 2] = bad
    with pytest.raises(InputError, match=r"1 of 10 queries hold NaN or infinity .*query 4"):
        QueryPool(features)


@pytest.mark.parametrize("shape", [(10, 3), (10, 0, 3), (0, 2, 3), (10, 2, 1), (2, 2, 2, 2)])
def test_shapes_that_do_not_fit_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"features of shape .*expected \(N queries"):
        QueryPool(torch.rand(shape))


def test_another_default_type_is_refused_before_anything_is_asked() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(InputError, match=r"torch\.float64: expected torch\.float32"):
            QueryPool(torch.rand(5, 2, 3))
    finally:
        torch.set_default_dtype(torch.float32)


def test_trajectories_must_belong_to_the_features() -> None:
    with pytest.raises(InputError, match="trajectories of shape"):
        QueryPool(torch.rand(10, 2, 3), torch.rand(9, 2, 5))


@pytest.mark.parametrize(
    "options", [{"n_queries": 0}, {"n_options": 0}, {"size": 1}, {"length": 0}]
)
def test_numbers_below_their_minimum_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(InputError, match="expected a whole number of at least"):
        gridworld_pool(**options)


def test_pool_survives_a_file_and_knows_itself(tmp_path: Path) -> None:
    pool = gridworld_pool(20, 3)
    assert pool.features.shape == (20, 3, 4)
    assert pool.trajectories is not None
    pool.save(tmp_path / "pool.pt")
    loaded = QueryPool.load(tmp_path / "pool.pt")
    assert loaded.digest == pool.digest
    assert torch.equal(loaded.trajectories, pool.trajectories)
    assert gridworld_pool(20, 3, seed=1).digest != pool.digest
    assert pool.map_features(lambda features: features.flip(0)).digest != pool.digest
    assert sorted(os.listdir(tmp_path)) == ["pool.pt"]


def test_the_gridworld_pool_is_what_it_has_always_been() -> None:
    """Made by version 0.1.0: what was measured on a pool of a seed holds for that very pool."""
    digests = [
        gridworld_pool(5).digest,
        gridworld_pool(5, 3, size=5, length=7, seed=3).digest,
    ]
    assert digests == [
        "b3f436907695d7f2482c54548faa42d02f2ddd000a59a53571ca4114ff636c54",
        "292e1548256e4688984eb07bbf0e6c4316cb96e38083397ecebcf12a8cc6a50c",
    ]


def test_a_reader_never_sees_half_a_file(tmp_path: Path) -> None:
    """Who has opened the old file goes on reading the old one, whole, while a new one is put in its
    place."""
    path = tmp_path / "pool.pt"
    gridworld_pool(20).save(path)
    old = path.read_bytes()
    with path.open("rb") as reader:
        start = reader.read(100)
        gridworld_pool(30, seed=1).save(path)
        assert start + reader.read() == old
    assert QueryPool.load(path).digest == gridworld_pool(30, seed=1).digest


class _DiskIsFull:
    def __reduce__(self) -> tuple[object, ...]:
        raise OSError("No space left on device")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "pool.pt"
    gridworld_pool(20).save(path)
    old = path.read_bytes()
    with pytest.raises(InputError, match="cannot be written"):
        save_atomically({"features": torch.rand(9), "then": _DiskIsFull()}, path)
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == ["pool.pt"]


def test_bad_pool_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        QueryPool.load(tmp_path / "none.pt")
    gridworld_pool(20).save(tmp_path / "pool.pt")
    content = (tmp_path / "pool.pt").read_bytes()
    for name, broken in (("cut", content[: len(content) // 2]), ("text", b"hello"), ("empty", b"")):
        (tmp_path / name).write_bytes(broken)
        with pytest.raises(InputError, match="cannot be read as a query pool"):
            QueryPool.load(tmp_path / name)
    torch.save({"features": torch.rand(3, 2, 2)}, tmp_path / "foreign.pt")
    with pytest.raises(InputError, match="holds something else; expected a query pool"):
        QueryPool.load(tmp_path / "foreign.pt")


class _Malice:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


def test_no_pickle_is_executed(tmp_path: Path) -> None:
    torch.save({"kind": "query pool", "features": _Malice(tmp_path / "owned")}, tmp_path / "evil")
    with pytest.raises(InputError, match="cannot be read"):
        QueryPool.load(tmp_path / "evil")
    assert not (tmp_path / "owned").exists()
