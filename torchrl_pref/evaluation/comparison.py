"""Learned policies beside random and greedy: the rows of the tables, the panels of Figure 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.build import Settings, Task, load_policy, make_feed_env, make_query_env
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.memory import check_memory
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError, check_count, check_flag, check_seed
from torchrl_pref.evaluation.run import Evaluation, draw_humans, evaluate
from torchrl_pref.policies.base import Policy
from torchrl_pref.pool import QueryPool
from torchrl_pref.strategies import Greedy, QuantileAsk, RandomAsk, RandomQuery

FIRST_EVALUATION_SEED = 2**31
"""Evaluation seeds lie where no training seed does: the humans of the one are not the other's."""

Panels = dict[str, dict[str, Evaluation]]


def label_of(settings: Settings) -> str:
    """The name of a learned policy in tables and figures: the paper's ``RL`` and ``RL-feed``."""
    return "RL-feed" if settings["setup"]["name"] == "feed" else "RL"


def evaluate_panels(
    settings: Settings, task: Task, learned: Mapping[str, Checkpoint], test: QueryPool | None = None
) -> Panels:
    """Compare strategies on the held-out pool.

    The paper's query policy picks an index of its training pool, which means nothing on another
    pool. It is evaluated on the held-out pool all the same, and on its own pool in a second panel.

    Args:
        settings: of the evaluation, or of the training that it ends.
        task: the pools and the response model.
        learned: checkpoints to evaluate, by the name to show.
        test: another held-out pool, normalised; by default the task's.

    Returns:
        By title: by name of the strategy, what it did.
    """
    held_out = task.test if test is None else test
    evaluated = {key: value for key, value in settings.items() if key != "training"}
    check_memory(evaluated, *held_out.features.shape)
    if not any(checkpoint.picks_by_index for checkpoint in learned.values()):
        return {task.title: compare(settings, task, held_out, learned)}
    return {
        f"{task.title}, held-out pool": compare(settings, task, held_out, learned),
        f"{task.title}, training pool": compare(settings, task, task.train, learned),
    }


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
    settings: Settings, task: Task, pool: QueryPool, learned: Mapping[str, Checkpoint]
) -> dict[str, Evaluation]:
    """Baselines and learned policies on the same humans and luck.

    Random and greedy choose from the whole pool, as in the paper's Figure 1, whatever the setup.

    Args:
        settings: the sections ``setup``, ``belief``, ``evaluation`` and ``device``.
        task: gives the response model.
        pool: the queries, normalised.
        learned: checkpoints to evaluate, by the name to show.

    Returns:
        By name: ``random``, ``greedy`` (information gain), ``greedy alignment``, for a feed also
        ``ask all`` and ``quantile`` (of alignment), and the learned ones.
    """
    n_humans, seed = check_evaluation(settings)
    humans = draw_humans(make_query_env(settings, task, pool, n_humans, seed))
    runs: list[tuple[str, QueryEnv | FeedEnv, TensorDictModuleBase, bool]] = []

    query_env = make_query_env(settings, task, pool, n_humans, seed)
    runs.append(("random", query_env, RandomQuery(seed + 1), False))
    runs.append(("greedy", query_env, Greedy(task.response_model), False))
    by_alignment = Greedy(task.response_model, alignment_gain)
    runs.append(("greedy alignment", query_env, by_alignment, False))
    if settings["setup"]["name"] == "feed":
        feed_env = make_feed_env(settings, task, pool, n_humans, seed)
        runs.append(("ask all", feed_env, RandomAsk(), False))
        runs.append(("quantile", feed_env, QuantileAsk(feed_env, alignment_gain), False))
    for name, checkpoint in learned.items():
        env, policy = _load_policy(checkpoint, task, pool, n_humans, seed)
        sample = check_flag("policy.sample", checkpoint.settings["policy"]["sample"])
        runs.append((name, env, policy.strategy, sample))

    results = {}
    for name, env, strategy, sample in tqdm(runs, desc="evaluation", unit="strategy"):
        env.set_seed(seed)
        torch.manual_seed(seed)
        results[name] = evaluate(env, strategy, humans, sample)
    return results


def _load_policy(
    checkpoint: Checkpoint, task: Task, pool: QueryPool, n_humans: int, seed: int
) -> tuple[QueryEnv | FeedEnv, Policy]:
    """A trained policy and the environment of its own setup on a pool."""
    checkpoint.check_fits(pool)
    settings = checkpoint.settings
    make = make_feed_env if settings["setup"]["name"] == "feed" else make_query_env
    env = make(settings, task, pool, n_humans, seed)
    return env, load_policy(checkpoint, env)


def _feed_of(checkpoint: Checkpoint) -> tuple[Any, Any] | None:
    """What is particular to the feed a policy was trained on, or None."""
    setup = checkpoint.settings["setup"]
    return (setup["offers"], setup["on_skip"]) if setup["name"] == "feed" else None


def _skip_of(checkpoint: Checkpoint) -> str | None:
    """What a skip costs in a run's feed; None for a run that asks queries."""
    settings = checkpoint.settings
    return str(settings["skip"]) if settings["setup"]["name"] == "feed" else None


def group_checkpoints(
    runs: Sequence[tuple[str, Checkpoint, Task]],
) -> list[tuple[Settings, Task, dict[str, Checkpoint]]]:
    """Put runs that faced the same kind of human on the same pools into one panel.

    Args:
        runs: name, checkpoint and task of each run.

    Returns:
        For each panel its settings, its task and its checkpoints by the name to show.

    Raises:
        InputError: runs of one panel were trained with other pools, budgets or beliefs, so that
            they cannot be compared on the same humans.
    """
    groups: dict[str, list[tuple[str, Checkpoint, Task]]] = {}
    for run in runs:
        groups.setdefault(run[2].title, []).append(run)
    panels = []
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
                ("question", *(c.settings["question"] for c in (checkpoint, first))),
                ("skip", _skip_of(checkpoint), next(filter(None, map(_skip_of, all_of)), None)),
                ("feed", _feed_of(checkpoint), next(filter(None, map(_feed_of, all_of)), None)),
            ):
                if mine is not None and mine != theirs:
                    raise InputError(
                        f"{name} and {members[0][0]} differ in {what}: {mine} and {theirs}; "
                        "evaluate them one at a time"
                    )
            label = label_of(checkpoint.settings)
            same = sum(label_of(other.settings) == label for _, other, _ in members)
            learned[label if same == 1 else f"{label} ({name})"] = checkpoint
        # Baselines choose as the query runs may; a feed among them adds its offers.
        settings = dict(first.settings)
        feed_last = sorted(all_of, key=lambda c: bool(c.settings["setup"]["name"] == "feed"))
        settings["setup"] = {k: v for c in feed_last for k, v in c.settings["setup"].items()}
        settings["skip"] = feed_last[-1].settings["skip"]
        panels.append((settings, task, learned))
    return panels
