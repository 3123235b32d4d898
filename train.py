"""Train a policy to ask, then compare it with random and greedy on queries it never saw.

`python train.py --help` lists the keys.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

import app
from torchrl_pref import comparison, experiment, reports
from torchrl_pref.checkpoint import FILE_NAME, Checkpoint
from torchrl_pref.errors import one_line_errors
from torchrl_pref.training import Trainer

POOLS = ("train_pool.pt", "test_pool.pt")


@hydra.main(config_path="conf", config_name="train", version_base="1.3")
def job(config: DictConfig) -> float:
    """One run; returns the policy's final alignment on the test pool, for sweepers."""
    made = app.output_folder()
    try:
        with one_line_errors():
            settings = app.plain_settings(config)
            resume, start = settings.pop("resume"), settings.pop("checkpoint")
            if resume is not None:
                app.refuse_other_overrides(
                    "resume", ("training.updates", "device", "threads", "hydra.")
                )
                return go_on(Path(resume), settings)
            alignment = begin(made, settings, start)
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                print(reports.sweep_table(made.parent))
            return alignment
    finally:
        app.discard_if_empty(made)


def begin(folder: Path, settings: dict[str, Any], start: str | None) -> float:
    """A new run in a folder."""
    pools = experiment.make_pools(settings)
    task = experiment.make_task(*pools, settings["tau"])
    trainer = experiment.make_trainer(settings, task)
    comparison.check_evaluation(settings)
    if start is not None:
        experiment.load_weights(trainer.policy, Checkpoint.load(start))
    for pool, name in zip(pools, POOLS, strict=True):
        pool.save(folder / name)
    return train(folder, settings, task, trainer)


def go_on(folder: Path, typed: dict[str, Any]) -> float:
    """An old run, from its last checkpoint."""
    checkpoint = Checkpoint.load(folder)
    settings = checkpoint.settings
    settings["device"] = typed["device"]
    if any(key.startswith("training.updates=") for key in app.typed_overrides()):
        settings["training"]["updates"] = typed["training"]["updates"]
    task = experiment.reload_task(checkpoint, *(folder / name for name in POOLS))
    trainer = experiment.make_trainer(settings, task)
    experiment.load_weights(trainer.policy, checkpoint)
    trainer.load_state_dict(checkpoint.training)
    return train(folder, settings, task, trainer)


def train(folder: Path, settings: dict[str, Any], task: experiment.Task, trainer: Trainer) -> float:
    """Train, evaluate on the held-out pool, report."""
    setup = settings["setup"]["name"]
    print(f"{setup} setup, {task.title}, run folder {folder}")

    def save() -> None:
        experiment.make_checkpoint(settings, task, trainer).save(folder / FILE_NAME)

    if not trainer.run(folder, save):
        print(f"stopped; go on with: python train.py resume={shlex.quote(str(folder))}")
        sys.exit(130)
    label = comparison.label_of(settings)
    learned = {label: experiment.make_checkpoint(settings, task, trainer)}
    panels = comparison.evaluate_panels(settings, task, learned)
    reports.write_report(folder, panels, {label: trainer.progress.history})
    held_out = next(iter(panels.values()))[label]
    reports.write_summary(folder, app.typed_overrides(), held_out)
    return float(held_out.alignment[:, -1].mean())


if __name__ == "__main__":
    app.main(job)
