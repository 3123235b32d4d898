"""Files of earlier versions are read as what they were."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import same, settings_of, trainer_of

import train
from torchrl_pref.build import load_weights
from torchrl_pref.checkpoints.checkpoint import FORMAT, READABLE, Checkpoint
from torchrl_pref.checkpoints.contents import CURVES, KNOWN
from torchrl_pref.checkpoints.migrations import ADDED_CURVES, migrate, migrate_training
from torchrl_pref.config.settings import check_run
from torchrl_pref.errors import InputError
from torchrl_pref.pretrained import FOLDER
from torchrl_pref.training.progress import Progress
from torchrl_pref.training.start import make_checkpoint

SHIPPED = sorted(FOLDER.glob("*.pt"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_policies_are_brought_up_to_date(path: Path) -> None:
    raw = torch.load(path, weights_only=True)
    assert raw["format"] == 4
    assert not {"algorithm", "logger"} & set(raw["settings"])
    checkpoint = Checkpoint.load(path)
    check_run(checkpoint.settings)
    assert checkpoint.settings["algorithm"] == {"name": "a2c"}
    assert checkpoint.settings["logger"] == ["csv", "tensorboard"]
    assert checkpoint.settings["evaluation"]["during"] == 0
    assert same(checkpoint.weights, raw["weights"])
    assert checkpoint.settings["task"] == {"name": "gridworld", **raw["settings"]["grid"]}
    assert checkpoint.settings["human"]["spread"] == raw["settings"]["tau_spread"]
    assert checkpoint.settings["question"] == {"name": "choice"}
    for key, value in raw["settings"].items():
        if key not in ("evaluation", "grid", "tau_spread"):
            now = checkpoint.settings[key]
            assert (now | value if isinstance(value, dict) else value) == now
    progress = Progress.of(checkpoint.training)
    assert progress.update == len(raw["training"]["history"]["train/reward"])
    for name, values in progress.history.items():
        was = raw["training"]["history"].get(name)
        assert same(values, was) if was else all(math.isnan(value) for value in values), name


def aged(checkpoint: Path) -> None:
    """Make a checkpoint what format 4 wrote."""
    content = torch.load(checkpoint, weights_only=True)
    content["format"] = 4
    settings = content["settings"]
    for key in ("algorithm", "logger", "question"):
        del settings[key]
    settings["grid"] = {key: settings["task"][key] for key in ("size", "length")}
    settings["tau_spread"] = settings["human"]["spread"]
    settings["belief"] = {key: settings["belief"][key] for key in ("samples", "moves")}
    for key in ("task", "human"):
        del settings[key]
    for name in ADDED_CURVES:
        del content["training"]["history"][name]
    torch.save(content, checkpoint)


def test_a_run_of_format_4_goes_on_bit_for_bit(tmp_path: Path) -> None:
    ends = []
    for old in (False, True):
        settings = settings_of(updates=2)
        trainer, task = trainer_of(settings)
        trainer.run(tmp_path, lambda: None, logger=[])
        make_checkpoint(settings, task, trainer).save(tmp_path / "checkpoint.pt")
        if old:
            aged(tmp_path / "checkpoint.pt")
        checkpoint = Checkpoint.load(tmp_path)
        checkpoint.settings["training"]["updates"] = 5
        trainer, _ = trainer_of(checkpoint.settings)
        load_weights(trainer.policy, checkpoint)
        trainer.load_state_dict(checkpoint.training)
        trainer.run(tmp_path, lambda: None)
        ends.append(trainer.state_dict())
        rows = (tmp_path / "training.csv").read_text().splitlines()
        assert len({row.count(",") for row in rows}) == 1
        assert len(rows) == 6
    young, old_one = ends
    for name in ("weights", "optimizer", "sessions", "env_generator", "global_generator"):
        assert same(young[name], old_one[name]), name
    lost = old_one["history"]["train/entropy"]
    assert [math.isnan(value) for value in lost] == [True, True, False, False, False]


def test_other_formats_are_refused(tmp_path: Path) -> None:
    content = torch.load(SHIPPED[0], weights_only=True)
    for version in (3, FORMAT + 1, "4", None):
        torch.save({**content, "format": version}, tmp_path / "other.pt")
        shown = version if type(version) is int else "unknown"
        with pytest.raises(InputError, match=rf"format {shown}, expected 4 or 5"):
            Checkpoint.load(tmp_path / "other.pt")


def test_what_is_of_today_is_held_to_it(tmp_path: Path) -> None:
    """Only an older file may lack what came later."""
    content = torch.load(SHIPPED[0], weights_only=True)
    torch.save({**content, "format": FORMAT}, tmp_path / "young.pt")
    with pytest.raises(InputError, match=r"settings\.algorithm\.name is missing"):
        Checkpoint.load(tmp_path / "young.pt")


def test_a_configuration_of_version_0_1_0_is_read(tmp_path: Path) -> None:
    settings = settings_of()
    for section, key in (("", "algorithm"), ("", "logger"), ("evaluation", "during")):
        del (settings[section] if section else settings)[key]
    train.OmegaConf.save(train.OmegaConf.create(settings), tmp_path / "config.yaml")
    found = train.load_config(tmp_path)
    assert found["algorithm"] == {"name": "a2c"}
    assert found["evaluation"]["during"] == 0


ODD: list[Any] = [None, 5, "text", [], {}, {"evaluation": 5}, {"history": 5}]
ODD += [{"history": {}}, {"history": {"train/reward": 5}}]


@pytest.mark.parametrize("odd", ODD, ids=str)
def test_what_makes_no_sense_is_left_to_the_checks(odd: Any) -> None:
    for function in (migrate, migrate_training):
        function(copy.deepcopy(odd))


def test_twice_is_once() -> None:
    settings, training = settings_of(), {"history": {"train/reward": [0.5, 0.25]}}
    once = copy.deepcopy(settings)
    migrate(once)
    assert once == settings
    migrate_training(training)
    assert set(training) == set(KNOWN)
    again = copy.deepcopy(training)
    migrate_training(again)
    assert same(again, training)


def test_names_are_those_of_the_contents() -> None:
    assert set(ADDED_CURVES) < set(CURVES)
    assert READABLE[-1] == FORMAT
