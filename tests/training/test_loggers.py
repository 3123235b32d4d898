"""Where the numbers of a training go; wandb and mlflow are played, and run where they are there."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torchrl.record.loggers.wandb as torchrl_wandb
from helpers import settings_of, trainer_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchrl_pref.errors import InputError
from torchrl_pref.training.learning_curve import LearningCurve
from torchrl_pref.training.trainer import Trainer


def trained(folder: Path, names: list[str], during: int = 1, **training: Any) -> Trainer:
    """A training of three updates, logged by these."""
    settings = settings_of(updates=3, **training)
    settings["evaluation"]["during"] = during
    trainer, task = trainer_of(settings)
    trainer.run(folder, lambda: None, LearningCurve(settings, task, trainer).measure, names)
    return trainer


class FakeRun:
    """What ``wandb.init`` gives."""

    def __init__(self) -> None:
        self.logged: list[dict[str, float]] = []
        self.finished = 0

    def define_metric(self, *_: Any, **__: Any) -> None:
        pass

    def log(self, payload: dict[str, float], **_: Any) -> None:
        self.logged.append(payload)

    def finish(self) -> None:
        self.finished += 1


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A module in the place of wandb, which notes what is done with it."""
    fake = SimpleNamespace(run=FakeRun(), asked={})

    def init(**options: Any) -> FakeRun:
        fake.asked = options
        return fake.run

    fake.init = init
    monkeypatch.setitem(sys.modules, "wandb", fake)  # type: ignore[arg-type]
    monkeypatch.setattr(torchrl_wandb, "_has_wandb", True)
    monkeypatch.setenv("WANDB_MODE", "offline")
    return fake


@pytest.fixture
def mlflow(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A module in the place of mlflow, which notes what is done with it."""
    fake = SimpleNamespace(uri=None, logged={}, tags={}, ended=0, experiment={})

    def create(**options: Any) -> str:
        fake.experiment = options
        return "1"

    def end() -> None:
        fake.ended += 1

    fake.set_tracking_uri = lambda uri: setattr(fake, "uri", uri)
    fake.get_experiment_by_name = lambda name: None
    fake.create_experiment = create
    fake.start_run = lambda experiment_id: SimpleNamespace()
    fake.set_experiment = lambda experiment_id: None
    fake.set_tag = fake.tags.__setitem__
    fake.log_metrics = lambda metrics, step: fake.logged.update({step: metrics})
    fake.end_run = end
    monkeypatch.setitem(sys.modules, "mlflow", fake)  # type: ignore[arg-type]
    monkeypatch.setattr("torchrl.record.loggers.mlflow._has_mlflow", True)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return fake


@pytest.mark.parametrize("names", [[], ["csv"], ["tensorboard"]])
def test_what_is_not_named_writes_nothing(names: list[str], tmp_path: Path) -> None:
    trained(tmp_path, names)
    files = {"csv": "training.csv", "tensorboard": "tensorboard"}
    assert os.listdir(tmp_path) == [files[name] for name in names]


def test_tensorboard_has_the_numbers_of_the_progress(tmp_path: Path) -> None:
    progress = trained(tmp_path, ["tensorboard"], steps=12).progress
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    expected = {
        name: {n: value for n, value in enumerate(values, 1) if value == value}
        for name, values in progress.history.items()
    }
    expected["held_out/alignment"] = {n: float(a.mean()) for n, a in progress.held_out.items()}
    assert sorted(progress.held_out) == [0, 3]
    assert all(expected.values())
    for name, values in expected.items():
        found = {event.step: event.value for event in events.Scalars(name)}
        assert found == pytest.approx(values, rel=1e-5), name


def test_wandb_is_one_run_that_ends(wandb: SimpleNamespace, tmp_path: Path) -> None:
    progress = trained(tmp_path, ["wandb"]).progress
    assert wandb.asked["name"] == tmp_path.name
    assert (wandb.asked["project"], wandb.asked["dir"]) == ("torchrl_pref", str(tmp_path))
    assert os.environ["WANDB_MODE"] == "offline"
    assert wandb.run.finished == 1
    start, *updates = wandb.run.logged
    assert start["held_out/alignment"] == float(progress.held_out[0].mean())
    for number, logged in enumerate(updates, 1):
        assert logged["train/step"] == number
        assert logged["train/entropy"] == progress.history["train/entropy"][number - 1]
    assert updates[-1]["held_out/alignment"] == float(progress.held_out[3].mean())


def test_mlflow_keeps_its_database_in_the_folder(mlflow: SimpleNamespace, tmp_path: Path) -> None:
    progress = trained(tmp_path, ["mlflow"]).progress
    assert mlflow.uri == f"sqlite:///{tmp_path}/mlflow.db"
    assert mlflow.experiment["name"] == "torchrl_pref"
    assert mlflow.experiment["artifact_location"] == (tmp_path / "mlflow").as_uri()
    assert mlflow.tags == {"mlflow.runName": tmp_path.name}
    assert mlflow.ended == 1
    assert sorted(mlflow.logged) == [0, 1, 2, 3]
    losses = [mlflow.logged[update]["train/actor_loss"] for update in (1, 2, 3)]
    assert losses == progress.history["train/actor_loss"]


def test_mlflow_goes_to_a_server_that_is_named(
    mlflow: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://somewhere:5000")
    trained(tmp_path, ["mlflow"])
    assert mlflow.uri == "http://somewhere:5000"
    assert mlflow.experiment["artifact_location"] is None


def test_a_logger_that_does_not_start_is_refused_before_the_training(
    wandb: SimpleNamespace, mlflow: SimpleNamespace, tmp_path: Path
) -> None:
    def fail(**_: Any) -> None:
        raise RuntimeError("no API key")

    wandb.init = fail
    trainer, _ = trainer_of(settings_of())
    with pytest.raises(InputError, match=r"logger=wandb does not start \(RuntimeError: no API key"):
        trainer.run(tmp_path, lambda: None, logger=["csv", "mlflow", "wandb"])
    assert trainer.progress.update == 0
    assert mlflow.ended == 1  # what had started is ended
    assert not (tmp_path / "training.csv").exists()


def test_loggers_end_where_a_training_fails(wandb: SimpleNamespace, tmp_path: Path) -> None:
    trainer, _ = trainer_of(settings_of())

    def fail() -> None:
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        trainer.run(tmp_path, fail, logger=["wandb"])
    assert wandb.run.finished == 1


def test_what_is_known_of_the_start_is_told_once(wandb: SimpleNamespace, tmp_path: Path) -> None:
    settings = settings_of(updates=1)
    settings["evaluation"]["during"] = 1
    trainer, task = trainer_of(settings)
    measure = LearningCurve(settings, task, trainer).measure
    for _ in range(2):  # the second has nothing left to do
        trainer.run(tmp_path, lambda: None, measure, ["wandb"])
    assert sum("held_out/alignment" in logged for logged in wandb.run.logged) == 2
