"""The held-out protocol: learned policies beside strong baselines on pools that no training saw.

Shapes: P test pools, S training seeds, B humans, H query budget.

Every strategy of a pool faces the same humans, the same luck in their answers and, in the feed, the
same offers, so that all differences are paired. Intervals are bootstrapped over pools and training
seeds: humans of one pool share it, and policies of one training share that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor
from tqdm import tqdm

from torchrl_pref.acquisition import expected_alignment, volume_removal
from torchrl_pref.checkpoint import Checkpoint
from torchrl_pref.comparison import FIRST_EVALUATION_SEED
from torchrl_pref.envs import FeedEnv, QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation import Evaluation, draw_humans, evaluate
from torchrl_pref.experiment import (
    Settings,
    Task,
    load_weights,
    make_feed_env,
    make_policy,
    make_pools,
    make_query_env,
    make_task,
)
from torchrl_pref.features import balance
from torchrl_pref.queries import QueryPool, gridworld_pool
from torchrl_pref.strategies import (
    Greedy,
    Lookahead,
    QuantileAsk,
    RandomAsk,
    RandomQuery,
    ThresholdAsk,
)

POOLS, BALANCED_POOLS, HUMANS = 10, 4, 100

FINE_SAMPLES, FINE_HUMANS = 4000, 10
"""Greedy with 40 times the samples is 40 times the work: it faces a few humans of each pool."""

THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
"""Bits; the best on the training pool is the fixed threshold of the feed."""


class Cell(NamedTuple):
    """One kind of task: ``query`` or ``feed``, the human's tau, and the feature set."""

    setup: str
    tau: str | float
    features: str = "corners"

    @property
    def title(self) -> str:
        """For tables and figures."""
        balanced = ", balanced features" if self.features == "balanced" else ""
        tau = self.tau if isinstance(self.tau, str) else f"tau={self.tau:g}"
        return f"{self.setup}, {tau} human{balanced}"


@dataclass
class Outcome:
    """What a strategy did on P pools, with S policies of different training seeds.

    Attributes:
        alignment: (P S B H+1).
        bits, repeated: (P S), means over humans after the last query.
        seconds: (P S), a query.
    """

    alignment: Tensor
    bits: Tensor
    repeated: Tensor
    seconds: Tensor


@dataclass(frozen=True)
class Job:
    """One pool of one cell, to be run by a worker process."""

    settings: Settings
    cell: Cell
    pool: int
    learned: Sequence[Checkpoint] = ()
    thresholds: Sequence[float] = field(default_factory=tuple)


Results = dict[Cell, dict[str, Outcome]]


def run_protocol(
    settings: Settings, learned: Mapping[Cell, Sequence[Checkpoint]], workers: int
) -> Results:
    """Run all cells for which there are policies.

    Args:
        settings: the sections ``grid``, ``pool``, ``belief``, ``setup`` and ``device``.
        learned: the policies of each cell, one for each training seed.
        workers: processes that run pools side by side, one CPU thread each.

    Raises:
        InputError: a policy was trained for another budget.
    """
    jobs = []
    for cell, checkpoints in learned.items():
        for checkpoint in checkpoints:
            _check_fits(settings, cell, checkpoint)
        # What a policy is made of depends on its objective; what it is judged by does not.
        own = {key: checkpoints[0].settings[key] for key in ("objective", "skip")}
        jobs += [Job({**settings, **own}, cell, pool, checkpoints) for pool in range(POOLS)]
        if cell.setup == "query":
            cell = cell._replace(features="balanced")
            pools = range(BALANCED_POOLS)
            jobs += [Job({**settings, **own}, cell, pool, checkpoints) for pool in pools]
    with ProcessPoolExecutor(workers, get_context("spawn")) as executor:
        taus = list(dict.fromkeys(cell.tau for cell in learned if cell.setup == "feed"))
        fits = [Job(settings, Cell("feed", tau), 0, (), THRESHOLDS) for tau in taus]
        best = {
            job.cell.tau: THRESHOLDS[int(alignment.argmax())]
            for job, alignment in zip(fits, executor.map(_fit_threshold, fits), strict=True)
        }
        jobs = [
            Job(job.settings, job.cell, job.pool, job.learned, (best[job.cell.tau],))
            if job.cell.setup == "feed"
            else job
            for job in jobs
        ]
        rows = tqdm(executor.map(_run_pool, jobs), total=len(jobs), desc="pools", unit="pool")
        done: dict[Cell, list[dict[str, list[Evaluation]]]] = {}
        for job, row in zip(jobs, rows, strict=True):
            done.setdefault(job.cell, []).append(row)
    return {cell: _gather(pools) for cell, pools in done.items()}


def two_way_interval(values: Tensor, resamples: int = 4000) -> tuple[float, float]:
    """Bootstrap 95% interval of the mean of values (P S) over pools and seeds, drawn apart."""
    generator = Generator().manual_seed(0)
    n_pools, n_seeds = values.shape
    pools = torch.randint(n_pools, (resamples, n_pools), generator=generator)
    seeds = torch.randint(n_seeds, (resamples, n_seeds), generator=generator)
    means = values[pools.unsqueeze(-1), seeds.unsqueeze(-2)].mean((1, 2))
    low, high = torch.quantile(means, torch.tensor([0.025, 0.975])).tolist()
    return low, high


