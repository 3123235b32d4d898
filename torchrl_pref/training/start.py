"""A training from its settings, and the checkpoint of it as it stands."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch

from torchrl_pref.build import make_policy, make_training_env
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.config.memory import session_parts, steps_and_stages
from torchrl_pref.config.sections import Settings
from torchrl_pref.errors import check_choice, check_seed
from torchrl_pref.problem import Problem
from torchrl_pref.training.algorithms import ALGORITHMS
from torchrl_pref.training.drawn import DrawnSessions
from torchrl_pref.training.parts import SessionParts, make_part, seeds_of_part
from torchrl_pref.training.sessions import Sessions
from torchrl_pref.training.settings import TrainingSettings
from torchrl_pref.training.trainer import Trainer


def make_trainer(settings: Settings, task: Problem) -> Trainer:
    """Environment, policy and algorithm of a run, ready for its first update.

    Raises:
        InputError: a setting is out of range.
    """
    constants = TrainingSettings(**settings["training"])
    own = dict(settings["algorithm"])
    learn = ALGORITHMS[check_choice("algorithm", own.pop("name"), tuple(ALGORITHMS))]
    seed = check_seed("seed", settings["seed"])
    here, *others = session_parts(settings)
    env = make_training_env(settings, task, task.train, here, seed)
    # The policy's initial weights come from the global generator.
    torch.manual_seed(seed)
    policy = make_policy(settings, env)
    algorithm = learn(policy, constants, **own)
    if constants.problems == "drawn":
        return Trainer(DrawnSessions(settings, policy, env, seed), algorithm, seed)
    steps, stages = steps_and_stages(constants.steps, constants.stages, env.max_steps)
    sessions = Sessions(env, policy, steps, stages)
    # No more goes to another process.
    pool = replace(task.train, trajectories=None)
    asked = replace(task, train=pool, test=pool)
    makes = [
        partial(make_part, settings, asked, steps, stages, size, seeds_of_part(seed, part))
        for part, size in enumerate(others, start=1)
    ]
    return Trainer(SessionParts(sessions, makes) if makes else sessions, algorithm, seed)


def make_checkpoint(settings: Settings, task: Problem, trainer: Trainer) -> Checkpoint:
    """Everything about a run as it stands."""
    train = task.train
    shape = {"N": len(train), "K": train.n_options, "D": train.n_features}
    return Checkpoint(
        settings=settings,
        tau=task.tau,
        mean=task.normalizer.mean,
        std=task.normalizer.std,
        train_digest=train.digest,
        test_digest=task.test.digest,
        pool_shape=shape,
        weights=trainer.average,
        training=trainer.state_dict(),
    )
