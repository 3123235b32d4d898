"""Whether policies are as good as those that come with the package: paired, on new pools.

``python benchmarks/quality.py RUN [RUN ...]`` takes the run folders (or checkpoints) of trainings
of ``train.py``, and puts each beside the package's five policies of the same setup and human: the
same pools, humans, luck and offers. Nothing is trained. With fewer than five runs each faces the
humans more than once, so that both sides are told equally well. The interval is over pools and
runs; the seeds of the pools are neither those of any training nor those of the held-out protocol.

Shapes: P pools, S runs, B humans, H query budget.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.build import (
    load_policy,
    make_feed_env,
    make_pools,
    make_query_env,
    make_task,
)
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.comparison import FIRST_EVALUATION_SEED
from torchrl_pref.evaluation.heldout_pool import Cell
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.side_by_side import Entrant, run_side_by_side
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.evaluation.tables import signed, title_of
from torchrl_pref.pretrained import SEEDS, pretrained_checkpoint

FIRST_SEED = FIRST_EVALUATION_SEED + 60_000
"""Of the pools and humans; another one by ``--seed``, to tune on."""

MARGIN = 0.003
"""How far below the package's policies the lower end of the interval may be."""


class Job(NamedTuple):
    """One pool of one cell."""

    cell: Cell
    runs: tuple[str, ...]
    pool: int
    humans: int


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run folder or a checkpoint")
    parser.add_argument("--pools", type=int, default=10, help="new pools (default 10)")
    parser.add_argument("--humans", type=int, default=200, help="humans a pool (default 200)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first pool")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    options = common.start(parser)
    cells: dict[Cell, list[str]] = {}
    for run in options.runs:
        settings = Checkpoint.load(run).settings
        cells.setdefault(Cell(settings["setup"]["name"], settings["tau"]), []).append(run)
    seeds = [options.seed + 2 * pool for pool in range(options.pools)]  # a pool takes two
    jobs = [
        Job(cell, tuple(runs), seed, options.humans)
        for cell, runs in cells.items()
        for seed in seeds
    ]
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as executor:
        done = list(tqdm(executor.map(run_pool, jobs), total=len(jobs), unit="pool"))
    rows = []
    for cell in cells:
        results = [result for job, result in zip(jobs, done, strict=True) if job.cell == cell]
        mine, shipped = (torch.tensor(group) for group in zip(*results, strict=True))
        rows.append(row_of(cell, mine, shipped))
    title = f"Policies beside the package's, {options.pools} new pools of {options.humans} humans"
    common.report(title, rows, options.json)


def run_pool(job: Job) -> list[list[list[float]]]:
    """Of each run and each of the package's policies: alignment at the end, and mean of 1 to H."""
    common.one_thread()
    shipped = [pretrained_checkpoint(job.cell.setup, str(job.cell.tau), s) for s in range(SEEDS)]
    settings = shipped[0].settings
    train, test = make_pools(settings, job.pool)
    task = make_task(train, test, job.cell.tau, settings)
    make = make_feed_env if job.cell.setup == "feed" else make_query_env

    def make_env(sessions: int) -> QueryEnv | FeedEnv:
        return make(settings, task, task.test, sessions, job.pool)

    env = make_env(job.humans)
    mine = {run: Checkpoint.load(run) for run in job.runs}
    times = math.ceil(SEEDS / len(mine))
    lineup = [Entrant(run, load_policy(one, env).strategy) for run, one in mine.items()] * times
    lineup += [Entrant("shipped", load_policy(one, env).strategy) for one in shipped]
    results = run_side_by_side(make_env, draw_humans(env), lineup)
    curves = [torch.stack([one.alignment for one in results[run]]).mean((0, 1)) for run in mine]
    beside = [one.alignment.mean(0) for one in results["shipped"]]
    return [[[float(c[-1]), float(c[1:].mean())] for c in group] for group in (curves, beside)]


def row_of(cell: Cell, mine: Tensor, shipped: Tensor) -> common.Row:
    """One line of the table, from alignments (P S 2) of the runs and of the package's policies."""
    apart = mine - shipped.mean(1, keepdim=True)
    row: common.Row = {"cell": title_of(cell.task), "runs": mine.shape[1]}
    for number, what in enumerate(("last", "mean of 1 to H")):
        interval = bootstrap_interval(apart[..., number])
        row[what] = f"{mine[..., number].mean():.4f}"
        row[f"minus the package's, {what}"] = signed(float(apart[..., number].mean()), interval)
        if number == 0:
            row["good enough"] = "yes" if interval[0] >= -MARGIN else "no"
    return row


if __name__ == "__main__":
    main()
