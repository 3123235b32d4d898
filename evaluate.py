"""Compare strategies on the same humans and rebuild the paper's figures.

`python evaluate.py --help` lists the keys. What takes long to import is imported where it is used,
so that help and refusals come at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import hydra
from omegaconf import DictConfig, OmegaConf

import app
import typed
from help_text import CONF
from torchrl_pref import runs
from torchrl_pref.config.sections import GroupSection, Plain, Settings
from torchrl_pref.config.settings import check_evaluate_settings
from torchrl_pref.errors import InputError, one_line_errors
from torchrl_pref.runs import CHECKPOINT

if TYPE_CHECKING:
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.evaluation.own import Maker
    from torchrl_pref.evaluation.records import Records
    from torchrl_pref.training.figure import Training

PROTOCOL_KEYS = (
    "checkpoint",
    "workers",
    "device",
    "threads",
    "hydra.",
    "setup.budget",
    "setup.offers",
    "strategy",
    "cost.",
    "evaluation.metrics",
    "belief",
    "human",
    "question",
    "task",
    "tasks",
    "tau",
    "pool.size",
    "pool.options",
    "pool.seed",
    "pool.train",
    "pool.test",
)
"""What may be typed beside ``protocol``; the rest is the protocol's own."""

OF_EVALUATION = (
    "setup",
    "skip",
    "device",
    "task",
    "pool",
    "question",
    "human",
    "belief",
    "demonstrations",
)
"""Settings that a policy of the package takes from the evaluation, and not from its training."""


@hydra.main(config_path="conf", config_name="evaluate", version_base="1.3")
def job(config: DictConfig) -> None:
    """Evaluate checkpoints, or the baselines where none is named."""
    folder = app.output_folder()
    try:
        with one_line_errors(), runs.claimed(folder):
            if (folder / CHECKPOINT).exists() or (folder / "config.yaml").exists():
                raise InputError(
                    f"{folder} holds a run, whose tables and figures would be overwritten; name "
                    "another folder by hydra.run.dir="
                )
            if (folder / runs.TABLES).exists():
                raise InputError(
                    f"{folder} holds an evaluation already; remove it, or name another folder by "
                    "hydra.run.dir="
                )
            evaluate(check(typed.plain_settings(config)), folder)
    finally:
        app.discard_if_empty(folder)


def check(settings: Plain) -> Settings:
    """Refuse what cannot be evaluated.

    Raises:
        InputError: a setting is out of range, or was typed where something else decides.
    """
    if typed.was_typed("objective"):
        raise InputError(
            "objective=… is what a policy is trained for and changes nothing here; "
            "expected by train.py alone; remove it"
        )
    if settings.get("tasks") is not None:
        check_tasks(settings)
    if settings.get("protocol") is not None:
        typed.refuse_other_overrides("protocol", PROTOCOL_KEYS)
    elif settings.get("checkpoint") is not None:
        own = tuple(key.partition(".")[0] for key in typed.typed_code())
        if "policy" in settings and "policy" not in own:
            raise InputError(
                "policy=pretrained and checkpoint=… name two policies; expected one of "
                "them; pretrained policies are files too: checkpoint=[a.pt,b.pt]"
            )
        allowed = ("evaluation.", "pool.test", "strategy", "cost.", "device", "threads", "hydra.")
        typed.refuse_other_overrides("checkpoint", allowed, own)
    app.allow_typed(settings)
    if settings.get("checkpoint") is not None:
        settings.pop("policy", None)  # code of the user's, for whichever checkpoint names it
    elif settings.get("policy", {}).get("name") == "own":
        raise InputError(
            f"policy={settings['policy'].get('make')}: a policy of yours is evaluated as it was "
            "trained; add checkpoint=<its run folder>, or name a strategy by strategy="
        )
    try:
        return _checked(settings)
    except InputError as error:
        if typed.was_typed("tau") or settings["tau"] != ["noisy", "optimal"]:
            raise
        try:
            checked = _checked({**settings, "tau": ["noisy"]})
        except InputError:
            raise error from None
        print(f"note: here tau=noisy alone, because {error}")
        return checked


