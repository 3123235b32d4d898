"""train.py with trajectories of the user's own, as docs/your_data.md types it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from recordings import write_csv
from test_extending import ROOT, SMALL, run

from torchrl_pref.errors import InputError
from torchrl_pref.groups import make
from torchrl_pref.pool import QueryPool
from torchrl_pref.typed_code import allow

MINE = """
import torch


def ends(observations, actions, alive):
    return torch.stack([observations[..., 0].amax(-1), observations[:, -1, 1]], -1)


ends.names = ("farthest", "at the end")


def lean(observations, generator):
    noise = torch.rand(len(observations), 1, generator=generator)
    return observations[:, 1:2].sign() * 0.5 + noise
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.py").write_text(MINE)
    write_csv(tmp_path / "trips.csv", 20)
    return tmp_path


def test_a_file(folder: Path) -> None:
    typed = ["task=files", "task.path=trips.csv", "hydra.run.dir=run"]
    done = run("train.py", *SMALL, *typed, "pool.size=50", folder=folder)
    assert done.returncode == 0, done.stderr
    assert "note: 45 queries to train on and 45 to test on" in done.stdout
    assert (folder / "run" / "figure_1.png").stat().st_size > 1000
    pool = QueryPool.load(folder / "run" / "train_pool.pt")
    assert pool.feature_names == ("speed", "lane", "jerk")


TASKS = {
    "driver": ["task=driver"],
    "lds": ["task=lds"],
    "gymnasium": ["task=gymnasium", "task.id=MountainCarContinuous-v0", "task.length=20"],
    "files": ["task=files", "task.path=trips.csv"],
}


@pytest.mark.parametrize("question", ["weak", "ranking"])
@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_trained_on_with_every_question(
    task: str, question: str, folder: Path
) -> None:
    typed = [*TASKS[task], f"question={question}", "pool.size=15", "hydra.run.dir=run"]
    done = run("train.py", *SMALL, *typed, folder=folder)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^RL-feed +-?\d\.\d+", done.stdout, re.M)
    assert f"{question} questions" in done.stdout
    for name in ("figure_1.png", "training.png", "checkpoint.pt"):
        assert (folder / "run" / name).stat().st_size > 1000


def test_a_bad_file_is_refused_before_a_folder_is_made(folder: Path) -> None:
    (folder / "bad.csv").write_text("speed,lane\n1,2\n3,nan\n")
    done = run("train.py", "task=files", "task.path=bad.csv", "hydra.run.dir=run", folder=folder)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "'lane' holds NaN" in done.stderr
    assert not (folder / "run").exists()


def test_rollouts_with_code_that_was_typed(folder: Path) -> None:
    """Features and policy of the user's; what a checkpoint names is not imported."""
    code = ["task.features=mine:ends", "task.policy=mine:lean"]
    typed = ["task=gymnasium", "task.length=15", *code]
    done = run("train.py", *SMALL, *typed, "hydra.run.dir=run", folder=folder)
    assert done.returncode == 0, done.stderr
    pool = QueryPool.load(folder / "run" / "test_pool.pt")
    assert pool.feature_names == ("farthest", "at the end")
    assert pool.trajectories is not None
    assert torch.equal(pool.features[..., 1], pool.trajectories[..., -1, 1])

    for name in ("train_pool.pt", "test_pool.pt"):
        (folder / "run" / name).unlink()  # so that the task has to be made again
    longer = ["resume=run", "training.updates=3"]
    untyped = run("train.py", *longer, folder=folder)
    assert untyped.returncode == 2
    assert untyped.stderr.startswith("error: task.features=mine:ends: a file names code of yours")
    other = run("train.py", *longer, "task=gymnasium", "task.features=mine:lean", folder=folder)
    assert "the run was made with task.features=mine:ends" in other.stderr
    again = run("train.py", *longer, "task=gymnasium", *code, folder=folder)
    assert again.returncode == 0, again.stderr


def settings_of(task: str, **typed: object) -> dict[str, Any]:
    return {**OmegaConf.to_container(OmegaConf.load(ROOT / "conf/task" / f"{task}.yaml")), **typed}


@pytest.mark.parametrize(
    ("task", "typed", "message"),
    [
        ("gymnasium", {"id": "CartPole-v1"}, "task.features=<module>:<its name>"),
        ("gymnasium", {"id": "mine:Thing-v0"}, "task.id='mine:Thing-v0': expected"),
        ("gymnasium", {"length": "many"}, "task.length='many': expected a whole number"),
        ("gymnasium", {"length": 1}, "set task.length=2 or more"),
        ("gymnasium", {"features": "mine:nothing"}, "has no nothing"),
        ("gymnasium", {"features": [1]}, "expected <module>:<name>"),
        ("gymnasium", {"policy": "mine:untyped"}, "run only if you type it"),
        ("gymnasium", {"make": "mine:untyped"}, "run only if you type it"),
        ("torchrl", {}, "type task.make="),
        ("torchrl", {"make": "mine:lean"}, "task.make=lean: fails"),
        ("minari", {}, "type task.id="),
        ("minari", {"features": "mine:untyped"}, "run only if you type it"),
        ("files", {}, "type task.path="),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    task: str,
    typed: dict[str, object],
    message: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    for reference in ("mine:nothing", "mine:lean"):
        allow(reference)
    with pytest.raises(InputError) as refused:
        make("task", settings_of(task, **typed))
    assert message in str(refused.value)
    sys.modules.pop("mine", None)


def test_what_only_some_tasks_need_is_not_imported() -> None:
    heavy = {"gymnasium", "minari", "pyarrow", "safetensors"}
    code = f"import sys, torchrl_pref.build; assert not {heavy} & set(sys.modules), sys.modules"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
