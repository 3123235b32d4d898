"""The held-out protocol: learned policies beside strong baselines on pools that no training saw.

Shapes: P test pools, S training seeds, B humans, H query budget.

Every strategy of a pool faces the same humans, the same luck in their answers and, in the feed, the
same offers, so that all differences are paired. Intervals are bootstrapped over pools and training
seeds: humans of one pool share it, and policies of one training share that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from tqdm import tqdm

from torchrl_pref.acquisition.functions import alignment_gain, information_gain, volume_removal
from torchrl_pref.build import (
    Settings,
    Task,
    draw_pool,
    load_policy,
    make_feed_env,
    make_pools,
    make_query_env,
    make_task,
)
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.compiled import share_out
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import FIRST_EVALUATION_SEED
from torchrl_pref.evaluation.run import Evaluation, draw_humans, evaluate
from torchrl_pref.pool import QueryPool, balance
from torchrl_pref.strategies import (
    Greedy,
    Lookahead,
    QuantileAsk,
    RandomAsk,
    RandomQuery,
    ThresholdAsk,
)

POOLS, BALANCED_POOLS, HUMANS = 10, 3, 100

FIRST_SEED = FIRST_EVALUATION_SEED + 30_000
"""Of the pools and humans, out of reach of any training. The pools of the three bases below were
looked at while the feed's policy was designed, and are no longer used."""

FINE_SAMPLES, FINE_HUMANS = 4000, 5
"""Greedy with 40 times the samples is 40 times the work: it faces a few humans of each pool."""

RUNS = 3
"""Of each rival, on the same humans: one run tells its alignment to no better than .005. Where the
features are balanced there is one run: nobody is held to .005 there."""

RIVALS = ("greedy", "threshold", "quantile of information", "quantile of alignment")
"""How the names of the strategies begin that policies are held against."""

THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
"""Bits; the best on the training pool is the fixed threshold of the feed."""

