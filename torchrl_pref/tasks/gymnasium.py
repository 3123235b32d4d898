"""Trajectories of any Gymnasium environment. The package ``gymnasium`` is an extra.

Letters: B environments side by side, T observations in a trajectory, S numbers of an observation,
A numbers of an action.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.rollouts import (
    FeatureMap,
    PlayPolicy,
    RolloutTask,
    Simulator,
    features_of,
    play,
)
from torchrl_pref.tasks.viewers import VIEWERS

BESIDE = 32
"""B, environments that are played side by side."""


class GymnasiumTask(RolloutTask):
    """Rollouts of a Gymnasium environment.

    Args:
        id: of the environment, as Gymnasium knows it.
        length: T, observations in a trajectory, at least 2.
        features: computes them, see ``rollouts.FeatureMap``; None: those that come with the
            package.
        policy: chooses the actions, see ``rollouts.PlayPolicy``; None: random ones.
        make: makes an environment of the user's own, instead of the one of ``id``.

    Raises:
        InputError: there is no such environment, or it has observations or actions that are no
            numbers, or no features are given for it.
    """

    def __init__(
        self,
        id: str = "MountainCarContinuous-v0",
        length: int = 300,
        features: FeatureMap | None = None,
        policy: PlayPolicy | None = None,
        make: Callable[[], Any] | None = None,
    ) -> None:
        self._make = _maker(id) if make is None else make
        name = str(id) if make is None else getattr(make, "__name__", "an environment of your own")
        simulator = VectorSimulator(self._make, 1)
        simulator.close()
        self._policy = policy
        sizes = simulator.n_observed, simulator.n_actions
        super().__init__(*sizes, length, features_of(name, features), VIEWERS.get(name))

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: rows (count T W), as described in ``rollouts``."""
        simulator = VectorSimulator(self._make, min(count, BESIDE))
        try:
            return play(simulator, count, self.length, seed, self._policy)
        finally:
            simulator.close()


def _maker(id: Any) -> Callable[[], Any]:
    """What makes the environment of an id.

    Raises:
        InputError: Gymnasium is not installed, or the id names code to import.
    """
    try:
        import gymnasium
    except ImportError:
        raise InputError(
            "gymnasium is not installed; install it by "
            "pip install -c constraints.txt -e '.[gymnasium]'"
        ) from None
    if not isinstance(id, str) or ":" in id:
        raise InputError(
            f"id={id!r}: expected an environment that Gymnasium knows, such as "
            "MountainCarContinuous-v0; for one of your own type "
            "make=<module>:<function that makes it>"
        )
    return lambda: gymnasium.make(id)


class VectorSimulator(Simulator):
    """Environments of Gymnasium, side by side.

    Args:
        make: makes one.
        size: B.

    Raises:
        InputError: it cannot be made, or has observations or actions that are no numbers.
    """

    def __init__(self, make: Callable[[], Any], size: int) -> None:
        from gymnasium.spaces import Box, Discrete
        from gymnasium.vector import SyncVectorEnv

        try:
            # Of an id without its version Gymnasium tells which one it takes: the newest.
            with warnings.catch_warnings(action="ignore", category=UserWarning):
                self._envs = SyncVectorEnv([make] * size)
        except Exception as error:  # each kind of environment has its own reasons
            raise InputError(f"the environment cannot be made ({_mended(error)})") from error
        observed, acted = self._envs.single_observation_space, self._envs.single_action_space
        if not isinstance(observed, Box) or not isinstance(acted, (Box, Discrete)):
            raise InputError(
                f"the environment observes {observed!s:.80} and acts in {acted!s:.80}; expected "
                "observations of Box and actions of Box or Discrete; wrap it, as by "
                "gymnasium.wrappers.FlattenObservation, in a function for make=<module>:<its name>"
            )
        self.size = size
        self.n_observed, self.n_actions = math.prod(observed.shape), math.prod(acted.shape)

    def reset(self, seed: int) -> Tensor:
        """See :meth:`Simulator.reset`."""
        self._envs.action_space.seed(seed)
        observed, _ = self._envs.reset(seed=seed)
        return self._rows(observed)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Simulator.step`."""
        space = self._envs.action_space
        given = actions.numpy().reshape(space.shape).astype(space.dtype)
        observed, _, terminated, truncated, _ = self._envs.step(given)
        return self._rows(observed), torch.from_numpy(terminated | truncated)

    def random_actions(self) -> Tensor:
        """See :meth:`Simulator.random_actions`."""
        return self._rows(self._envs.action_space.sample())

    def close(self) -> None:
        """Close them."""
        self._envs.close()

    def _rows(self, array: Any) -> Tensor:
        """An array (B …) as rows (B …)."""
        return torch.as_tensor(array).reshape(self.size, -1)


def _mended(error: Exception) -> str:
    """What an error says, and how what is missing is installed."""
    text = " ".join(str(error).split())[:300]
    if "box2d" in text.lower():  # of its own packages, too
        return f"{text}; pip install -c constraints.txt -e '.[box2d]'"
    return text
