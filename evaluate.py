"""Compare strategies on the same humans and rebuild the paper's figures.

`python evaluate.py --help` lists the keys.
"""

from __future__ import annotations

import os
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
            for key, word in (("protocol", "heldout"), ("policy", "pretrained")):
                if settings[key] is not None:
                    check_choice(key, settings[key], (word,))
            if settings["protocol"] is not None:
                run_heldout(settings, folder)
            elif named is None and settings["policy"] is not None:
                reports.write_report(folder, *evaluate_pretrained(settings))
            elif named is None:
                reports.write_report(folder, evaluate_baselines(settings), {})
            else:
                allowed = ("evaluation.", "pool.test", "device", "threads", "hydra.")
                app.refuse_other_overrides("checkpoint", allowed)
                names = named if isinstance(named, list) else [named]
                paths = find_checkpoints([str(name) for name in names])
                reports.write_report(folder, *evaluate_checkpoints(settings, paths))
    finally:
        app.discard_if_empty(folder)


def evaluate_baselines(settings: dict[str, Any]) -> comparison.Panels:
    """Random and greedy, a panel for each tau."""
    taus = settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]
    pools = experiment.make_pools(settings)
    panels: comparison.Panels = {}
    for task in [experiment.make_task(*pools, tau) for tau in taus]:
        panels |= comparison.evaluate_panels(settings, task, {})
    return panels


def evaluate_pretrained(settings: dict[str, Any]) -> Evaluated:
    """The policies that come with the package beside the baselines, a panel for each tau."""
    taus = settings["tau"] if isinstance(settings["tau"], list) else [settings["tau"]]
    pools = experiment.make_pools(settings)
    setup = settings["setup"]["name"]
    panels: comparison.Panels = {}
    for tau in taus:
        checkpoint = pretrained_checkpoint(setup, tau)
        for section in ("setup", "belief", "tau_spread", "device"):
            checkpoint.settings[section] = settings[section]
        label = f"{comparison.label_of(checkpoint.settings)} (pretrained)"
        task = experiment.make_task(*pools, tau)
        panels |= comparison.evaluate_panels(settings, task, {label: checkpoint})
    return panels, {}


def run_heldout(settings: dict[str, Any], folder: Path) -> None:
    """The held-out protocol, for checkpoints or for the policies that come with the package."""
    learned: dict[heldout.Cell, list[Checkpoint]] = {}
    if settings["checkpoint"] is None:
        for setup, tau in product(("query", "feed"), ("noisy", "optimal")):
            learned[heldout.Cell(setup, tau)] = [
                pretrained_checkpoint(setup, tau, seed) for seed in range(SEEDS)
            ]
    else:
        named = settings["checkpoint"]
        for path in find_checkpoints(
            [str(n) for n in (named if isinstance(named, list) else [named])]
        ):
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
        found = [name.resolve()] if name.is_file() else sorted(name.resolve().rglob(FILE_NAME))
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
        name = str(path.parent.relative_to(common))
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