def _checked(settings: Plain) -> Settings:
    """See :func:`check`, once it is known that nothing decides what something else does."""
    checked = check_evaluate_settings(settings)
    typed.refuse_idle_cost(listed(checked["strategy"]))
    for each in tasks_of(checked):
        app.check_groups({**each})
    own_strategies(checked)
    return checked


def evaluate(settings: Settings, folder: Path) -> None:
    """What the settings ask for, reported in a folder."""
    from torchrl_pref.evaluation import reports
    from torchrl_pref.training import figure

    app.use_threads(settings)
    trained: list[Training] = []
    if settings["protocol"] is not None:
        records = run_heldout(settings)
    elif "policy" in settings:
        records = evaluate_taus(settings, partial(pretrained_for, settings))
    elif settings["checkpoint"] is None:
        records = evaluate_taus(settings, lambda tau: {})
    else:
        paths = find_checkpoints([str(name) for name in listed(settings["checkpoint"])])
        records, trained = evaluate_checkpoints(settings, paths)
    reports.write_report(folder, records)
    figure.write_training(folder, trained)


def listed(value: Any) -> list[Any]:
    """A list as it is, and anything else as a list of one."""
    return value if isinstance(value, list) else [value]


def own_strategies(settings: Settings) -> dict[str, Maker]:
    """What makes the strategies that the user typed.

    Raises:
        InputError: there is no such module or name, or it cannot be called.
    """
    if settings["strategy"] is None:
        return {}
    from torchrl_pref.evaluation.own import find_makers

    return find_makers(listed(settings["strategy"]), settings)


def evaluate_taus(
    settings: Settings, learned_for: Callable[[Any], dict[str, Checkpoint]]
) -> Records:
    """The baselines and what was learned for each tau, a task each."""
    from torchrl_pref import build
    from torchrl_pref.evaluation import comparison, misjudged
    from torchrl_pref.evaluation.records import Records

    pools = build.make_pools(settings)
    taus = listed(settings["tau"])
    tasks = [(build.make_task(*pools, tau, settings), learned_for(tau)) for tau in taus]
    own, records = own_strategies(settings), Records()
    for task, _ in tasks:
        comparison.try_strategies(own, settings, task)
    for task, learned in tasks:
        records.entries += misjudged.evaluate_misjudged(settings, task, learned, own=own).entries
    return records


def pretrained_for(settings: Settings, tau: Any) -> dict[str, Checkpoint]:
    """The policy that comes with the package, under the settings of this evaluation."""
    from torchrl_pref.evaluation.comparison import policy_key
    from torchrl_pref.pretrained import pretrained_checkpoint

    checkpoint = pretrained_checkpoint(settings["setup"]["name"])
    taken = {key: value for key, value in settings.items() if key in OF_EVALUATION}
    checkpoint = replace(checkpoint, settings=cast(Settings, {**checkpoint.settings, **taken}))
    return {f"{policy_key(checkpoint.settings)}:pretrained": checkpoint}


def run_heldout(settings: Settings) -> Records:
    """The held-out protocol, for checkpoints or for the policies that come with the package."""
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.evaluation import heldout
    from torchrl_pref.evaluation.heldout_pool import Cell
    from torchrl_pref.pretrained import SEEDS, pretrained_checkpoint

    checkpoints: list[Checkpoint] = []
    if settings["checkpoint"] is None:
        for setup, seed in product(("query", "feed"), range(SEEDS)):
            checkpoints.append(pretrained_checkpoint(setup, seed=seed))
    else:
        paths = find_checkpoints([str(name) for name in listed(settings["checkpoint"])])
        checkpoints = [Checkpoint.load(path) for path in paths]
    learned: dict[Cell, list[Checkpoint]] = {}
    for checkpoint in checkpoints:
        for tau in taus_for(settings, checkpoint):
            cell = Cell(checkpoint.settings["setup"]["name"], tau)
            learned.setdefault(cell, []).append(checkpoint)
    return heldout.run_protocol(
        tasks_of(settings), learned, settings["workers"], list(own_strategies(settings))
    )


