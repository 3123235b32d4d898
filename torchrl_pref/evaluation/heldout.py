"""The held-out protocol: learned policies beside strong baselines on pools that no training saw.

Every strategy of a pool faces the same humans, the same luck in their answers and, in the feed, the
same offers, so that all differences are paired. Intervals are bootstrapped over pools and training
seeds: humans of one pool share it, and policies of one training share that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import torch
from tqdm import tqdm

from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.compiled import share_out
from torchrl_pref.config.sections import Plain, Settings, flat
from torchrl_pref.errors import InputError, OtherSetup
from torchrl_pref.evaluation.comparison import policy_key
from torchrl_pref.evaluation.heldout_pool import (
    CLOSELY,
    THRESHOLDS,
    Cell,
    Job,
    fit_threshold,
    pools_of,
    run_pool,
    try_job,
)
from torchrl_pref.evaluation.records import Records
from torchrl_pref.groups import OWN, TABLES, make
from torchrl_pref.processes import spawning
from torchrl_pref.tasks.base import Task
from torchrl_pref.typed_code import allow, allowed

POOLS, BALANCED_POOLS = 10, 3


def run_protocol(
    tasks: Sequence[Settings],
    learned: Mapping[Cell, Sequence[Checkpoint]],
    workers: int,
    own: Sequence[str] = (),
) -> Records:
    """Run all cells for which there are policies, on each task.

    Of a task there are ten pools that no training used. On a pool of the user's
    (``pool.train`` and ``pool.test``) ten groups of humans face the test pool, all of it: intervals
    are over groups, and tell of other humans on that pool and not of other pools.

    Args:
        tasks: for each the sections ``task``, ``pool``, ``belief``, ``setup`` and ``device``.
        learned: the policies of each cell, of any kinds and training seeds.
        workers: processes that run pools side by side, one CPU thread each.
        own: strategies of the user, ``module:name`` of each; they face every cell of their setup.

    Raises:
        InputError: a policy was trained for another budget or cannot face the same offers as the
            others, or a strategy of the user cannot decide.
    """
    pools_of.cache_clear()  # a file of before may hold something else now
    jobs = [job for settings in tasks for job in _jobs(settings, learned, own)]
    fitting = {job.cell: try_job(job) for job in jobs if job.pool == 0}
    for name in own:
        if not any(name in names for names in fitting.values()):
            raise OtherSetup(f"strategy={name}: it is for a setup that no policy here is for")
    jobs = [replace(job, own=fitting[job.cell]) for job in jobs]
    # One file descriptor for each tensor that is passed would be too many for some systems.
    torch.multiprocessing.set_sharing_strategy("file_system")
    context = get_context("spawn")
    options = workers, context, _start_worker, (allowed(),)
    with spawning(), ProcessPoolExecutor(*options) as executor:
        jobs = _with_thresholds(jobs, executor)
        done = tqdm(executor.map(run_pool, jobs), total=len(jobs), desc="pools", unit="pool")
        return Records([entry for entries in done for entry in entries])


def _with_thresholds(jobs: Sequence[Job], executor: Executor) -> list[Job]:
    """The jobs with the threshold that is best for their feed, where it is looked at closely."""
    closely = [job for job in jobs if job.cell.features in CLOSELY and job.pool == 0]
    feeds = {job.cell: job for job in closely if job.cell.setup == "feed"}
    fits = [replace(job, learned={}, own=(), thresholds=THRESHOLDS) for job in feeds.values()]
    alignments = executor.map(fit_threshold, fits)
    best = {
        cell: (THRESHOLDS[int(alignment.argmax())],)
        for cell, alignment in zip(feeds, alignments, strict=True)
    }
    return [replace(job, thresholds=best.get(job.cell, ())) for job in jobs]


def _jobs(
    settings: Settings, learned: Mapping[Cell, Sequence[Checkpoint]], own: Sequence[str]
) -> list[Job]:
    """A job for each pool of each cell, whose thresholds are yet to be fitted; those of a pool
    follow one another."""
    jobs, task = [], make("task", settings["task"])
    for cell, checkpoints in learned.items():
        for checkpoint in checkpoints:
            _check_fits(settings, cell, checkpoint, checkpoints[0])
            _check_unseen(settings, task, checkpoint)
        kinds = kinds_of(checkpoints)
        settings = {**settings, "skip": checkpoints[0].settings["skip"]}
        cells = [(cell._replace(features=features_of(settings)), POOLS)]
        if cells[0][0] == Cell("query", cell.tau):
            cells.append((cell._replace(features="balanced"), BALANCED_POOLS))
        jobs += [
            Job(settings, each, pool, kinds, own=own)
            for each, count in cells
            for pool in range(count)
        ]
    return sorted(jobs, key=lambda job: job.pool)


def features_of(settings: Settings) -> str:
    """What the features of the cells are called."""
    if settings["pool"]["test"] is not None:
        return "own"
    task = settings["task"]
    name: str = task["make"] if task["name"] == OWN else task["name"]
    return "corners" if name == "gridworld" else name


def _start_worker(typed: frozenset[str]) -> None:
    """One thread for each worker, tensors passed as files, and code of the user's as typed."""
    for reference in typed:
        allow(reference)
    torch.set_num_threads(1)
    share_out(1)
    torch.multiprocessing.set_sharing_strategy("file_system")


