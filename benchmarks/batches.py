"""Alignment after each batch of questions, and the seconds that choosing one takes.

``python benchmarks/batches.py [--tasks driver,lds] [--batch 10] [--budget 40] [--queries 1000]``:
noisy humans answer batches that each strategy chose, on pools of their own, and beside them the
same number of questions chosen one at a time (greedy information gain) and batches at random. All
strategies face the same humans with the same luck. Intervals are over pools: mean ± half the width
of the 95% interval that is bootstrapped from the mean of each. The last differences are paired by
pool, each to the row above: whether the order of the literature holds. Seconds are CPU time to
choose, of one batch for one human.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import time
from collections.abc import Iterator
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.build import make_pools, make_query_env, make_task
from torchrl_pref.evaluation.comparison import FIRST_EVALUATION_SEED
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.problem import Problem
from torchrl_pref.strategies import BATCH_STRATEGIES, Greedy

ONE_BY_ONE = "one at a time"

ORDER = ("random", "top", "medoids", "boundary_medoids", "successive_elimination", "dpp", "joint")
"""As the literature ranks them; each is held against the one before."""


class Timed(TensorDictModuleBase):
    """A strategy, and the CPU seconds that it takes."""

    in_keys: list[str] = []
    out_keys = ["action"]

    def __init__(self, strategy: TensorDictModuleBase) -> None:
        super().__init__()
        self.strategy, self.seconds = strategy, 0.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Let it choose."""
        start = time.process_time()
        chosen = self.strategy(tensordict)
        self.seconds += time.process_time() - start
        return chosen


def main() -> None:
    """Print a table for each task."""
    parser = common.arguments(__doc__)
    parser.add_argument("--tasks", default="driver,lds", help="of the package, by commas")
    parser.add_argument("--batch", type=int, default=10, help="n (default 10)")
    parser.add_argument("--budget", type=int, default=40, help="H (default 40)")
    parser.add_argument("--queries", type=int, default=1000, help="N of a pool (default 1000)")
    parser.add_argument("--pools", type=int, default=10, help="of each task (default 10)")
    parser.add_argument("--humans", type=int, default=50, help="of each pool (default 50)")
    options = common.start(parser)
    rows: list[common.Row] = []
    for task in options.tasks.split(","):
        results = list(tqdm(_pools(task, options), total=options.pools, desc=task))
        rows += _rows(task, results, options.batch, options.budget)
    title = (
        f"Alignment after batches of {options.batch}, N={options.queries}, noisy, "
        f"{options.pools} pools of {options.humans} humans"
    )
    common.report(title, rows, options.json)


Result = dict[str, tuple[Tensor, float]]
"""On one pool, by strategy: alignment after each answer (H+1), and seconds to choose a batch for
one human."""


def _pools(task: str, options: Any) -> Iterator[Result]:
    """What every strategy does, pool by pool."""
    settings = settings_of(task, options)
    for number in range(options.pools):
        seed = FIRST_EVALUATION_SEED + 60_000 + 2 * number
        problem = make_task(*make_pools(settings, seed), settings["tau"], settings)
        yield _on_pool(settings, problem, options.humans, seed)


def settings_of(task: str, options: Any) -> dict[str, Any]:
    """What ``evaluate.py`` would be given."""
    typed = [f"task={task}", "setup=query", "tau=noisy", f"pool.size={options.queries}"]
    typed += [f"setup.budget={options.budget}", f"setup.batch={options.batch}"]
    with initialize_config_dir(str(Path(sys.path[0]) / "conf"), version_base="1.3"):
        settings = OmegaConf.to_container(compose("evaluate", typed))
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def _on_pool(settings: dict[str, Any], problem: Problem, humans: int, seed: int) -> Result:
    """Every strategy on one pool, with the same humans."""
    alone = {**settings, "setup": {**settings["setup"], "batch": 1}}
    make = {True: settings, False: alone}
    envs = {
        several: make_query_env(of, problem, problem.test, humans, seed)  # type: ignore[arg-type]
        for several, of in make.items()
    }
    drawn, found = draw_humans(envs[False]), {}
    strategies = {name: BATCH_STRATEGIES[name](envs[True]) for name in ORDER}
    for name, strategy in {ONE_BY_ONE: Greedy(problem.response_model), **strategies}.items():
        env, timed = envs[name != ONE_BY_ONE], Timed(strategy)
        env.set_seed(seed)
        result = evaluate(env, timed, drawn)
        batches = settings["setup"]["budget"] // settings["setup"]["batch"]
        found[name] = result.alignment.mean(0), timed.seconds / humans / batches
    return found


def _rows(task: str, results: list[Result], batch: int, budget: int) -> Iterator[common.Row]:
    """A row for each strategy, and how far it is ahead of the one before."""
    before: Tensor | None = None
    for name in results[0]:
        curves = torch.stack([result[name][0] for result in results])  # (pools H+1)
        row: common.Row = {"task": task, "strategy": name}
        for asked in range(batch, budget + 1, batch):
            row[f"after {asked}"] = _interval(curves[:, asked])
        told = torch.arange(batch, budget + 1, batch)
        level = curves[:, told].mean(1)
        ahead = None if before is None or name == "random" else level - before
        row["mean, minus the row above"] = "" if ahead is None else _interval(ahead, "+")
        seconds = sum(result[name][1] for result in results) / len(results)
        row["s a batch"] = f"{seconds:.4f}"
        before = level
        yield row


def _interval(values: Tensor, sign: str = "") -> str:
    """The mean of pools (P), and half of its 95% interval."""
    low, high = bootstrap_interval(values)
    return f"{values.mean():{sign}.3f} ± {(high - low) / 2:.3f}"


if __name__ == "__main__":
    main()
