"""From plain settings to the objects of a run: pools, response model, environment, policy.

Settings are nested dicts of plain values, as composed by Hydra or read from a checkpoint. They name
things and are never code to call, so that a foreign checkpoint can do no harm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.checkpoints.checkpoint import Checkpoint, picks_by_index
from torchrl_pref.checkpoints.restore import restore_weights
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError, check_choice, check_positive, check_seed
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.policies.attention import attention_policy
from torchrl_pref.policies.base import Policy
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.policies.scorer import scorer_policy
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.responses import Boltzmann, Optimal, ResponseModel
from torchrl_pref.tasks.gridworld import gridworld_pool

Settings = dict[str, Any]

NOISY_ACCURACY = 0.9
"""The paper's "noisy user (90%)"."""


@dataclass(frozen=True)
class Task:
    """What a policy is trained and judged on.

    Attributes:
        train, test: the pools, normalised by the training pool's statistics.
        normalizer: those statistics.
        tau: of the simulated human; None for an optimal one.
    """

    train: QueryPool
    test: QueryPool
    normalizer: Normalizer
    tau: float | None

    @property
    def title(self) -> str:
        """What kind of human this is, for tables and figures."""
        return "optimal user" if self.tau is None else f"noisy user (tau={self.tau:.4g})"

    @property
    def response_model(self) -> ResponseModel:
        """How the human answers and how the belief thinks they do."""
        return Optimal() if self.tau is None else Boltzmann(self.tau)


def make_pools(settings: Settings) -> tuple[QueryPool, QueryPool]:
    """Training and test pool, not normalised: of files where they are named, else of Gridworld.

    Args:
        settings: the sections ``grid`` and ``pool``.

    Raises:
        InputError: a setting or a file cannot be used.
    """
    pool, grid = settings["pool"], settings["grid"]
    given = [name for name in ("train", "test") if pool[name] is not None]
    if len(given) == 1:
        raise InputError(
            f"pool.{given[0]}={pool[given[0]]} alone: the other pool would be the Gridworld's; "
            "expected both pool.train and pool.test of your own, or neither"
        )
    # Each pool takes two seeds, one for the starts and one for the moves.
    first_seed = 4 * check_seed("pool.seed", pool["seed"])
    if first_seed >= 2**31:
        raise InputError(f"pool.seed={pool['seed']}: expected a whole number below {2**29}")
    pools = []
    for path, seed in ((pool["train"], first_seed), (pool["test"], first_seed + 2)):
        if path is not None:
            pools.append(QueryPool.load(str(path)))
        else:
            size, length = grid["size"], grid["length"]
            pools.append(gridworld_pool(pool["size"], pool["options"], size, length, seed))
    return pools[0], pools[1]


def make_task(train: QueryPool, test: QueryPool, tau: Any) -> Task:
    """Fit the normaliser on the training pool, normalise both, solve for tau.

    Args:
        train, test: the pools, not normalised.
        tau: ``noisy``, ``optimal`` or a positive number.

    Raises:
        InputError: the pools do not belong together, a feature never varies, or tau is another
            word.
    """
    if isinstance(tau, str) and tau not in ("noisy", "optimal"):
        raise InputError(f"tau={tau!r}: expected noisy, optimal or a number above 0, as in tau=2")
    if not isinstance(tau, str):
        check_positive("tau", tau)
    if test.n_options != train.n_options:
        raise InputError(
            f"pool.test has K={test.n_options} options a query and pool.train K={train.n_options}: "
            "expected the same K; make both with the same pool.options"
        )
    normalizer = Normalizer.fit(train.features)
    train, test = train.map_features(normalizer), test.map_features(normalizer)
    if tau == "optimal":
        solved = None
    elif tau == "noisy":
        omega = uniform_sphere((2000, train.n_features), torch.Generator().manual_seed(0))
        returns = torch.einsum("nkd,md->nmk", train.features, omega)
        solved = calibrate_tau(returns, NOISY_ACCURACY)
    else:
        solved = float(tau)
    return Task(train, test, normalizer, solved)


def reload_task(checkpoint: Checkpoint, train: Path, test: Path) -> Task:
    """The task of a run from its pool files; made again from its settings where they are gone.

    Raises:
        InputError: the pools or the human are not those that the checkpoint was trained with.
    """
    settings = checkpoint.settings
    if train.is_file() and test.is_file():
        pools = QueryPool.load(train), QueryPool.load(test)
    else:
        pools = make_pools(settings)
    task = make_task(*pools, settings["tau"])
    for name, pool, digest in (
        ("train", task.train, checkpoint.train_digest),
        ("test", task.test, checkpoint.test_digest),
    ):
        if pool.digest != digest:
            raise InputError(
                f"the checkpoint does not fit the {name} pool: digest {pool.digest[:12]}, trained "
                f"with {digest[:12]}; restore {train.parent}/{name}_pool.pt"
            )
    if task.tau != checkpoint.tau and not (
        task.tau and checkpoint.tau and math.isclose(task.tau, checkpoint.tau, rel_tol=0.01)
    ):
        raise InputError(
            f"the checkpoint does not fit its settings: its human has tau={checkpoint.tau}, and "
            f"tau={settings['tau']} makes it {task.tau}; restore a copy of the checkpoint"
        )
    return task