def _check_fits(settings: Settings, cell: Cell, checkpoint: Checkpoint) -> None:
    """Refuse a policy that cannot be run on other pools, or was made for another task."""
    if checkpoint.picks_by_index:
        raise InputError(
            "protocol=heldout: policy=paper in the query setup picks indices of its training pool, "
            "which mean nothing on another; train policy=scorer or policy=attention"
        )
    found, budget = checkpoint.settings["setup"]["budget"], settings["setup"]["budget"]
    if found != budget:
        raise InputError(
            f"protocol=heldout: a {cell.setup} policy was trained for setup.budget={found} and the "
            f"protocol asks {budget} queries; set setup.budget={found}"
        )


def _task_and_pool(job: Job) -> tuple[Task, QueryPool]:
    """The task, with tau solved on the training pool, and the job's own test pool."""
    settings = job.settings
    train, _ = make_pools(settings)
    grid, pool = settings["grid"], settings["pool"]
    # No training pool has a seed this large; a pool takes two.
    seed = FIRST_EVALUATION_SEED + 2 * job.pool
    test = gridworld_pool(pool["size"], pool["options"], grid["size"], grid["length"], seed)
    if job.cell.features == "balanced":
        train, test = (each.map_features(balance(train.features)) for each in (train, test))
    task = make_task(train, test, job.cell.tau)
    return task, task.test


def _run_pool(job: Job) -> dict[str, list[Evaluation]]:
    """Every strategy of a cell on one pool; a list holds one evaluation for each training seed."""
    torch.set_num_threads(1)
    task, pool = _task_and_pool(job)
    # A seed of its own for each pool, out of reach of any training.
    seed = FIRST_EVALUATION_SEED + 1000 + job.pool
    make = make_feed_env if job.cell.setup == "feed" else make_query_env
    env = make(job.settings, task, pool, HUMANS, seed)
    humans = draw_humans(env)

    def run(
        strategy: TensorDictModuleBase, where: QueryEnv | FeedEnv = env, count: int = HUMANS
    ) -> Evaluation:
        where.set_seed(seed)
        known = humans if count == HUMANS else humans[:count].select("human")
        return evaluate(where, strategy, known)

    results = {name: [run(*case)] for name, *case in _baselines(job, task, pool, env, seed)}
    results["RL"] = []
    for checkpoint in job.learned:
        policy = make_policy(checkpoint.settings, env)
        load_weights(policy, checkpoint)
        results["RL"].append(run(policy.strategy))
    return results


def _baselines(
    job: Job, task: Task, pool: QueryPool, env: QueryEnv | FeedEnv, seed: int
) -> Iterator[tuple[Any, ...]]:
    """Name and strategy of each baseline, and where it runs if not in the cell's environment."""
    model = task.response_model
    if isinstance(env, FeedEnv):
        yield "ask all", RandomAsk()
        yield f"threshold {job.thresholds[0]:g} bits", ThresholdAsk(env, job.thresholds[0])
        yield "quantile of information", QuantileAsk(env)
        yield "quantile of alignment", QuantileAsk(env, expected_alignment)
        return
    yield "random", RandomQuery(seed + 1)
    yield "greedy information", Greedy(model)
    yield "greedy alignment", Greedy(model, expected_alignment)
    if job.cell.features == "balanced":
        return
    yield "volume removal", Greedy(model, volume_removal)
    yield "two-step lookahead", Lookahead(model)
    settings = {**job.settings, "setup": {**job.settings["setup"], "repeats": False}}
    unrepeated = make_query_env(settings, task, pool, HUMANS, seed)
    yield "greedy information, no repeats", Greedy(model), unrepeated
    belief = {**job.settings["belief"], "samples": FINE_SAMPLES}
    fine = make_query_env({**job.settings, "belief": belief}, task, pool, FINE_HUMANS, seed)
    yield f"greedy information, M={FINE_SAMPLES}", Greedy(model), fine, FINE_HUMANS


def _fit_threshold(job: Job) -> Tensor:
    """Final alignment of each threshold on the training pool, (thresholds)."""
    torch.set_num_threads(1)
    task, _ = _task_and_pool(job)
    env = make_feed_env(job.settings, task, task.train, HUMANS, 0)
    humans, finals = draw_humans(env), []
    for threshold in job.thresholds:
        env.set_seed(0)
        result = evaluate(env, ThresholdAsk(env, threshold), humans)
        finals.append(result.alignment[:, -1].mean())
    return torch.stack(finals)


def _gather(pools: Sequence[Mapping[str, Sequence[Evaluation]]]) -> dict[str, Outcome]:
    """One outcome for each strategy from the evaluations of each pool."""

    def table(name: str, read: Callable[[Evaluation], Tensor]) -> Tensor:
        return torch.stack([torch.stack([read(one) for one in pool[name]]) for pool in pools])

    return {
        name: Outcome(
            table(name, lambda one: one.alignment),
            table(name, lambda one: one.information[:, -1].mean()),
            table(name, lambda one: one.repeated.float().mean()),
            table(name, lambda one: torch.tensor(one.seconds_per_query)),
        )
        for name in pools[0]
    }
