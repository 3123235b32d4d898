"""Compare strategies on the same humans and rebuild the paper's figures.

`python evaluate.py --help` lists the keys.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

import app
from torchrl_pref import comparison, experiment, heldout, heldout_report, reports
from torchrl_pref.checkpoint import FILE_NAME, Checkpoint
from torchrl_pref.errors import InputError, check_choice, check_count, one_line_errors
from torchrl_pref.pretrained import SEEDS, pretrained_checkpoint
from torchrl_pref.queries import QueryPool

PROTOCOL_KEYS = (
    "checkpoint",
    "workers",
    "device",
    "threads",
    "hydra.",
    "setup.budget",
    "setup.offers",
    "belief.",
    "grid.",
    "pool.size",
    "pool.options",
    "pool.seed",
)
"""What may be typed beside ``protocol``; the rest is the protocol's own."""

Evaluated = tuple[comparison.Panels, dict[str, dict[str, list[float]]]]
"""Panels of evaluations, and the training histories behind them."""


@hydra.main(config_path="conf", config_name="evaluate", version_base="1.3")
def job(config: DictConfig) -> None:
    """Evaluate checkpoints, or the baselines where none is named."""
    folder = app.output_folder()
    try:
        with one_line_errors():
            settings = app.plain_settings(config)
            app.use_threads(settings)
            named = settings["checkpoint"]
            check_lists(settings)
            if app.was_typed("objective"):
                raise InputError(
                    "objective=… is what a policy is trained for and changes nothing here; "
                    "expected by train.py alone; remove it"
                )
            if settings["protocol"] is not None:
                check_choice("protocol", settings["protocol"], ("heldout",))
                app.refuse_other_overrides("protocol", PROTOCOL_KEYS)
                run_heldout(settings, folder)
            elif "policy" in settings:
                check_choice("policy", settings["policy"]["name"], ("pretrained",))
                if named is not None:
                    raise InputError(
                        "policy=pretrained and checkpoint=… name two policies; expected one of "
                        "them; pretrained policies are files too: checkpoint=[a.pt,b.pt]"
                    )
                panels = evaluate_taus(settings, partial(pretrained_for, settings))
                reports.write_report(folder, panels, {})
            elif named is None:
                reports.write_report(folder, evaluate_taus(settings, lambda tau: {}), {})
            else:
                allowed = ("evaluation.", "pool.test", "device", "threads", "hydra.")
                app.refuse_other_overrides("checkpoint", allowed)
                paths = find_checkpoints([str(name) for name in listed(named)])
                reports.write_report(folder, *evaluate_checkpoints(settings, paths))
    finally:
        app.discard_if_empty(folder)


def check_lists(settings: dict[str, Any]) -> None:
    """Refuse empty lists where at least one thing has to be evaluated.

    Raises:
        InputError: ``tau`` or ``checkpoint`` is empty.
    """
    for key, example in (("tau", "[noisy,optimal]"), ("checkpoint", "outputs/<run>")):
        if settings[key] == []:
            raise InputError(f"{key}=[]: expected at least one, such as {key}={example}")


def listed(value: Any) -> list[Any]:
    """A list as it is, and anything else as a list of one."""
    return value if isinstance(value, list) else [value]


def evaluate_taus(
    settings: dict[str, Any], learned_for: Callable[[Any], dict[str, Checkpoint]]
) -> comparison.Panels:
    """The baselines and what was learned for each tau, a panel each."""
    pools = experiment.make_pools(settings)
    taus = listed(settings["tau"])
    tasks = [(experiment.make_task(*pools, tau), learned_for(tau)) for tau in taus]
    panels: comparison.Panels = {}
    for task, learned in tasks:
        panels |= comparison.evaluate_panels(settings, task, learned)
    return panels


def pretrained_for(settings: dict[str, Any], tau: Any) -> dict[str, Checkpoint]:
    """The policy that comes with the package for a tau, under the settings of this evaluation."""
    checkpoint = pretrained_checkpoint(settings["setup"]["name"], tau)
    for section in ("setup", "belief", "skip", "tau_spread", "device"):
        checkpoint.settings[section] = settings[section]
    return {f"{comparison.label_of(checkpoint.settings)} (pretrained)": checkpoint}


def run_heldout(settings: dict[str, Any], folder: Path) -> None:
    """The held-out protocol, for checkpoints or for the policies that come with the package."""
    learned: dict[heldout.Cell, list[Checkpoint]] = {}
    if settings["checkpoint"] is None:
        for setup, tau in product(("query", "feed"), ("noisy", "optimal")):
            learned[heldout.Cell(setup, tau)] = [
                pretrained_checkpoint(setup, tau, seed) for seed in range(SEEDS)
            ]
    else:
        for path in find_checkpoints([str(name) for name in listed(settings["checkpoint"])]):
            checkpoint = Checkpoint.load(path)
            cell = heldout.Cell(checkpoint.settings["setup"]["name"], checkpoint.settings["tau"])
            learned.setdefault(cell, []).append(checkpoint)
    workers = check_count("workers", settings["workers"], 1)
    heldout_report.write_heldout(folder, heldout.run_protocol(settings, learned, workers))


def find_checkpoints(named: list[str]) -> list[Path]:
    """The checkpoint files meant by files, run folders and sweep folders.

    Raises:
        InputError: a path holds none.
    """
    paths = []
    for name in map(Path, named):
        whole = Path(os.path.realpath(name))  # of a link to itself, too
        found = [whole] if whole.is_file() else sorted(whole.rglob(FILE_NAME))
        if not found:
            raise InputError(
                f"checkpoint={name}: no {FILE_NAME} there; expected a checkpoint file, the folder "
                "of a run or of a sweep; check the path"
            )
        paths += found
    return paths


def evaluate_checkpoints(settings: dict[str, Any], paths: list[Path]) -> Evaluated:
    """Learned policies beside random and greedy, a panel for each kind of human."""
    runs = []
    common = Path(os.path.commonpath([path.parent.parent for path in paths]))
    for path in paths:
        checkpoint = Checkpoint.load(path)
        # The rest of the settings is the checkpoint's own.
        for section in ("evaluation", "device"):
            checkpoint.settings[section] = settings[section]
        pools = path.with_name("train_pool.pt"), path.with_name("test_pool.pt")
        named = path.parent if path.name == FILE_NAME else path.with_suffix("")
        name = str(named.relative_to(common))
        runs.append((name, checkpoint, experiment.reload_task(checkpoint, *pools)))
    panels: comparison.Panels = {}
    for panel_settings, task, learned in comparison.group_checkpoints(runs):
        test = None
        if settings["pool"]["test"] is not None:
            test = QueryPool.load(settings["pool"]["test"]).map_features(task.normalizer)
        panels |= comparison.evaluate_panels(panel_settings, task, learned, test)
    titles = [f"{comparison.label_of(c.settings)}, {task.title}" for _, c, task in runs]
    histories = {}
    for title, (name, checkpoint, _) in zip(titles, runs, strict=True):
        unique = title if titles.count(title) == 1 else f"{title}, {name}"
        histories[unique] = checkpoint.history
    return panels, histories


if __name__ == "__main__":
    app.main(job)
