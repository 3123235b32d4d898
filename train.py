"""Train a policy to ask, then compare it with random and greedy on queries it never saw.

`python train.py --help` lists the keys. What takes long to import is imported where it is used, so
that help and refusals come at once.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
from omegaconf import DictConfig, OmegaConf

import app
import typed
from torchrl_pref import runs, sweeps
from torchrl_pref.checkpoints.migrations import migrate
from torchrl_pref.config.memory import check_memory
from torchrl_pref.config.sections import Plain, Settings, flat
from torchrl_pref.config.settings import check_run, check_train_settings
from torchrl_pref.errors import InputError
from torchrl_pref.runs import CHECKPOINT
from torchrl_pref.storage.writing import write_text

if TYPE_CHECKING:
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.problem import Problem
    from torchrl_pref.training.trainer import Trainer

CONFIG = "config.yaml"
POOLS = ("train_pool.pt", "test_pool.pt")
RUN = (CHECKPOINT, *POOLS, CONFIG)
"""The files by which a folder holds a run. The configuration comes first: from it the run can be
started again where it was killed before its first checkpoint."""


OF_THE_MACHINE = ("device", "threads", "logger")
"""Settings that leave a run what it is, and may differ where it goes on."""


@hydra.main(config_path="conf", config_name="train", version_base="1.3")
def job(config: DictConfig) -> float:
    """One run; returns the policy's final alignment on the test pool, for sweepers."""
    return app.do_job(partial(run, config))


def check(settings: Plain) -> Settings:
    """Refuse what cannot be trained.

    Raises:
        InputError: a setting is out of range, or was typed where a checkpoint decides.
    """
    checked = check_train_settings(settings)
    app.allow_typed(settings)
    if settings["resume"] is None:
        app.check_groups(settings)
    else:
        own = tuple(key.partition(".")[0] for key in typed.typed_code())
        allowed = ("training.updates", *OF_THE_MACHINE, "hydra.")
        typed.refuse_other_overrides("resume", allowed, own)
    return checked


def run(config: DictConfig, made: Path) -> float:
    """A new run in the folder made for it, or one to go on with, in its own."""
    settings = check(typed.plain_settings(config))
    resume = settings.pop("resume")
    if resume is not None:
        folder = run_folder(Path(str(resume)))
        with runs.claimed(folder):
            value = go_on(folder, settings)
        if (folder.parent / sweeps.TABLE).exists():
            sweeps.show_table(folder.parent, sweeps.write_table(folder.parent))
        return value
    with runs.claimed(made):
        if not any((made / name).exists() for name in RUN):
            return begin(made, settings)
        refuse_study(made)
        if not app.in_sweep():
            raise InputError(
                f"{made} holds a run already; go on with it by: "
                f"{app.command(app.as_typed('resume', made))}, or name another folder by "
                "hydra.run.dir="
            )
        refuse_other_run(made, settings)
        if (made / sweeps.SUMMARY).exists():
            print(f"{made}: this job is finished")
            return sweeps.final_alignment(made)
        return go_on(made, settings)


def run_folder(path: Path) -> Path:
    """The folder of a run, named by itself or by its checkpoint.

    Raises:
        InputError: there is none.
    """
    from torchrl_pref.checkpoints.checkpoint import Checkpoint

    if path.is_file():
        check_trained(path, Checkpoint.load(path))
        path = path.parent
    refuse_study(path)
    if not any((path / name).exists() for name in (CHECKPOINT, CONFIG)):
        found = "holds no run" if path.is_dir() else "no such file or folder"
        raise InputError(
            f"resume={path}: {found}; expected the folder of a run, with its {CHECKPOINT} or "
            f"{CONFIG}; check the path, or start a new run there by hydra.run.dir="
        )
    return path.resolve()


def refuse_study(folder: Path) -> None:
    """Refuse a folder of ``ask.py``.

    Raises:
        InputError: it is one.
    """
    if (folder / runs.STUDY).exists():
        raise InputError(
            f"{folder} holds a study of ask.py, and no run; name another folder by hydra.run.dir="
        )


def refuse_other_run(folder: Path, settings: Settings) -> None:
    """Refuse to go on with a run that has other settings.

    Raises:
        InputError: it has.
    """
    asked = flat({**settings, "overrides": None})
    there = flat({**load_config(folder), "overrides": None})
    differing = [
        f"{key}={there.get(key)} there and {asked.get(key)} here"
        for key in sorted(asked.keys() | there.keys())
        if asked.get(key) != there.get(key) and key not in OF_THE_MACHINE
    ]
    if differing:
        raise InputError(
            f"{folder} holds a run with other settings ({', '.join(differing)}); name another "
            "folder by hydra.sweep.dir=, or type the settings of that sweep"
        )


def load_config(folder: Path) -> Plain:
    """The configuration that a run was started with.

    Raises:
        InputError: it cannot be read.
    """
    try:
        settings = OmegaConf.to_container(OmegaConf.load(folder / CONFIG))
    except Exception as error:  # whatever the reader trips over, the file is at fault
        raise InputError(f"{folder / CONFIG}: cannot be read ({error}); restore it") from error
    if not isinstance(settings, dict):
        raise InputError(f"{folder / CONFIG}: holds no settings; restore it")
    migrate(settings)
    return {str(key): value for key, value in settings.items()}