FIT_HUMANS = 400
"""Thresholds differ little: 100 humans would not tell the best from the next."""


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
    """What a strategy did on P pools, with S policies of different training seeds, or in S runs.

    Attributes:
        alignment: (P S B H+1).
        bits, repeated: (P S), means over humans after the last query.
        seconds: (P S), to choose a query.
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
    thresholds: Sequence[float] = ()


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
            _check_fits(settings, cell, checkpoint, checkpoints[0])
        # The state of the training is of no use to a worker.
        checkpoints = [replace(checkpoint, training={}) for checkpoint in checkpoints]
        own = {**settings, "skip": checkpoints[0].settings["skip"]}
        jobs += [Job(own, cell, pool, checkpoints) for pool in range(POOLS)]
        if cell.setup == "query":
            cell = cell._replace(features="balanced")
            jobs += [Job(own, cell, pool, checkpoints) for pool in range(BALANCED_POOLS)]
    # One file descriptor for each tensor that is passed would be too many for some systems.
    torch.multiprocessing.set_sharing_strategy("file_system")
    context = get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker) as executor:
        feeds = {job.cell: job for job in jobs if job.cell.setup == "feed" and job.pool == 0}
        fits = [replace(job, learned=(), thresholds=THRESHOLDS) for job in feeds.values()]
        alignments = executor.map(_fit_threshold, fits)
        best = {
            cell: (THRESHOLDS[int(alignment.argmax())],)
            for cell, alignment in zip(feeds, alignments, strict=True)
        }
        jobs = [replace(job, thresholds=best.get(job.cell, ())) for job in jobs]
        rows = tqdm(executor.map(_run_pool, jobs), total=len(jobs), desc="pools", unit="pool")
        done: dict[Cell, list[dict[str, list[Evaluation]]]] = {}
        for job, row in zip(jobs, rows, strict=True):
            done.setdefault(job.cell, []).append(row)
    return {cell: _gather(pools) for cell, pools in done.items()}


def _start_worker() -> None:
    """One thread for each worker, and tensors passed as files."""
    torch.set_num_threads(1)
    share_out(1)
    torch.multiprocessing.set_sharing_strategy("file_system")


def _check_fits(settings: Settings, cell: Cell, checkpoint: Checkpoint, first: Checkpoint) -> None:
    """Refuse a policy that cannot be run on other pools, or is no training seed of the first."""
    for key in SAME:
        mine, theirs = checkpoint.settings[key], first.settings[key]
        if mine != theirs:
            raise InputError(
                f"protocol=heldout: policies of a {cell.setup} cell differ in {key}: {mine} and "
                f"{theirs}; expected trainings that differ in seed alone; give one kind at a time"
            )
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
    # A pool takes two seeds.
    test = draw_pool(settings, FIRST_SEED + 2 * job.pool)
    if job.cell.features == "balanced":
        train, test = (each.map_features(balance(train.features)) for each in (train, test))
    task = make_task(train, test, job.cell.tau, settings)
    return task, task.test


class Chorus(TensorDictModuleBase):
    """Strategies side by side in one environment: each decides for its own share of the sessions.

    One large batch is much faster than a small one for each strategy.

    Attributes:
        seconds: spent by each strategy on its decisions.
    """

    in_keys: list[str] = []
    out_keys = ["action"]

    def __init__(self, strategies: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        self.strategies = nn.ModuleList(strategies)
        self.seconds = [0.0] * len(strategies)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        actions = []
        shares = tensordict.chunk(len(self.strategies))
        for number, (strategy, share) in enumerate(zip(self.strategies, shares, strict=True)):
            start = time.perf_counter()
            actions.append(strategy(share)["action"])
            self.seconds[number] += time.perf_counter() - start
        return tensordict.set("action", torch.cat(actions))


SAME = (
    *("policy", "objective", "skip", "setup", "belief", "training", "human", "question", "pool"),
)
"""What the trainings of one row have in common."""

MakeEnv = Callable[[int], QueryEnv | FeedEnv]
"""From a number of sessions to an environment for as many."""

LineUp = Sequence[tuple[str, TensorDictModuleBase]]
"""Strategies by name; a name that comes again is another run, or another training seed."""


def run_side_by_side(
    make_env: MakeEnv, humans: TensorDictBase, lineup: LineUp
) -> dict[str, list[Evaluation]]:
    """Every strategy with the same humans (B), in one batch; a list holds the runs of a name.

    ``seconds_per_query`` is the time to choose alone: the belief is updated for all together.
    """
    count, chorus = len(humans), Chorus([strategy for _, strategy in lineup])
    env = make_env(count * len(lineup))
    whole = evaluate(env, chorus, torch.cat([humans] * len(lineup)))
    results: dict[str, list[Evaluation]] = {}
    for number, (name, _) in enumerate(lineup):
        rows = slice(number * count, (number + 1) * count)
        own = {key: value[rows] for key, value in vars(whole).items() if isinstance(value, Tensor)}
        seconds = chorus.seconds[number] / max(1, int(own["asked"].sum()))
        results.setdefault(name, []).append(replace(whole, **own, seconds_per_query=seconds))
    return results


def _run_pool(job: Job) -> dict[str, list[Evaluation]]:
    """Every strategy of a cell on one pool; a list holds one evaluation for each training seed of
    the policies, and for each run of a baseline."""
    task, pool = _task_and_pool(job)
    # A seed of its own for each pool.
    seed = FIRST_SEED + 1000 + job.pool
    make = make_feed_env if job.cell.setup == "feed" else make_query_env

    def make_env(sessions: int, settings: Settings = job.settings) -> QueryEnv | FeedEnv:
        return make(settings, task, pool, sessions, seed)

    env = make_env(HUMANS)
    humans = draw_humans(env)
    lineup = list(_baselines(job, task, env, seed).items())
    for _ in range(1, RUNS if job.cell.features == "corners" else 1):
        again = _baselines(job, task, env, seed).items()
        lineup += [(name, strategy) for name, strategy in again if name.startswith(RIVALS)]
    lineup += [("RL", load_policy(one, env).strategy) for one in job.learned]
    results = run_side_by_side(make_env, humans, lineup)
    learned = results.pop("RL")  # their row is the last
    if job.cell.setup == "query" and job.cell.features == "corners":
        greedy = Greedy(task.response_model)
        setup = {**job.settings["setup"], "repeats": False}
        unrepeated = partial(make_env, settings={**job.settings, "setup": setup})
        name = "greedy information, no repeats"
        results |= run_side_by_side(unrepeated, humans, [(name, greedy)])
        belief = {**job.settings["belief"], "samples": FINE_SAMPLES}
        fine = partial(make_env, settings={**job.settings, "belief": belief})
        name = f"greedy information, M={FINE_SAMPLES} ({FINE_HUMANS} humans a pool)"
        few = humans[:FINE_HUMANS].select("human")
        results |= run_side_by_side(fine, few, [(name, greedy)])
    return results | {"RL": learned}


def _baselines(
    job: Job, task: Task, env: QueryEnv | FeedEnv, seed: int
) -> dict[str, TensorDictModuleBase]:
    """The strategies that are not learned, by name."""
    model = task.response_model
    if is_feed(env):
        return {
            "ask all": RandomAsk(),
            f"threshold {job.thresholds[0]:g} bits": ThresholdAsk(env, job.thresholds[0]),
            "quantile of information": QuantileAsk(env),
            "quantile of alignment": QuantileAsk(env, alignment_gain),
            "quantile, information then alignment": QuantileAsk(
                env, information_gain, late=alignment_gain
            ),
        }
    strategies: dict[str, TensorDictModuleBase] = {
        "random": RandomQuery(seed + 1),
        "greedy information": Greedy(model),
        "greedy alignment": Greedy(model, alignment_gain),
    }
    if job.cell.features == "corners":
        strategies["volume removal"] = Greedy(model, volume_removal)
        strategies["two-step lookahead"] = Lookahead(model)
    return strategies


def _fit_threshold(job: Job) -> Tensor:
    """Final alignment of each threshold on the training pool, (thresholds)."""
    task, _ = _task_and_pool(job)

    def make_env(sessions: int) -> FeedEnv:
        return make_feed_env(job.settings, task, task.train, sessions, 0)

    env = make_env(FIT_HUMANS)
    rules = [(f"{bits:g}", ThresholdAsk(env, bits)) for bits in job.thresholds]
    results = run_side_by_side(make_env, draw_humans(env), rules)
    return torch.stack([result.alignment[:, -1].mean() for (result,) in results.values()])


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
