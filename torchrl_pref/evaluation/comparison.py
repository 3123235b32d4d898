"""Learned policies beside random and greedy on the same humans: a task for each kind of human."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from tqdm import tqdm

from torchrl_pref.acquisition.batch import BATCHES, OF_PAIRS
from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.build import load_policy, make_feed_env, make_query_env
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.memory import check_memory
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError, check_count, check_flag, check_seed
from torchrl_pref.evaluation.metrics import make_exam
from torchrl_pref.evaluation.own import Maker, make_own, try_own
from torchrl_pref.evaluation.records import COMPARISON, Records, entry_of
from torchrl_pref.evaluation.run import CURVES, Evaluation, draw_humans, evaluate
from torchrl_pref.evaluation.side_by_side import Entrant
from torchrl_pref.policies.base import Policy
from torchrl_pref.pool import QueryPool
from torchrl_pref.problem import Problem
from torchrl_pref.strategies import BATCH_STRATEGIES, Greedy, QuantileAsk, RandomAsk, RandomQuery

FIRST_EVALUATION_SEED = 2**31
"""Evaluation seeds lie where no training seed does: the humans of the one are not the other's."""

HELD_OUT, TRAINING = "held-out", "training"
"""The pools, as records name them."""


def policy_key(settings: Settings) -> str:
    """The kind of a learned policy, by its setup: the paper's ``RL`` or ``RL-feed``."""
    return "policy_feed" if settings["setup"]["name"] == "feed" else "policy_query"


def evaluate_task(
    settings: Settings,
    task: Problem,
    learned: Mapping[str, Checkpoint],
    test: QueryPool | None = None,
    own: Mapping[str, Maker] | None = None,
    protocol: str = COMPARISON,
    title: str | None = None,
) -> Records:
    """Compare strategies on the held-out pool.

    The paper's query policy picks an index of its training pool, which means nothing on another
    pool. It is evaluated on the held-out pool all the same, and as a task of its own on the pool
    that it knows.

    Args:
        settings: of the evaluation, or of the training that it ends.
        task: the pools and the response model.
        learned: checkpoints to evaluate, by key.
        test: another held-out pool, normalised; by default the task's.
        own: what makes the strategies of the user.
        protocol, title: of the records; by default the task's title.
    """
    pools = {HELD_OUT: task.test if test is None else test}
    evaluated = {key: value for key, value in settings.items() if key != "training"}
    check_memory(cast(Settings, evaluated), *pools[HELD_OUT].features.shape)
    if any(checkpoint.picks_by_index for checkpoint in learned.values()):
        pools[TRAINING] = task.train
    records = Records()
    for name, pool in pools.items():
        named = task.title if title is None else title
        named = named if len(pools) == 1 else f"{named}, {name} pool"
        for key, result in compare(settings, task, pool, learned, own).items():
            seed = learned[key].settings["seed"] if key in learned else 0
            identity = {"protocol": protocol, "task": named, "pool": name}
            identity["strategy"] = key
            entry = entry_of(result, CURVES, "seconds_per_query", **identity, seed=seed)
            records.entries.append(entry)
    return records


def check_evaluation(settings: Settings) -> tuple[int, int]:
    """How many humans, and their seed; call it before a training whose result they will judge.

    Raises:
        InputError: they are too few, or the seed or the evaluations during training are out of
            range.
    """
    section = settings["evaluation"]
    check_count("evaluation.during", section.get("during", 0), 0)
    n_humans = check_count("evaluation.humans", section["humans"], 2)
    return n_humans, FIRST_EVALUATION_SEED + check_seed("evaluation.seed", section["seed"])


def compare(
    settings: Settings,
    task: Problem,
    pool: QueryPool,
    learned: Mapping[str, Checkpoint],
    own: Mapping[str, Maker] | None = None,
) -> dict[str, Evaluation]:
    """Baselines and learned policies on the same humans and luck.

    Random and greedy choose from the whole pool, as in the paper's Figure 1, whatever the setup.
    Where several queries are asked at once, what chooses batches takes the place of greedy.

    Args:
        settings: the sections ``setup``, ``belief``, ``evaluation`` and ``device``.
        task: gives the response model.
        pool: the queries, normalised.
        learned: checkpoints to evaluate, by key.
        own: what makes the strategies of the user; they are made for the setup of the settings.

    Returns:
        By key: ``random``, ``greedy_information`` and ``greedy_alignment``, or ``batch_top`` and so
        on; for a feed also ``ask_all`` and ``quantile_alignment``; the learned ones and those of
        the user.
    """
    n_humans, seed = check_evaluation(settings)
    humans = draw_humans(make_query_env(settings, task, pool, n_humans, seed))
    runs: list[tuple[QueryEnv | FeedEnv, Entrant]] = []

    query_env = make_query_env(settings, task, pool, n_humans, seed)
    runs += [(query_env, entrant) for entrant in _baselines(query_env, task, seed)]
    if settings["setup"]["name"] == "feed":
        feed_env = make_feed_env(settings, task, pool, n_humans, seed)
        runs.append((feed_env, Entrant("ask_all", RandomAsk())))
        quantile = QuantileAsk(feed_env, alignment_gain)
        runs.append((feed_env, Entrant("quantile_alignment", quantile)))
    for key, checkpoint in learned.items():
        env, policy = _load_policy(checkpoint, task, pool, n_humans, seed)
        sample = check_flag("policy.sample", checkpoint.settings["policy"]["sample"])
        runs.append((env, Entrant(key, policy.strategy, sample)))
    if own:
        env = _make_env(settings, task, pool, n_humans, seed)
        beside = [entrant.key for _, entrant in runs]
        runs += [(env, entrant) for entrant in make_own(own, env, seed, beside)]

    exam = make_exam(settings, task, pool)
    results = {}
    for env, entrant in tqdm(runs, desc="evaluation", unit="strategy"):
        env.set_seed(seed)
        torch.manual_seed(seed)
        results[entrant.key] = evaluate(env, entrant.strategy, humans, entrant.sample, exam)
    return results