def begin(folder: Path, settings: Settings) -> float:
    """A new run in a folder, from the settings as typed."""
    settings["overrides"] = typed.typed_overrides()
    if settings["checkpoint"] is not None:
        settings["checkpoint"] = str(Path(str(settings["checkpoint"])).absolute())
    return start(folder, settings)


def start(folder: Path, settings: Settings) -> float:
    """The first update of a run, and all that follow."""
    from torchrl_pref import build
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.evaluation import comparison
    from torchrl_pref.training.start import make_trainer

    app.use_threads(settings)
    pools = build.make_pools(settings)
    check_memory(settings, *pools[0].features.shape)
    if len(pools[0]) < settings["pool"]["size"] and settings["pool"]["train"] is None:
        print(
            f"note: {len(pools[0])} queries to train on and {len(pools[1])} to test on; the task "
            f"has no more, and pool.size={settings['pool']['size']} asks for more"
        )
    task = build.make_task(*pools, settings["tau"], settings)
    trainer = make_trainer(settings, task)
    comparison.check_evaluation(settings)
    source = settings["checkpoint"]
    if source is not None:
        checkpoint = Checkpoint.load(source)
        checkpoint.check_fits(task.train, own_indices=True)
        build.load_weights(trainer.policy, checkpoint)
        trainer.start_average()
    # Before this is there, there is nothing to go on with.
    write_text(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create({**settings})))
    with app.resumable(folder):
        for pool, name in zip(pools, POOLS, strict=True):
            pool.save(folder / name)
        del settings["checkpoint"]  # no more than where the weights began
        return train(folder, settings, task, trainer)


def go_on(folder: Path, new: Settings) -> float:
    """An old run, from its last checkpoint or its start, with its own settings."""
    from torchrl_pref import build
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.training.start import make_trainer

    checkpoint = Checkpoint.load(folder) if (folder / CHECKPOINT).exists() else None
    plain: Plain = load_config(folder) if checkpoint is None else {**checkpoint.settings}
    other = [key for key in OF_THE_MACHINE if typed.was_typed(key)]
    settings = check_run(plain | {key: value for key, value in new.items() if key in other})
    if typed.was_typed("training.updates"):
        updates = settings["training"]["updates"] = new["training"]["updates"]
        others = [o for o in settings["overrides"] if not o.startswith("training.updates=")]
        settings["overrides"] = [*others, f"training.updates={updates}"]
    app.refuse_other_code(settings, new)
    if checkpoint is None:
        print(f"{folder}: was stopped before its first checkpoint and starts again")
        return start(folder, settings)
    check_trained(folder, checkpoint)
    app.use_threads(settings)
    task = build.reload_task(checkpoint, *(folder / name for name in POOLS))
    trainer = make_trainer(settings, task)
    build.load_weights(trainer.policy, checkpoint)
    trainer.load_state_dict(checkpoint.training)
    done, updates = trainer.progress.update, settings["training"]["updates"]
    if done >= updates:
        print(f"{done} updates are done; train further with training.updates={2 * done}")
    with app.resumable(folder):
        return train(folder, settings, task, trainer)


def check_trained(path: Path, checkpoint: Checkpoint) -> None:
    """Refuse a policy that cannot be trained further.

    Raises:
        InputError: its file lacks the state of its training.
    """
    if "optimizer" not in checkpoint.training:
        raise InputError(
            f"resume={path}: holds a policy without the state of its training, as it comes with "
            f"the package or from an earlier version; start a new run from it by checkpoint={path}"
        )


def train(folder: Path, settings: Settings, task: Problem, trainer: Trainer) -> float:
    """Train, evaluate on the held-out pool, report."""
    from torchrl_pref.evaluation import comparison, reports
    from torchrl_pref.training import figure
    from torchrl_pref.training.learning_curve import LearningCurve
    from torchrl_pref.training.start import make_checkpoint

    setup = settings["setup"]["name"]
    print(f"{setup} setup, {task.title}, run folder {folder}")
    updates, warm_up = settings["training"]["updates"], settings["training"]["warm_up"]
    if updates <= warm_up:
        print(
            f"note: only the critic learns in the first training.warm_up={warm_up} updates, and "
            f"there are {updates}: the policy stays as it starts"
        )

    def save() -> None:
        make_checkpoint(settings, task, trainer).save(folder / CHECKPOINT)

    measure = LearningCurve(settings, task, trainer).measure
    trainer.run(folder, save, measure, settings["logger"])
    key = comparison.policy_key(settings)
    learned = {key: make_checkpoint(settings, task, trainer)}
    records = comparison.evaluate_task(settings, task, learned)
    reports.write_report(folder, records)
    figure.write_training(folder, [figure.Training(key, task.title, trainer.progress)])
    return sweeps.write_summary(folder, settings["overrides"], records, key)


if __name__ == "__main__":
    app.main(job, check)