APART = (
    "task",
    "question",
    "human",
    "demonstrations",
    "belief",
    "setup",
    "policy",
    "objective",
    "algorithm",
)
"""Settings by which policies of one cell are of several kinds; the seed alone makes no kind."""


def kinds_of(checkpoints: Sequence[Checkpoint]) -> dict[str, list[Checkpoint]]:
    """Policies of one cell by key, those that differ in nothing but their training seed together.

    One kind has the key of the setup alone. Of several, each is named by its policy (``scorer``),
    and where that is not enough by the settings in which it differs from its like.
    """
    groups: list[tuple[dict[str, Any], list[Checkpoint]]] = []
    for checkpoint in checkpoints:
        plain: Plain = {**checkpoint.settings}
        own = {key: plain[key] for key in (*APART, "training", "pool")}
        same = next((members for settings, members in groups if settings == own), None)
        if same is None:
            groups.append((own, same := []))
        # The state of the training is of no use to a worker.
        same.append(replace(checkpoint, training={}))
    kind = policy_key(checkpoints[0].settings)
    if len(groups) == 1:
        return {kind: groups[0][1]}
    flats = [flat(settings) for settings, _ in groups]
    keys = {}
    for own_flat, (_, members) in zip(flats, groups, strict=True):
        like = [other for other in flats if other["policy.name"] == own_flat["policy.name"]]
        differing = [name for name in own_flat if any(o.get(name) != own_flat[name] for o in like)]
        which = [own_flat["policy.name"], *(f"{name}={own_flat[name]}" for name in differing)]
        keys[f"{kind}:{', '.join(which)}"] = members
    return keys


def _check_unseen(settings: Settings, task: Task, checkpoint: Checkpoint) -> None:
    """Refuse to judge a policy on recorded trajectories that it was trained on."""
    trained = checkpoint.settings
    recorded = task.split(0)[0] is not task
    mine, theirs = settings["pool"]["seed"], trained["pool"]["seed"]
    if recorded and trained["task"] == settings["task"] and mine != theirs:
        raise InputError(
            f"pool.seed={mine}: the policy was trained with pool.seed={theirs}, and recorded "
            "trajectories are split by it: it would be tested on some that it was trained on; set "
            f"pool.seed={theirs}"
        )


def _check_fits(settings: Settings, cell: Cell, checkpoint: Checkpoint, first: Checkpoint) -> None:
    """Refuse a policy that cannot be run on other pools, or not on the same offers as the first."""
    plain: Plain = {**checkpoint.settings}
    for group in TABLES:
        if plain[group]["name"] == OWN:
            raise InputError(
                f"protocol=heldout: a policy of a run with {group}="
                f"{plain[group].get('make')}, which is yours; expected runs of what "
                "is in the package; evaluate yours by checkpoint= without protocol="
            )
    if checkpoint.picks_by_index:
        raise InputError(
            "protocol=heldout: policy=paper in the query setup picks indices of its training pool, "
            "which mean nothing on another; train policy=scorer or policy=attention"
        )
    mine, theirs = (one.settings["skip"] for one in (checkpoint, first))
    if cell.setup == "feed" and mine != theirs:
        raise InputError(
            f"protocol=heldout: policies of a feed cell differ in skip: {mine} and {theirs}; "
            "expected policies that can be offered the same; give one kind at a time"
        )
    _check_trained_for(settings, cell, checkpoint)


def _check_trained_for(settings: Settings, cell: Cell, checkpoint: Checkpoint) -> None:
    """Refuse a policy of another kind of question or another budget, unless it is for all."""
    if checkpoint.of_every_task:
        return
    if checkpoint.settings["question"] != settings["question"]:
        raise InputError(
            f"protocol=heldout asks {settings['question']['name']} questions and the policy was "
            f"trained for {checkpoint.settings['question']['name']}; evaluate it by checkpoint= "
            "without protocol="
        )
    found, budget = checkpoint.settings["setup"]["budget"], settings["setup"]["budget"]
    if found != budget:
        raise InputError(
            f"protocol=heldout: a {cell.setup} policy was trained for setup.budget={found} and the "
            f"protocol asks {budget} queries; set setup.budget={found}"
        )
