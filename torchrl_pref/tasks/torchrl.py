"""Trajectories of any TorchRL environment.

Letters: B environments side by side, T observations in a trajectory, S numbers of an observation,
A numbers of an action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv

from torchrl_pref.errors import InputError
from torchrl_pref.tasks.rollouts import (
    FeatureMap,
    PlayPolicy,
    RolloutTask,
    Simulator,
    features_of,
    play,
)

BESIDE = 32
"""B, of environments that are not batched themselves."""


class TorchRLTask(RolloutTask):
    """Rollouts of a TorchRL environment.

    Args:
        make: makes the environment, of batch size () or (B).
        length: T, observations in a trajectory, at least 2.
        features: computes them, see ``rollouts.FeatureMap``.
        policy: chooses the actions, see ``rollouts.PlayPolicy``; None: random ones.

    Raises:
        InputError: it makes no environment that can be used, or no features are given.
    """

    def __init__(
        self,
        make: Callable[[], EnvBase] | None = None,
        length: int = 300,
        features: FeatureMap | None = None,
        policy: PlayPolicy | None = None,
    ) -> None:
        if make is None:
            raise InputError(
                "make=null: expected a function of yours that makes a TorchRL environment; type "
                "make=<module>:<its name>"
            )
        self._make, self._policy = make, policy
        with torch.random.fork_rng(devices=[]):
            simulator = TensorDictSimulator(make, 1)
        sizes = simulator.n_observed, simulator.n_actions
        name = getattr(make, "__name__", "an environment of your own")
        super().__init__(*sizes, length, features_of(name, features))

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: rows (count T W), as described in ``rollouts``."""
        # Random actions come of torch's global generator, which is put back after.
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            simulator = TensorDictSimulator(self._make, min(count, BESIDE))
            return play(simulator, count, self.length, seed, self._policy)


class TensorDictSimulator(Simulator):
    """An environment of TorchRL; several side by side, where it is not batched itself.

    An observation is all numbers that the environment observes, in the order of their names.

    Args:
        make: makes one.
        size: B, where it is not batched.

    Raises:
        InputError: it cannot be made, or is batched in more than one dimension.
    """

    def __init__(self, make: Callable[[], EnvBase], size: int) -> None:
        name = getattr(make, "__name__", type(make).__name__)
        try:
            env: Any = make()
        except Exception as error:  # whatever it is, it is the user's
            raise InputError(
                f"make={name}: fails ({type(error).__name__}: {error}); expected a function "
                "without arguments that makes an environment; mend it"
            ) from error
        if not isinstance(env, EnvBase) or len(env.batch_size) > 1:
            came = f"of batch size {tuple(env.batch_size)}" if isinstance(env, EnvBase) else ""
            raise InputError(
                f"make={name}: gives a {type(env).__name__} {came}; expected a TorchRL environment "
                "of batch size () or (B)"
            )
        self._env = env if len(env.batch_size) else SerialEnv(size, make)
        self.size = self._env.batch_size.numel()
        keys = self._env.observation_spec.keys(True, True)
        self._keys = sorted(keys, key=str)
        started = self._env.reset()
        self.n_observed = self._observed(started).shape[1]
        self.n_actions = self.random_actions().shape[1]

    def reset(self, seed: int) -> Tensor:
        """See :meth:`Simulator.reset`."""
        torch.manual_seed(seed)
        self._env.set_seed(seed)
        self._state = self._env.reset()
        return self._observed(self._state)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Simulator.step`."""
        spec = self._env.full_action_spec[self._env.action_key]
        given = actions.reshape(spec.shape).to(spec.dtype)
        self._state[self._env.action_key] = given.to(self._env.device or "cpu")
        stepped, self._state = self._env.step_and_maybe_reset(self._state)
        after = stepped["next"]
        return self._observed(after), after["done"].reshape(self.size).cpu()

    def random_actions(self) -> Tensor:
        """See :meth:`Simulator.random_actions`."""
        spec = self._env.full_action_spec[self._env.action_key]
        return self._rows(spec.rand())

    def _observed(self, data: TensorDictBase) -> Tensor:
        """(B S), all that is observed."""
        return torch.cat([self._rows(data[key]).float() for key in self._keys], 1)

    def _rows(self, tensor: Tensor) -> Tensor:
        """A tensor (B …) as rows (B …)."""
        return tensor.reshape(self.size, -1).cpu()