def taus_for(settings: Settings, checkpoint: Checkpoint) -> list[Any]:
    """The kinds of human by whom the protocol judges a policy.

    Raises:
        InputError: others were typed for a policy of one task.
    """
    if checkpoint.of_every_task:
        return listed(settings["tau"])
    own = checkpoint.settings["tau"]
    if typed.was_typed("tau"):
        raise InputError(
            f"tau=…: a policy of one task is judged by the humans of its training, tau={own}; "
            "remove tau"
        )
    return [own]


def check_tasks(settings: Plain) -> None:
    """Refuse ``tasks`` where one task is looked at, or another key chooses it.

    Raises:
        InputError: ``tasks`` was typed without the protocol, or beside a task or pools.
    """
    if settings.get("protocol") is None:
        raise InputError(
            f"tasks={settings['tasks']} without protocol=heldout: expected task=<name>, one; or "
            "add protocol=heldout"
        )
    for key in ("task", "pool.train", "pool.test"):
        if typed.was_typed(key):
            raise InputError(
                f"{key}= beside tasks=: each of the tasks has pools of its own; remove {key}, or "
                "tasks"
            )


def tasks_of(settings: Settings) -> list[Settings]:
    """The settings for each task of the protocol: those named, or the one that was typed."""
    named = settings["tasks"]
    if named is None:
        return [settings]
    sections = [OmegaConf.load(CONF / "task" / f"{name}.yaml") for name in listed(named)]
    plain = [cast(GroupSection, OmegaConf.to_container(section)) for section in sections]
    return [{**settings, "task": section} for section in plain]


def find_checkpoints(named: list[str]) -> list[Path]:
    """The checkpoint files meant by files, run folders and sweep folders.

    Raises:
        InputError: a path holds none.
    """
    paths = []
    for name in map(Path, named):
        whole = Path(os.path.realpath(name))  # of a link to itself, too
        found = [whole] if whole.is_file() else sorted(whole.rglob(CHECKPOINT))
        if not found:
            raise InputError(
                f"checkpoint={name}: no {CHECKPOINT} there; expected a checkpoint file, the folder "
                "of a run or of a sweep; check the path"
            )
        paths += found
    return paths


def evaluate_checkpoints(settings: Settings, paths: list[Path]) -> tuple[Records, list[Training]]:
    """Learned policies beside random and greedy, a task for each kind of human, and the trainings
    behind them."""
    from torchrl_pref import build
    from torchrl_pref.checkpoints.checkpoint import Checkpoint
    from torchrl_pref.evaluation import comparison, misjudged
    from torchrl_pref.evaluation.records import Records
    from torchrl_pref.training.figure import Training
    from torchrl_pref.training.progress import Progress

    runs = []
    common = Path(os.path.commonpath([path.parent.parent for path in paths]))
    for path in paths:
        checkpoint = Checkpoint.load(path)
        # The rest of the settings is the checkpoint's own.
        for section in ("evaluation", "device"):
            checkpoint.settings[section] = settings[section]
        pools = path.with_name("train_pool.pt"), path.with_name("test_pool.pt")
        named = path.parent if path.name == CHECKPOINT else path.with_suffix("")
        name = str(named.relative_to(common))
        runs.append((name, checkpoint, build.reload_task(checkpoint, *pools)))
    own, groups = own_strategies(settings), comparison.group_checkpoints(runs)
    named_pool, tests = settings["pool"]["test"], []
    for its_settings, task, _ in groups:
        test = None
        if named_pool is not None:
            build.refuse_own_pools(its_settings, build.human_of(its_settings, task))
            test = build.load_test_pool(named_pool, task)
        tests.append(test)
        comparison.try_strategies(own, its_settings, task)
    records, trained = Records(), []
    for (its_settings, task, learned), test in zip(groups, tests, strict=True):
        found = misjudged.evaluate_misjudged(its_settings, task, learned, test, own)
        records.entries += found.entries
        for key, checkpoint in learned.items():
            trained.append(Training(key, task.title, Progress.of(checkpoint.training)))
    return records, trained


if __name__ == "__main__":
    app.main(job, check)
