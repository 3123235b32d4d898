"""From plain settings to the objects of a run: pools, response model, environment, policy.

Settings are nested dicts of plain values, as composed by Hydra or read from a checkpoint. They name
things and are never code to call, so that a foreign checkpoint can do no harm.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_pref.checkpoints.checkpoint import Checkpoint, picks_by_index
from torchrl_pref.checkpoints.restore import restore_weights
from torchrl_pref.config.sections import GroupSection, Settings
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.envs.setups import refuse_other_setup, setups_of
from torchrl_pref.errors import InputError, check_seed
from torchrl_pref.groups import make
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.demonstrations import Demonstrations
from torchrl_pref.policies.base import Policy
from torchrl_pref.pool import Normalizer, QueryPool, check_alike
from torchrl_pref.problem import Human, Problem, named, solve_tau
from torchrl_pref.tasks.base import make_pool

ANSWERING = ("tau", "lapse")
"""Settings of a human, or of a belief, that are of the response model, and not of their kind."""

USUAL_HUMAN = cast(GroupSection, {"name": "simulated", "spread": 1, "tau": None, "lapse": 0.0})
"""The section of humans in whom nothing is particular."""

LARGEST = 1e15
"""Of a feature that a policy can read."""


def make_pools(settings: Settings, test_seed: int | None = None) -> tuple[QueryPool, QueryPool]:
    """Training and test pool, not normalised: of files where they are named, else of the task.

    Args:
        settings: the sections ``task`` and ``pool``.
        test_seed: of a test pool of the task; None: the one that follows the training pool's.

    Raises:
        InputError: a setting or a file cannot be used.
    """
    pool = settings["pool"]
    given = {"train": pool["train"], "test": pool["test"]}
    given = {name: path for name, path in given.items() if path is not None}
    if len(given) == 1:
        name, path = given.popitem()
        raise InputError(
            f"pool.{name}={path} alone: the other pool would be the task's; "
            "expected both pool.train and pool.test of your own, or neither"
        )
    # Each pool takes two seeds.
    first_seed = 4 * check_seed("pool.seed", pool["seed"])
    if first_seed >= 2**31:
        raise InputError(f"pool.seed={pool['seed']}: expected a whole number below {2**29}")
    if given:
        return QueryPool.load(str(pool["train"])), QueryPool.load(str(pool["test"]))
    train, test = make("task", settings["task"]).split(pool["seed"])
    sizes = pool["size"], pool["options"]
    second_seed = first_seed + 2 if test_seed is None else test_seed
    return make_pool(train, *sizes, first_seed), make_pool(test, *sizes, second_seed)


def make_demonstrations(settings: Settings) -> Demonstrations:
    """What each human shows before the first question, by the section ``demonstrations``."""
    return Demonstrations(**settings["demonstrations"])


def weigh_steps(settings: Settings, human: HumanBase, pool: QueryPool) -> Tensor | None:
    """Features (N K D) of a pool's options as a human sees them, not normalised; None where that is
    as the belief does.

    Raises:
        InputError: the human weighs steps, and the task or the pool cannot tell them.
    """
    shown = pool.trajectories
    weights = human.step_weights(1 if shown is None else shown.shape[2])
    if weights is None:
        return None
    if shown is None or settings["pool"]["train"] is not None:
        refuse_own_pools(settings, human)
    steps = make("task", settings["task"]).step_features(shown)
    return torch.einsum("t,nktd->nkd", weights.to(steps), steps)


def human_of(settings: Settings, task: Problem) -> HumanBase:
    """Who answers, by the section ``human``."""
    made: HumanBase = make("human", settings["human"], task.human_model, without=ANSWERING)
    return made


def refuse_own_pools(settings: Settings, human: HumanBase) -> None:
    """Refuse to ask a human who weighs steps about queries of the user's own.

    Raises:
        InputError: they weigh steps.
    """
    if human.step_weights(1) is not None:
        raise InputError(
            f"human={settings['human']['name']} weighs the steps of trajectories, which only a "
            "task tells and not a pool of your own; leave pool.train and pool.test out, or choose "
            "another human"
        )


def make_task(
    train: QueryPool, test: QueryPool, tau: Any, settings: Settings | None = None
) -> Problem:
    """Fit the normaliser on the training pool, normalise both, solve for tau.

    Args:
        train, test: the pools, not normalised.
        tau: ``noisy``, ``optimal`` or a positive number.
        settings: the sections ``question``, ``human`` and ``belief``; None: a choice, no lapses.

    Raises:
        InputError: the pools do not belong together, a feature never varies, or tau is another
            word.
    """
    if test.n_options != train.n_options:
        raise InputError(
            f"pool.test has K={test.n_options} options a query and pool.train K={train.n_options}: "
            "expected the same K; make both with the same pool.options"
        )
    check_alike(train, test)
    normalizer = Normalizer.fit(train.features, train.feature_names)
    train, test = train.map_features(normalizer), test.map_features(normalizer)
    solved = solve_tau(tau, train)
    if settings is None:
        return Problem(train, test, normalizer, solved)
    question = make("question", settings["question"])
    human = settings["human"]
    own = solved if human["tau"] is None else solve_tau(human["tau"], train)
    who = Human(own, human["lapse"], _kind_of(human))
    lapse = settings["belief"]["lapse"]
    name = "" if settings["task"]["name"] == "gridworld" else settings["task"]["name"]
    pools_of = "own pools" if settings["pool"]["train"] is not None else name
    infers = "tau" if settings["belief"]["name"] == "rationality" else ""
    task = Problem(train, test, normalizer, solved, question, who, lapse, pools_of, infers)
    for model in (task.human_model, task.response_model):
        model.n_answers(train.n_options)  # or it is refused here
    return task


def _kind_of(section: GroupSection) -> str:
    """What is particular to a kind of human beside tau and lapses, in words."""
    name = section.get("make", section["name"])
    words = [] if name == USUAL_HUMAN["name"] else [str(name)]
    for key, value in section.items():
        if key not in (*ANSWERING, "name", "make") and value != USUAL_HUMAN.get(key):
            words.append(f"{key}={value}")
    return " ".join(words)


def load_test_pool(path: str, task: Problem) -> QueryPool:
    """A pool of the user's to test on, normalised as the training pool of a task was.

    Raises:
        InputError: it cannot be read, or does not belong to the task.
    """
    pool = QueryPool.load(path)
    check_alike(task.train, pool)
    try:
        task.response_model.n_answers(pool.n_options)
    except InputError:
        raise InputError(
            f"pool.test={path} has K={pool.n_options} options a query, which the question of the "
            f"training ({named(task.question)}) cannot be asked about; expected "
            f"K={task.train.n_options}, as in training"
        ) from None
    return pool.map_features(task.normalizer)


def reload_task(checkpoint: Checkpoint, train: Path, test: Path) -> Problem:
    """The task of a run from its pool files; made again from its settings where they are gone.

    Raises:
        InputError: the pools or the human are not those that the checkpoint was trained with.
    """
    settings = checkpoint.settings
    if train.is_file() and test.is_file():
        pools = QueryPool.load(train), QueryPool.load(test)
    else:
        pools = make_pools(settings)
    task = make_task(*pools, settings["tau"], settings)
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
    task: Problem,
    pool: QueryPool,
    sessions: int,
    seed: int,
    candidates: int | None = None,
) -> QueryEnv:
    """The query environment on a normalised pool, by the sections ``setup`` and ``belief``."""
    setup = settings["setup"]
    common = _session_arguments(settings, task, pool, sessions, seed)
    common |= {"repeats": setup.get("repeats", True), "batch": setup.get("batch", 1)}
    return QueryEnv(pool, candidates=candidates, **common)


def make_feed_env(
    settings: Settings, task: Problem, pool: QueryPool, sessions: int, seed: int
) -> FeedEnv:
    """The feed environment on a normalised pool, by the sections ``setup`` and ``belief``."""
    setup = settings["setup"]
    common = _session_arguments(settings, task, pool, sessions, seed)
    common |= {"on_skip": setup["on_skip"], "skip": settings["skip"]}
    return FeedEnv(pool, offers=setup["offers"], **common)


def make_training_env(
    settings: Settings, task: Problem, pool: QueryPool, sessions: int, seed: int
) -> QueryEnv | FeedEnv:
    """The environment in which a policy of these settings learns, on a normalised pool."""
    if settings["setup"]["name"] == "feed":
        return make_feed_env(settings, task, pool, sessions, seed)
    # A policy that learns an index has the whole pool before it.
    candidates = None if picks_by_index(settings) else settings["setup"]["candidates"]
    return make_query_env(settings, task, pool, sessions, seed, candidates)


def _session_arguments(
    settings: Settings, task: Problem, pool: QueryPool, sessions: int, seed: int
) -> dict[str, Any]:
    """What both environments are made with."""
    human = human_of(settings, task)
    seen = weigh_steps(settings, human, pool)
    return {
        "human": human,
        "belief": make("belief", settings["belief"], task.response_model, without=ANSWERING),
        "demonstrations": make_demonstrations(settings),
        "seen": None if seen is None else task.normalizer(seen),
        "budget": settings["setup"]["budget"],
        "objective": settings["objective"],
        "batch_size": (sessions,),
        "seed": seed,
        "device": check_device(settings["device"]),
    }


def make_policy(settings: Settings, env: EnvBase) -> Policy:
    """The policy of the setting ``policy``, untrained, to fit an environment."""
    section = settings["policy"]
    if section.get("start", ...) is None and not is_feed(env):
        section = {**section, "start": settings["objective"]}  # as trained, whatever env rewards
    made: Policy = make("policy", section, env, without=("sample",))
    refuse_other_setup(f"policy={section.get('make') or section['name']}", made.strategy, env)
    return made


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


def load_policy(checkpoint: Checkpoint | str | Path, env: EnvBase) -> Policy:
    """A trained policy, to fit an environment; ``env.rollout(20, policy.strategy)`` lets it ask.

    Args:
        checkpoint: one that is loaded, or its file, or the folder of a run.
        env: where it is to ask, on any pool that it fits; a pool of raw features is best normalised
            by the checkpoint's own ``normalizer``.

    Raises:
        InputError: the file cannot be used, the policy was trained in the other setup or with other
            skips, the pool or the weights do not fit, or features are so large that their squares
            are beyond float32.
    """
    if not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint.load(checkpoint)
    if len(env.batch_size) != 1:
        raise InputError(
            f"an environment of batch size {tuple(env.batch_size)}: expected one size, as a policy "
            "is for the sessions of one environment; make it for one with a larger batch_size"
        )
    settings, (setup, _) = checkpoint.settings, setups_of(env)
    if settings["setup"]["name"] != setup:
        raise InputError(
            f"a policy of setup={settings['setup']['name']} cannot decide in one of "
            f"setup={setup}; expected an environment of the setup that it was trained in"
        )
    if setup == "feed" and settings["skip"] != env.skip:
        raise InputError(
            f"skip={env.skip!r}: the policy was trained with skip={settings['skip']!r}; make the "
            f"environment with skip={settings['skip']!r}"
        )
    checkpoint.check_fits(QueryPool(env.features))
    largest = float(env.features.abs().max())
    if largest > LARGEST:
        raise InputError(
            f"features up to {largest:.3g}: expected at most {LARGEST:g}, as a policy reads their "
            "squares; normalise the pool, by Normalizer.fit"
        )
    with torch.random.fork_rng(devices=[]):  # the weights it begins with are not kept
        policy = make_policy(settings, env)
    load_weights(policy, checkpoint)
    return policy
