"""Environments, sessions, settings and trainers that several tests are made with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from conftest import RESPONSE_MODELS
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.build import load_weights, make_pools, make_task
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.choice import evidence_of_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.strategies import RandomAsk, RandomQuery
from torchrl_pref.training.start import make_checkpoint, make_trainer
from torchrl_pref.training.trainer import Trainer

ENVS = [QueryEnv, FeedEnv]


def make(
    kind: type[QueryEnv] | type[FeedEnv],
    pool: QueryPool,
    model: ResponseModel = RESPONSE_MODELS[0],
    batch: int = 4,
    **options: object,
) -> QueryEnv | FeedEnv:
    belief = Belief(model, samples=20, moves=2)
    paper = {"objective": "information_gain", **({"skip": "regret"} if kind is FeedEnv else {})}
    options = {"budget": 5, "batch_size": (batch,), "seed": 0, **paper, **options}
    return kind(pool, SimulatedHuman(model), belief, **options)  # type: ignore[arg-type]


def coin(env: QueryEnv | FeedEnv, seed: int = 0) -> TensorDictModule:
    return RandomQuery(seed) if isinstance(env, QueryEnv) else RandomAsk(0.5, seed)


def session_of(env: QueryEnv | FeedEnv) -> TensorDictBase:
    """A session after one answer."""
    ask = RandomQuery() if isinstance(env, QueryEnv) else RandomAsk()
    return env.step_mdp(env.step(ask(env.reset())))


OF_POLICY: dict[str, dict[str, Any]] = {
    "scorer": {"start": None},
    "attention": {"tokens": "samples"},
    "paper": {},
}


LEARNS_TO_ASK: dict[str, Any] = {
    "sessions": 32,
    "steps": 8,
    "stages": 1,
    "optimizer": "adam",
    "learning_rate": 0.01,
}
"""Constants of a training in which the paper's policy learns in the feed that asking pays."""


def settings_of(setup: str = "feed", policy: str = "scorer", **training: Any) -> dict[str, Any]:
    return {
        "tau": "noisy",
        "seed": 0,
        "device": "cpu",
        "threads": 1,
        "overrides": [],
        "objective": "alignment",
        "skip": "free",
        "human": {"name": "simulated", "spread": 1, "tau": None, "lapse": 0.0},
        "demonstrations": {"count": 0, "alternatives": 10, "tau": None},
        "question": {"name": "choice"},
        "task": {"name": "gridworld", "size": 8, "length": 20},
        "pool": {"size": 30, "options": 2, "seed": 0, "train": None, "test": None},
        "belief": {"name": "sampled", "samples": 10, "moves": 1, "lapse": 0.0},
        "logger": ["csv"],
        "algorithm": {"name": "a2c"},
        "evaluation": {"humans": 5, "seed": 1, "during": 0, "metrics": ["calibration"]},
        "policy": {"name": policy, "sample": False, **OF_POLICY[policy]},
        "setup": {
            "name": setup,
            "budget": 4,
            "offers": None,
            "on_skip": "new",
            "candidates": 8,
            "repeats": True,
            "batch": 1,
        },
        "training": {
            "updates": 6,
            "sessions": 4,
            # Not a divisor of the episode, so that batches end in mid-session.
            "steps": 3,
            "stages": 4,
            "processes": 1,
            "optimizer": "rmsprop",
            "learning_rate": 0.01,
            "gamma": 0.99,
            "lmbda": 0.95,
            "entropy": 0.01,
            "critic": 0.5,
            "critic_steps": 2,
            "grad_norm": 0.5,
            "warm_up": 1,
            "average": 0.9,
            "save_every": 2,
            "problems": "one",
            **training,
        },
    }


def trainer_of(settings: dict[str, Any]) -> tuple[Trainer, Any]:
    task = make_task(*make_pools(settings), settings["tau"], settings)
    return make_trainer(settings, task), task


def trained_in_parts(settings: dict[str, Any], parts: list[int], folder: Path) -> Checkpoint:
    """The checkpoint of a run that is stopped after each of these updates but the last, and resumed
    by another trainer; its logs are in the folder."""
    path = folder / "checkpoint.pt"
    for updates in parts:
        settings["training"]["updates"] = updates
        trainer, task = trainer_of(settings)
        if path.exists():
            checkpoint = Checkpoint.load(path)
            load_weights(trainer.policy, checkpoint)
            torch.rand(7)  # whatever else used the global generator
            trainer.load_state_dict(checkpoint.training)
        trainer.run(
            folder, lambda task=task, of=trainer: make_checkpoint(settings, task, of).save(path)
        )
    return Checkpoint.load(path)


def chi_square(ranks: Tensor) -> float:
    """How uneven ranks (B) among 99 samples are, in ten bins, so with 9 degrees of freedom: 33.7 is
    exceeded once in 10,000."""
    expected = len(ranks) / 10
    return float(((torch.histc(ranks.float(), 10, 0, 99) - expected).square() / expected).sum())


def same(first: Any, second: Any) -> bool:
    """Whether two nests of plain data and tensors are equal to the last bit; NaN equals NaN."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[k], second[k]) for k in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, torch.Tensor):
        return torch.equal(first.nan_to_num(7.5), second.nan_to_num(7.5))
    return bool(first == second) or (first != first and second != second)


def told(earlier: Tensor, newest: Tensor) -> Evidence:
    """The evidence of choices with feature gaps (S H K-1 D), and then one more (S K-1 D)."""
    return evidence_of_gaps(torch.cat([earlier, newest.unsqueeze(1)], 1))
