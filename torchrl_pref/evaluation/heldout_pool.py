"""What the held-out protocol does on one pool.

Shapes: B humans.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import NamedTuple, cast

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pref.acquisition.functions import alignment_gain, information_gain, volume_removal
from torchrl_pref.build import (
    load_policy,
    make_feed_env,
    make_pools,
    make_query_env,
    make_task,
)
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.evaluation.comparison import FIRST_EVALUATION_SEED
from torchrl_pref.evaluation.metrics import make_exam
from torchrl_pref.evaluation.own import find_makers, make_own, of_this_setup
from torchrl_pref.evaluation.records import Entry, entry_of
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.side_by_side import Entrant, run_side_by_side
from torchrl_pref.evaluation.style import kind_of
from torchrl_pref.pool import QueryPool, balance
from torchrl_pref.problem import Problem
from torchrl_pref.strategies import (
    Greedy,
    Lookahead,
    QuantileAsk,
    RandomAsk,
    RandomQuery,
    ThresholdAsk,
)
from torchrl_pref.strategies.lookahead import MOST_FOLLOWED

HUMANS = 100

FIRST_SEED = FIRST_EVALUATION_SEED + 30_000
"""Of the pools and humans, out of reach of any training. The pools of the three bases below were
looked at while the feed's policy was designed, and are no longer used."""

FINE_SAMPLES, FINE_HUMANS = 4000, 5
"""Greedy with 40 times the samples is 40 times the work: it faces a few humans of each pool."""

RUNS, RUNS_ON_OTHER_TASKS, RUNS_IF_BALANCED = 3, 2, 1
"""Of each strong baseline, on the same humans: one run tells its alignment to no better than .005.
Where the features are balanced nobody is held to .005."""

CLOSELY = ("corners", "own")
"""Features on which all that is known is tried, and not the rules alone that matter."""

REPEATED = (
    "greedy_information",
    "greedy_alignment",
    "threshold",
    "quantile_information",
    "quantile_alignment",
)
"""The strong baselines."""

THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5)
"""Bits; the best on the training pool is the fixed threshold of the feed."""

FIT_HUMANS = 400
"""Thresholds differ little: 100 humans would not tell the best from the next."""


class Cell(NamedTuple):
    """``query`` or ``feed``, the human's tau, and the features: ``corners`` or ``balanced`` of the
    Gridworld, the name of another task, or those of the user's ``own`` pool."""

    setup: str
    tau: str | float
    features: str = "corners"

    @property
    def task(self) -> str:
        """As records name it."""
        tau = self.tau if isinstance(self.tau, str) else f"{self.tau:g}"
        return f"{self.setup}/{tau}/{self.features}"


@dataclass(frozen=True)
class Job:
    """One pool of one cell, to be run by a worker process.

    Attributes:
        settings: the sections ``task``, ``pool``, ``belief``, ``setup`` and ``device``.
        cell, pool: which; ``pool`` is a number.
        learned: the policies of each kind by key, one for each training seed.
        thresholds: in bits, of the feed's threshold rules, where these are tried.
        own: strategies of the user, as typed.
    """

    settings: Settings
    cell: Cell
    pool: int
    learned: Mapping[str, Sequence[Checkpoint]] = field(default_factory=dict)
    thresholds: Sequence[float] = ()
    own: Sequence[str] = ()


def task_and_pool(job: Job) -> tuple[Problem, QueryPool]:
    """The task, with tau solved on the training pool, and the job's own test pool."""
    settings = job.settings
    sections = {"task": settings["task"], "pool": settings["pool"]}
    train, test = pools_of(json.dumps(sections), job.pool)
    if job.cell.features == "balanced":
        train, test = (each.map_features(balance(train.features)) for each in (train, test))
    task = make_task(train, test, job.cell.tau, settings)
    return task, task.test


@lru_cache(maxsize=1)
def pools_of(sections: str, number: int) -> tuple[QueryPool, QueryPool]:
    """Training and test pool of a number, by settings as JSON: kept until the next, as the cells of
    a pool follow one another and a simulator is slow."""
    # A pool takes two seeds.
    return make_pools(cast(Settings, json.loads(sections)), FIRST_SEED + 2 * number)


