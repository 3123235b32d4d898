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

SHIPPED = sorted({*FOLDER.glob("*.pt")} - {*FOLDER.glob("*-every-*.pt")})
"""By version 0.1.0."""


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
    assert not checkpoint.of_every_task
    for key, value in raw["settings"].items():
        if key not in ("evaluation", "grid", "tau_spread"):
            now = checkpoint.settings[key]
            assert (now | value if isinstance(value, dict) else value) == now
    progress = Progress.of(checkpoint.training)
    assert progress.update == len(raw["training"]["history"]["train/reward"])
    for name, values in progress.history.items():
        was = raw["training"]["history"].get(name)
        assert same(values, was) if was else all(math.isnan(value) for value in values), name


def test_no_number_of_older_settings_is_lost() -> None:
    settings = {"grid": {"size": 5, "length": 7}, "tau_spread": 4, "belief": {"samples": 30}}
    settings["training"] = {"sessions": 128}
    migrate(settings)
    assert settings["task"] == {"name": "gridworld", "size": 5, "length": 7}
    assert settings["human"] == {"name": "simulated", "spread": 4, "tau": None, "lapse": 0.0}
    assert settings["demonstrations"]["count"] == 0
    one = {"problems": "one", "stages": 1, "processes": 1}
    assert settings["training"] == {"sessions": 128, **one}
    assert settings["belief"] == {"name": "sampled", "samples": 30, "lapse": 0.0}


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
    content["training"]["sessions"] = {"history": {}, "samples": torch.zeros(2)}
    torch.save(content, checkpoint)


def test_a_run_of_format_4_keeps_its_weights_and_cannot_go_on(tmp_path: Path) -> None:
    """Its sessions lack the options that were asked about; a new run may start from it."""
    settings = settings_of(updates=2)
    trainer, task = trainer_of(settings)
    trainer.run(tmp_path, lambda: None, logger=[])
    path = tmp_path / "checkpoint.pt"
    make_checkpoint(settings, task, trainer).save(path)
    young = Checkpoint.load(path)
    aged(path)
    old = Checkpoint.load(path)
    assert same(young.weights, old.weights)
    assert old.settings == {**young.settings, "logger": ["csv", "tensorboard"]}
    assert set(old.training) == set(KNOWN)
    assert all(map(math.isnan, old.training["history"]["train/entropy"]))
    load_weights(trainer.policy, old)
    with pytest.raises(InputError, match=r"an earlier version; start a new run .* checkpoint="):
        train.check_trained(path, old)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    content = torch.load(SHIPPED[0], weights_only=True)
    for version in (3, FORMAT + 1, "4", None):
        torch.save({**content, "format": version}, tmp_path / "other.pt")
        shown = version if type(version) is int else "unknown"
        with pytest.raises(InputError, match=rf"format {shown}, expected 4, 5, 6"):
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
