"""Train a policy to ask, then compare it with random and greedy on queries it never saw.

`python train.py --help` lists the keys.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

import app
from torchrl_pref import comparison, experiment, reports, training_report
from torchrl_pref.checkpoint import FILE_NAME, Checkpoint
from torchrl_pref.errors import InputError, one_line_errors
from torchrl_pref.learning_curve import LearningCurve
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
                allowed = ("training.updates", "device", "threads", "hydra.")
                app.refuse_other_overrides("resume", allowed)
                return go_on(Path(str(resume)), settings)
            return begin(made, settings, None if start is None else str(start))
    finally:
        app.discard_if_empty(made)


def begin(folder: Path, settings: dict[str, Any], start: str | None) -> float:
    """A new run in a folder."""
    app.use_threads(settings)
    settings["overrides"] = app.typed_overrides()
    for name in (FILE_NAME, *POOLS):
        if (folder / name).exists():
            raise InputError(
                f"{folder} holds a run already ({name}); go on with it by resume={folder}, or name "
                "another folder by hydra.run.dir="
            )
    pools = experiment.make_pools(settings)
    task = experiment.make_task(*pools, settings["tau"])
    trainer = experiment.make_trainer(settings, task)
    comparison.check_evaluation(settings)
    if start is not None:
        checkpoint = Checkpoint.load(start)
        checkpoint.check_fits(task.train, own_indices=True)
        experiment.load_weights(trainer.policy, checkpoint)
        trainer.start_average()
    for pool, name in zip(pools, POOLS, strict=True):
        pool.save(folder / name)
    OmegaConf.save(settings, folder / "config.yaml")
    return train(folder, settings, task, trainer)


def go_on(folder: Path, typed: dict[str, Any]) -> float:
    """An old run, from its last checkpoint, with its own settings."""
    checkpoint = Checkpoint.load(folder)
    if "optimizer" not in checkpoint.training:
        raise InputError(
            f"resume={folder}: holds a policy without the state of its training; start a new run "
            f"from it by checkpoint={folder}"
        )
    settings = checkpoint.settings
    for key in ("device", "threads"):
        if app.was_typed(key):
            settings[key] = typed[key]
    if app.was_typed("training.updates"):
        settings["training"]["updates"] = typed["training"]["updates"]
    app.use_threads(settings)
    task = experiment.reload_task(checkpoint, *(folder / name for name in POOLS))
    trainer = experiment.make_trainer(settings, task)
    experiment.load_weights(trainer.policy, checkpoint)
    trainer.load_state_dict(checkpoint.training)
    done, updates = trainer.progress.update, settings["training"]["updates"]
    if done >= updates:
        print(f"{done} updates are done; train further with training.updates={2 * done}")
    return train(folder, settings, task, trainer)


def train(folder: Path, settings: dict[str, Any], task: experiment.Task, trainer: Trainer) -> float:
    """Train, evaluate on the held-out pool, report."""
    setup = settings["setup"]["name"]
    print(f"{setup} setup, {task.title}, run folder {folder}")

    def save() -> None:
        experiment.make_checkpoint(settings, task, trainer).save(folder / FILE_NAME)

    go_on_line = f"go on with: python train.py resume={shlex.quote(str(folder))}"
    if not trainer.run(folder, save, LearningCurve(settings, task, trainer).measure):
        print(f"stopped after {trainer.progress.update} updates; {go_on_line}")
        sys.exit(130)
    label = comparison.label_of(settings)
    learned = {label: experiment.make_checkpoint(settings, task, trainer)}
    try:
        panels = comparison.evaluate_panels(settings, task, learned)
    except KeyboardInterrupt:
        print(f"\ntrained, not evaluated; {go_on_line}")
        sys.exit(130)
    reports.write_report(folder, panels)
    training_report.write_training(folder, {label: trainer.progress})
    held_out = next(iter(panels.values()))[label]
    reports.write_summary(folder, settings["overrides"], held_out)
    if (folder.parent / "multirun.yaml").exists():  # Hydra's mark of a sweep
        print(reports.sweep_table(folder.parent))
    return float(held_out.alignment[:, -1].mean())


if __name__ == "__main__":
    app.main(job)