def make_query_env(
    settings: Settings,
    task: Task,
    pool: QueryPool,
    sessions: int,
    seed: int,
    candidates: int | None = None,
) -> QueryEnv:
    """The query environment on a normalised pool, by the sections ``setup`` and ``belief``."""
    repeats = settings["setup"].get("repeats", True)
    common = _session_arguments(settings, task, sessions, seed)
    return QueryEnv(pool, candidates=candidates, repeats=repeats, **common)


def make_feed_env(
    settings: Settings, task: Task, pool: QueryPool, sessions: int, seed: int
) -> FeedEnv:
    """The feed environment on a normalised pool, by the sections ``setup`` and ``belief``."""
    setup = settings["setup"]
    common = _session_arguments(settings, task, sessions, seed)
    kinds = {"on_skip": setup["on_skip"], "skip": settings["skip"]}
    return FeedEnv(pool, offers=setup["offers"], **kinds, **common)


def make_training_env(
    settings: Settings, task: Task, pool: QueryPool, sessions: int, seed: int
) -> QueryEnv | FeedEnv:
    """The environment in which a policy of these settings learns, on a normalised pool."""
    if settings["setup"]["name"] == "feed":
        return make_feed_env(settings, task, pool, sessions, seed)
    # A policy that learns an index has the whole pool before it.
    candidates = None if picks_by_index(settings) else settings["setup"]["candidates"]
    return make_query_env(settings, task, pool, sessions, seed, candidates)


def _session_arguments(settings: Settings, task: Task, sessions: int, seed: int) -> dict[str, Any]:
    """What both environments are made with."""
    belief = settings["belief"]
    return {
        "human": SimulatedHuman(task.response_model, settings["tau_spread"]),
        "belief": Belief(task.response_model, belief["samples"], belief["moves"]),
        "budget": settings["setup"]["budget"],
        "objective": settings["objective"],
        "batch_size": (sessions,),
        "seed": seed,
        "device": check_device(settings["device"]),
    }


def make_policy(settings: Settings, env: QueryEnv | FeedEnv) -> Policy:
    """The policy of the setting ``policy``, untrained, to fit an environment."""
    chosen = settings["policy"]
    name = check_choice("policy", chosen["name"], ("scorer", "attention", "paper"))
    if name == "attention":
        return attention_policy(env, chosen["tokens"])
    if name == "paper":
        return paper_policy(env)
    start = chosen["start"]
    if start is None and isinstance(env, QueryEnv):
        start = settings["objective"]  # as trained, whatever the environment's own is
    return scorer_policy(env, start)


def check_device(name: Any) -> torch.device:
    """The device of that name.

    Raises:
        InputError: no such device, or not on this machine.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        raise InputError(f"device={name!r}: expected cpu, cuda or cuda:<number>") from None
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device={name}: expected cpu or cuda; set device=cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"device={name}: this machine has {torch.cuda.device_count()} CUDA devices; "
            "set device=cpu, or install a CUDA build of torch where there is one"
        )
    return device


def load_weights(policy: Policy, checkpoint: Checkpoint) -> None:
    """Put a checkpoint's weights into a policy.

    Raises:
        InputError: they belong to another policy or to other sizes.
    """
    restore_weights(policy.weights, checkpoint.weights)


def load_policy(checkpoint: Checkpoint | str | Path, env: QueryEnv | FeedEnv) -> Policy:
    """A trained policy, to fit an environment; ``env.rollout(20, policy.strategy)`` lets it ask.

    Args:
        checkpoint: one that is loaded, or its file, or the folder of a run.
        env: where it is to ask, on any pool that it fits; a pool of raw features is best normalised
            by the checkpoint's own ``normalizer``.

    Raises:
        InputError: the file cannot be used, the policy was trained in the other setup or with other
            skips, or the pool or the weights do not fit.
    """
    if not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint.load(checkpoint)
    settings = checkpoint.settings
    setup = "feed" if isinstance(env, FeedEnv) else "query"
    if settings["setup"]["name"] != setup:
        raise InputError(
            f"a policy of setup={settings['setup']['name']} cannot decide in a "
            f"{type(env).__name__}; expected an environment of the setup that it was trained in"
        )
    if isinstance(env, FeedEnv) and settings["skip"] != env.skip:
        raise InputError(
            f"skip={env.skip!r}: the policy was trained with skip={settings['skip']!r}; make the "
            f"environment with skip={settings['skip']!r}"
        )
    checkpoint.check_fits(QueryPool(env.features))
    policy = make_policy(checkpoint.settings, env)
    load_weights(policy, checkpoint)
    return policy
