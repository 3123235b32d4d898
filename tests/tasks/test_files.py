"""Files and datasets of trajectories, as tasks."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path
from time import process_time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import torch
from PIL import Image
from recordings import DATASET, reach, write_csv, write_minari

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.tasks.files import FilesTask
from torchrl_pref.tasks.minari import MinariTask
from torchrl_pref.tasks.scene import Picture

QUERIES = np.random.default_rng(0).normal(size=(30, 3, 2))


def test_each_trajectory_is_asked_about_as_often_as_another(tmp_path: Path) -> None:
    task = FilesTask(str(write_csv(tmp_path / "x.csv")))
    for n_options in (2, 3):
        pool = make_pool(task, 200, n_options, seed=1)
        assert pool.trajectories is not None
        asked = pool.trajectories.squeeze(-1)
        assert (asked.sort(-1).values.diff(dim=-1) > 0).all()  # never twice in one query
        times = asked.flatten().bincount(minlength=80)
        # Of 80 two are left out of each shuffling into queries of three.
        assert int(times.max() - times.min()) <= (0 if n_options == 2 else 4)
    lines = np.loadtxt(tmp_path / "x.csv", delimiter=",", skiprows=1)
    assert np.allclose(pool.features.numpy(), lines[asked.numpy()], atol=1e-6)
    assert pool.feature_names == ("speed", "lane", "jerk")


def test_few_trajectories_make_all_queries_that_there_are(tmp_path: Path) -> None:
    train, test = FilesTask(str(write_csv(tmp_path / "x.csv", 11))).split(0)
    pools = [make_pool(half, 1000, 2, seed=0) for half in (train, test)]
    assert [len(pool) for pool in pools] == [15, 10]
    halves = []
    for pool in pools:
        assert pool.trajectories is not None
        pairs = {frozenset(pair) for pair in pool.trajectories.squeeze(-1).tolist()}
        halves.append(set().union(*pairs))
        assert pairs == {frozenset(pair) for pair in combinations(halves[-1], 2)}
    assert halves[0] | halves[1] == set(range(11))
    assert not halves[0] & halves[1]


def test_queries_stay_as_they_are(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", features=QUERIES, feature_names=np.array(["speed", "lane"]))
    task = FilesTask(str(tmp_path / "x.npz"))
    halves = task.split(4)
    found = []
    for half in halves:
        pool = make_pool(half, 1000, 3, seed=1)
        assert len(pool) == 15
        found += pool.features.tolist()
    assert sorted(found) == sorted(QUERIES.astype(np.float32).tolist())
    with pytest.raises(InputError, match="set pool"):
        make_pool(task, 10, 2, seed=0)


def test_too_few_for_a_pool(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="are left for one of the two"):
        make_pool(FilesTask(str(write_csv(tmp_path / "x.csv", 3))).split(0)[1], 10, 2, seed=0)


def test_images_are_shown(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    lines = ["speed,lane,clip"]
    for number in range(6):
        Image.new("RGB", (4, 4)).save(tmp_path / "clips" / f"{number}.png")
        lines.append(f"{number},{-number},clips/{number}.png")
    (tmp_path / "x.csv").write_text("\n".join(lines))
    task = FilesTask(str(tmp_path / "x.csv"), images="clip")
    assert task.feature_names == ("speed", "lane")
    for trajectory in task.trajectories(6, 0):
        picture = task.scene(trajectory).frames[0][0]
        number = int(task.features(trajectory)[0])
        assert picture == Picture(str(tmp_path / "clips" / f"{number}.png"))
    bare = FilesTask(str(tmp_path / "x.csv"), columns=["lane", "speed"])
    assert bare.feature_names == ("lane", "speed")
    outside = tmp_path.parent / f"{tmp_path.name}.png"
    Image.new("RGB", (4, 4)).save(outside)
    for named in (
        "clips/7.png",
        "x.csv",
        f"../{tmp_path.name}.png",
        str(outside),
        "a\0b",
        "b" * 999,
    ):
        (tmp_path / "x.csv").write_text("\n".join([*lines, f"9,9,{named}"]))
        with pytest.raises(InputError, match=r"names the image|cannot be read"):
            FilesTask(str(tmp_path / "x.csv"), images="clip")


def test_a_small_file_of_many_rows_takes_little(tmp_path: Path) -> None:
    """Their images are looked for once, and their texts take room as numbers do."""
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    ends = ["a.png", "./a.png"]
    for count in (600_000, 1_600_000):
        zeros = np.zeros(count)
        made = {"speed": zeros, "lane": zeros, "clip": ends * (count // 2)}
        parquet.write_table(pa.table(made), tmp_path / f"{count}.parquet")
    start = process_time()
    task = FilesTask(str(tmp_path / "600000.parquet"), images="clip")
    assert process_time() - start < 5  # 0.2 s; as long again for each row they were 15
    last = task.scene(torch.tensor([599_999]))
    assert last.frames == ((Picture(str(tmp_path / "a.png")),),)
    with pytest.raises(InputError, match="of 1,600,000 values it would take 77 MB"):
        FilesTask(str(tmp_path / "1600000.parquet"), images="clip")


def test_texts_take_room(tmp_path: Path) -> None:
    many = [f"{'x' * 500}{number:06}" for number in range(30_000)]
    few = {"speed": np.arange(30_000.0), "lane": np.zeros(30_000)}
    path = tmp_path / "x.parquet"
    parquet.write_table(pa.table({**few, "clip": many}), path, compression="zstd")
    with pytest.raises(InputError, match="with the texts of column 'clip' it would take"):
        FilesTask(str(path), images="clip")
    np.savez_compressed(tmp_path / "x.npz", **few, clip=np.array(many))
    with pytest.raises(InputError, match="with the texts of column 'clip' it would take"):
        FilesTask(str(tmp_path / "x.npz"), images="clip")


@pytest.mark.parametrize("clip", [[b"a.png"] * 4, [1, 2, 3, 4]])
def test_images_are_named_by_texts(clip: list[object], tmp_path: Path) -> None:
    made = {"speed": np.arange(4.0), "lane": np.arange(4.0), "clip": clip}
    parquet.write_table(pa.table(made), tmp_path / "x.parquet")
    with pytest.raises(InputError, match=r"'clip' holds .*; expected texts"):
        FilesTask(str(tmp_path / "x.parquet"), images="clip")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"path": None}, "type path="),
        ({"columns": "speed"}, "expected a list"),
        ({"columns": ["speed", "speed"]}, "one twice"),
        ({"columns": ["speed", "weight"]}, "no column 'weight'"),
        ({"columns": ["speed"]}, "expected two or more"),
        ({"images": "clip"}, "no column 'clip'"),
        ({"columns": ["speed", "lane"], "images": "lane"}, "no feature"),
    ],
)
def test_wrong_settings(given: dict[str, object], message: str, tmp_path: Path) -> None:
    path = str(write_csv(tmp_path / "x.csv"))
    with pytest.raises(InputError, match=message):
        FilesTask(**{"path": path, **given})  # type: ignore[arg-type]


def test_minari_episodes_as_they_were_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = write_minari(tmp_path)
    expected = [[x[:, 0].max(), a.sum() / len(x), x[-1, 1]] for x, a in episodes]
    for id in (DATASET, str(tmp_path / DATASET)):
        task = MinariTask(id, features=reach)
        features = task.features(torch.arange(80).unsqueeze(-1))
        assert np.allclose(features.numpy(), expected, atol=1e-6)
    ready = MinariTask(DATASET)
    assert ready.feature_names[0] == "lowest position"
    mean_speed = ready.features(torch.arange(80).unsqueeze(-1))[:, 2]
    assert np.allclose(mean_speed.numpy(), [np.abs(x[:, 1]).mean() for x, _ in episodes], atol=1e-6)


def test_a_dataset_never_names_code_to_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its spaces Minari makes the environment, by the code that the file names."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    write_minari(tmp_path)
    path = tmp_path / DATASET / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    spec = json.loads(metadata["env_spec"])
    ran = tmp_path / "ran"
    spec |= {"entry_point": "subprocess:Popen", "kwargs": {"args": ["touch", str(ran)]}}
    metadata["env_spec"] = json.dumps(spec)
    del metadata["observation_space"]
    path.write_text(json.dumps(metadata))
    with pytest.raises(InputError, match="does not say what is observed"):
        MinariTask(DATASET)
    assert not ran.exists()
    path.write_text("{")
    for id in (DATASET, "no/such-v0", "../..", 3):
        with pytest.raises(InputError, match="id="):
            MinariTask(id)  # type: ignore[arg-type]
