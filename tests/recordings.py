"""Small files, datasets and environments of a user, for the tasks that read or play them."""

from __future__ import annotations

import os
from pathlib import Path

import minari
import numpy as np
import torch
from gymnasium.spaces import Box
from minari.data_collector import EpisodeBuffer
from torch import Generator, Tensor
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.envs.libs.gym import GymEnv

from torchrl_pref.tasks.gridworld import Gridworld

DATASET = "tests/made-v0"


def numbers(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape)


def write_csv(path: Path, count: int = 80) -> Path:
    rows = [",".join(f"{x:.9g}" for x in row) for row in numbers(count, 3)]
    path.write_text("\n".join(["speed,lane,jerk", *rows]) + "\n")
    return path


def write_minari(root: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """A dataset of 80 episodes of different lengths; gives their observations and actions."""
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    rng, episodes, buffers = np.random.default_rng(1), [], []
    for number in range(80):
        steps = 5 + number % 7
        observed = rng.normal(size=(steps + 1, 2)).astype(np.float32)
        acted = rng.uniform(-1, 1, size=(steps, 1)).astype(np.float32)
        ends = np.arange(steps) == steps - 1
        buffers.append(
            EpisodeBuffer(
                observations=list(observed),
                actions=list(acted),
                rewards=[0.0] * steps,
                terminations=ends.tolist(),
                truncations=[False] * steps,
            )
        )
        episodes.append((observed, acted))
    minari.create_dataset_from_buffers(
        DATASET,
        buffers,
        env="MountainCarContinuous-v0",
        eval_env="MountainCarContinuous-v0",
        action_space=Box(-1, 1, (1,), np.float32),
        observation_space=Box(-10, 10, (2,), np.float32),
        data_format="arrow",
        algorithm_name="none",
        author="nobody",
        author_email="nobody@example.org",
        code_permalink="https://example.org",
        description="made for a test",
    )
    return episodes


def grid() -> EnvBase:
    """Batched itself."""
    return Gridworld(size=5, length=9, batch_size=(6,))


def pendulum() -> EnvBase:
    """Not batched, and with two things that are observed."""
    return TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(7))


def reach(observations: Tensor, actions: Tensor, alive: Tensor) -> Tensor:
    """(n 3)."""
    return torch.stack(
        [observations[..., 0].amax(-1), actions[..., 0].float().mean(-1), observations[:, -1, 1]],
        -1,
    )


def lean(observations: Tensor, generator: Generator) -> Tensor:
    """A policy for one action."""
    noise = torch.rand(len(observations), 1, generator=generator)
    return observations[:, 1:2].sign() * 0.5 + 0.4 * noise