def _baselines(env: QueryEnv, task: Problem, seed: int) -> list[Entrant]:
    """What chooses from the whole pool and is not learned: one query, or several at once."""
    entrants = [Entrant("random", RandomQuery(seed + 1, env.batch))]
    if env.batch > 1:
        several = env.features.shape[1] > 2
        names = [name for name in BATCHES if not (several and name in OF_PAIRS)]
        return entrants + [Entrant(f"batch_{name}", BATCH_STRATEGIES[name](env)) for name in names]
    entrants.append(Entrant("greedy_information", Greedy(task.response_model)))
    return [*entrants, Entrant("greedy_alignment", Greedy(task.response_model, alignment_gain))]


def _load_policy(
    checkpoint: Checkpoint, task: Problem, pool: QueryPool, n_humans: int, seed: int
) -> tuple[QueryEnv | FeedEnv, Policy]:
    """A trained policy and the environment of its own setup on a pool."""
    checkpoint.check_fits(pool)
    settings = checkpoint.settings
    env = _make_env(settings, task, pool, n_humans, seed)
    return env, load_policy(checkpoint, env)


def _make_env(
    settings: Settings, task: Problem, pool: QueryPool, n_humans: int, seed: int
) -> QueryEnv | FeedEnv:
    """The environment of the settings' setup, with all of a pool on the table."""
    make = make_feed_env if settings["setup"]["name"] == "feed" else make_query_env
    return make(settings, task, pool, n_humans, seed)


def try_strategies(own: Mapping[str, Maker], settings: Settings, task: Problem) -> None:
    """Refuse strategies of the user that cannot decide in a task, before anything is run.

    Raises:
        InputError: one cannot be made, fails, or writes no action.
    """
    if own:
        try_own(own, _make_env(settings, task, task.test, 2, 0))


def _feed_of(checkpoint: Checkpoint) -> tuple[Any, Any] | None:
    """What is particular to the feed a policy was trained on, or None."""
    setup = checkpoint.settings["setup"]
    return (setup["offers"], setup["on_skip"]) if setup["name"] == "feed" else None


def _skip_of(checkpoint: Checkpoint) -> str | None:
    """What a skip costs in a run's feed; None for a run that asks queries."""
    settings = checkpoint.settings
    return str(settings["skip"]) if settings["setup"]["name"] == "feed" else None


def group_checkpoints(
    runs: Sequence[tuple[str, Checkpoint, Problem]],
) -> list[tuple[Settings, Problem, dict[str, Checkpoint]]]:
    """Put runs that faced the same kind of human on the same pools together.

    Args:
        runs: name, checkpoint and task of each run.

    Returns:
        For each kind of human the settings, the task and the checkpoints by key.

    Raises:
        InputError: runs with one kind of human were trained with other pools, budgets or beliefs,
            so that they cannot be compared on the same humans.
    """
    groups: dict[str, list[tuple[str, Checkpoint, Problem]]] = {}
    for run in runs:
        # As far as tau is the same on every machine that solves for it.
        groups.setdefault(f"{run[2].tau or math.inf:.4g}", []).append(run)
    tasks = []
    for members in groups.values():
        _, first, task = members[0]
        learned = {}
        all_of = [checkpoint for _, checkpoint, _ in members]
        for name, checkpoint, _ in members:
            for what, mine, theirs in (
                ("the test pool", checkpoint.test_digest, first.test_digest),
                ("the training pool", checkpoint.train_digest, first.train_digest),
                ("budget", *(c.settings["setup"]["budget"] for c in (checkpoint, first))),
                ("belief", *(c.settings["belief"] for c in (checkpoint, first))),
                ("human", *(c.settings["human"] for c in (checkpoint, first))),
                ("demonstrations", *(c.settings["demonstrations"] for c in (checkpoint, first))),
                ("question", *(c.settings["question"] for c in (checkpoint, first))),
                ("skip", _skip_of(checkpoint), next(filter(None, map(_skip_of, all_of)), None)),
                ("feed", _feed_of(checkpoint), next(filter(None, map(_feed_of, all_of)), None)),
            ):
                if mine is not None and mine != theirs:
                    raise InputError(
                        f"{name} and {members[0][0]} differ in {what}: {mine} and {theirs}; "
                        "evaluate them one at a time"
                    )
            kind = policy_key(checkpoint.settings)
            same = sum(policy_key(other.settings) == kind for _, other, _ in members)
            learned[kind if same == 1 else f"{kind}:{name}"] = checkpoint
        # Baselines choose as the query runs may; a feed among them adds its offers.
        feed_last = sorted(all_of, key=lambda c: c.settings["setup"]["name"] == "feed")
        setup = first.settings["setup"]
        for checkpoint in feed_last:
            setup = {**setup, **checkpoint.settings["setup"]}
        settings: Settings = {
            **first.settings,
            "setup": setup,
            "skip": feed_last[-1].settings["skip"],
        }
        tasks.append((settings, task, learned))
    return tasks