def run_pool(job: Job) -> list[Entry]:
    """Every strategy of a cell on one pool; policies have an entry for each training seed, strong
    baselines one for each run."""
    task, pool = task_and_pool(job)
    # A seed of its own for each pool.
    seed = FIRST_SEED + 1000 + job.pool
    make_env = partial(_make_env, job, task, pool, seed)
    env = make_env(HUMANS)
    humans = draw_humans(env)
    baselines = _lineup(job, task, env, seed)
    judged = _judged(job, env, seed, [entrant.key for entrant in baselines])
    lineup = [*baselines, *judged]
    torch.manual_seed(seed)  # of policies that draw their actions
    exam = make_exam(job.settings, task, pool)
    results = run_side_by_side(make_env, humans, lineup, exam)
    if job.cell.setup == "query" and job.cell.features in CLOSELY:
        greedy = Greedy(task.response_model)
        if len(pool) >= env.budget:
            setup = {**job.settings["setup"], "repeats": False}
            unrepeated = partial(make_env, settings={**job.settings, "setup": setup})
            key = "greedy_no_repeats"
            results |= run_side_by_side(unrepeated, humans, [Entrant(key, greedy)], exam)
        belief = {**job.settings["belief"], "samples": FINE_SAMPLES}
        fine = partial(make_env, settings={**job.settings, "belief": belief})
        key = f"greedy_many_samples:M={FINE_SAMPLES}"
        few = humans[:FINE_HUMANS].select("human")
        # A calibration error is the larger, the fewer the humans: theirs would say nothing.
        of_few = exam and exam.without("calibration")
        results |= run_side_by_side(fine, few, [Entrant(key, greedy)], of_few)
    last = dict.fromkeys(entrant.key for entrant in judged)  # their rows come last
    entries = []
    for key in [*(key for key in results if key not in last), *last]:
        seeds = [one.settings["seed"] for one in job.learned.get(key, ())]
        for number, result in enumerate(results[key]):
            entries.append(
                entry_of(
                    *(result, ("alignment",), "seconds_to_choose"),
                    protocol="heldout",
                    task=job.cell.task,
                    pool=str(job.pool),
                    seed=seeds[number] if seeds else number,
                    strategy=key,
                )
            )
    return entries


def _make_env(
    job: Job,
    task: Problem,
    pool: QueryPool,
    seed: int,
    sessions: int,
    settings: Settings | None = None,
) -> QueryEnv | FeedEnv:
    """The environment of a job; with other settings where they are given."""
    make = make_feed_env if job.cell.setup == "feed" else make_query_env
    return make(settings or job.settings, task, pool, sessions, seed)


def try_job(job: Job) -> tuple[str, ...]:
    """Refuse policies that do not fit a job's pool, and strategies of the user that cannot decide.

    Returns:
        Those of the user's strategies that are not for the other setup alone.

    Raises:
        InputError: there is one.
    """
    task, pool = task_and_pool(job)
    env = _make_env(job, task, pool, 0, 2)
    for one in (one for checkpoints in job.learned.values() for one in checkpoints):
        load_policy(one, env)
    return of_this_setup(find_makers(job.own, job.settings), env)


def _judged(job: Job, env: QueryEnv | FeedEnv, seed: int, beside: Sequence[str]) -> list[Entrant]:
    """The policies, and the strategies of the user that are no baselines beside them."""
    policies = [
        Entrant(key, load_policy(one, env).strategy, one.settings["policy"]["sample"])
        for key, checkpoints in job.learned.items()
        for one in checkpoints
    ]
    return [*policies, *make_own(find_makers(job.own, job.settings), env, seed, beside)]


def _lineup(job: Job, task: Problem, env: QueryEnv | FeedEnv, seed: int) -> list[Entrant]:
    """The baselines, and the strong ones again."""
    lineup = [Entrant(*each) for each in _baselines(job, task, env, seed).items()]
    for _ in range(1, _runs(job.cell.features)):
        again = _baselines(job, task, env, seed).items()
        lineup += [Entrant(*each) for each in again if kind_of(each[0]) in REPEATED]
    return lineup


def _runs(features: str) -> int:
    """Of each strong baseline."""
    if features == "balanced":
        return RUNS_IF_BALANCED
    return RUNS if features in CLOSELY else RUNS_ON_OTHER_TASKS


def _baselines(
    job: Job, task: Problem, env: QueryEnv | FeedEnv, seed: int
) -> dict[str, TensorDictModuleBase]:
    """The strategies that are not learned, by key."""
    model = task.response_model
    if is_feed(env):
        rules: dict[str, TensorDictModuleBase] = {
            "ask_all": RandomAsk(),
            "quantile_information": QuantileAsk(env),
            "quantile_alignment": QuantileAsk(env, alignment_gain),
        }
        for bits in job.thresholds:
            rules[f"threshold:{bits:g}"] = ThresholdAsk(env, bits)
        if job.cell.features in CLOSELY:
            rules["quantile_both"] = QuantileAsk(env, information_gain, late=alignment_gain)
        return rules
    strategies: dict[str, TensorDictModuleBase] = {
        "random": RandomQuery(seed + 1),
        "greedy_information": Greedy(model),
        "greedy_alignment": Greedy(model, alignment_gain),
    }
    if job.cell.features != "balanced":
        strategies["volume_removal"] = Greedy(model, volume_removal)
    if job.cell.features in CLOSELY and env.n_answers**2 <= MOST_FOLLOWED:
        strategies["lookahead"] = Lookahead(model)
    return strategies


def fit_threshold(job: Job) -> Tensor:
    """Final alignment of each threshold on the training pool, (thresholds)."""
    task, _ = task_and_pool(job)

    def make_env(sessions: int) -> FeedEnv:
        return make_feed_env(job.settings, task, task.train, sessions, 0)

    env = make_env(FIT_HUMANS)
    rules = [Entrant(f"threshold:{bits:g}", ThresholdAsk(env, bits)) for bits in job.thresholds]
    results = run_side_by_side(make_env, draw_humans(env), rules)
    return torch.stack([result.alignment[:, -1].mean() for (result,) in results.values()])
