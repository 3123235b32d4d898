"""What tasks have in common whose trajectories are played in a simulator.

Letters: B environments side by side, T observations in a trajectory, S numbers of an observation,
A numbers of an action, W = S + A + 1 numbers of a row, D features.

A row of a trajectory is an observation, the action taken there, and 1. An episode may end before
its T rows are full: its last observation is then repeated, with an action of 0 and a 0 at the end.
An action of 0 stands in the last row of an episode, too, as none is taken there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Generator, Tensor
from tqdm import tqdm

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.scene import Scene
from torchrl_pref.tasks.viewers import Viewer, strips
from torchrl_pref.tensors import check_names, default_names

FeatureMap: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From observations (n T S), actions (n T A) and 1 where the episode goes on (n T), to features
(n D). Its attribute ``names``, where it has one, holds what they are called."""

PlayPolicy: TypeAlias = Callable[[Tensor, Generator], Tensor]
"""From observations (B S) and the source of all its luck, to actions (B A)."""

SCALED_BY = 32
"""Trajectories by which the scale of what is drawn over time is set."""

SHOWN_FROM = 200
"""Trajectories from which on their progress is shown."""


class Simulator(ABC):
    """B environments side by side.

    Attributes:
        size: B.
        n_observed: S.
        n_actions: A.
    """

    size: int
    n_observed: int
    n_actions: int

    @abstractmethod
    def reset(self, seed: int) -> Tensor:
        """Begin B episodes; their first observations (B S). The seed fixes all luck from here."""

    @abstractmethod
    def step(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Take actions (B A); what is observed then (B S), and whether the episode ended (B). An
        environment whose episode has ended may begin another."""

    @abstractmethod
    def random_actions(self) -> Tensor:
        """(B A), uniform where the actions are bounded."""


def play(
    simulator: Simulator, count: int, length: int, seed: int, policy: PlayPolicy | None
) -> Tensor:
    """Trajectories (count T W), as at the top of this file.

    Args:
        simulator: where they are played.
        count: how many.
        length: T.
        seed: fixes them.
        policy: chooses the actions; None: random ones.
    """
    n_batches = -(-count // simulator.size)
    # Seeds of different pools are neighbours; those made of them are not.
    seeds = np.random.SeedSequence(seed).generate_state(n_batches) >> 1
    batches = []
    with tqdm(
        total=count, desc="trajectories", unit="trajectory", disable=count < SHOWN_FROM
    ) as bar:
        for one in seeds.tolist():
            batches.append(_play_batch(simulator, length, one, policy))
            bar.update(min(simulator.size, count - bar.n))
    return torch.cat(batches)[:count] if batches else torch.empty(0)


def _play_batch(simulator: Simulator, length: int, seed: int, policy: PlayPolicy | None) -> Tensor:
    """One trajectory of each environment, (B T W)."""
    n_observed = simulator.n_observed
    rows = torch.zeros(simulator.size, length, n_observed + simulator.n_actions + 1)
    observed, generator = simulator.reset(seed), Generator().manual_seed(seed)
    alive = torch.ones(simulator.size, dtype=torch.bool)
    ended = ~alive
    for step in range(length):
        rows[:, step, :n_observed] = rows[:, max(step - 1, 0), :n_observed]
        rows[alive, step, :n_observed] = observed[alive]
        rows[alive, step, -1] = 1.0
        alive = alive & ~ended
        if step == length - 1 or not alive.any():
            rows[:, step:, :n_observed] = rows[:, step : step + 1, :n_observed]
            break
        actions = simulator.random_actions()
        if policy is not None:
            actions = _checked_actions(policy(observed, generator), simulator)
        rows[alive, step, n_observed:-1] = actions[alive].float()
        observed, ended = simulator.step(actions)
    return rows


def _checked_actions(actions: Any, simulator: Simulator) -> Tensor:
    """Actions (B A) of a policy.

    Raises:
        InputError: they have another shape, or are not finite.
    """
    shape = (simulator.size, simulator.n_actions)
    if not isinstance(actions, Tensor) or tuple(actions.shape) != shape:
        came = tuple(actions.shape) if isinstance(actions, Tensor) else type(actions).__name__
        raise InputError(f"policy: gives {came}; expected a tensor {shape} of actions")
    if not actions.isfinite().all():
        raise InputError("policy: gives actions that are NaN or infinite; expected finite ones")
    return actions.detach()


class RolloutTask(Task):
    """Trajectories of rows, and features that are computed of them.

    Args:
        n_observed, n_actions: S and A.
        length: T, at least 2.
        features: computes them.
        viewer: draws an episode; None: each number that is observed over time.

    Raises:
        InputError: the features cannot be computed.
    """

    def __init__(
        self,
        n_observed: int,
        n_actions: int,
        length: int,
        features: FeatureMap,
        viewer: Viewer | None = None,
    ) -> None:
        self._viewer = viewer
        self._limits: tuple[Tensor, Tensor] | None = None
        self.n_observed, self.n_actions = n_observed, n_actions
        self.length, self._features = check_count("length", length, 2), features
        trial = torch.zeros(2, length, n_observed + n_actions + 1)
        trial[..., -1] = 1.0
        self.feature_names = names_of(features, self.features(trial).shape[-1])

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`: (… D), of rows (… T W)."""
        rows = trajectories.reshape(-1, *trajectories.shape[-2:])
        observations, actions, alive = rows.split([self.n_observed, self.n_actions, 1], dim=-1)
        features = compute_features(self._features, observations, actions, alive.squeeze(-1))
        return features.reshape(*trajectories.shape[:-2], features.shape[-1])

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: an episode, of rows (T W), up to where it ends."""
        lived = trajectory[trajectory[:, -1] > 0, : self.n_observed]
        return self._over_time(lived) if self._viewer is None else self._viewer(lived)

    def _over_time(self, observations: Tensor) -> Scene:
        """Each number over time, at a scale that is the same for all episodes."""
        if self._limits is None:
            some = self.trajectories(SCALED_BY, seed=0)[..., : self.n_observed].flatten(0, 1)
            self._limits = some.amin(0), some.amax(0)
        return strips(observations, *self._limits)


def compute_features(
    features: FeatureMap, observations: Tensor, actions: Tensor, alive: Tensor
) -> Tensor:
    """Features (n D) of trajectories.

    Raises:
        InputError: the function fails, or gives another shape.
    """
    name = getattr(features, "__name__", type(features).__name__)
    try:
        computed = features(observations, actions, alive)
    except Exception as error:  # whatever it is, it is the user's
        raise InputError(
            f"features={name}: fails ({type(error).__name__}: {error}) for observations "
            f"{tuple(observations.shape)}, actions {tuple(actions.shape)} and alive "
            f"{tuple(alive.shape)}; mend it"
        ) from error
    count = len(observations)
    if not isinstance(computed, Tensor) or computed.ndim != 2 or len(computed) != count:
        came = tuple(computed.shape) if isinstance(computed, Tensor) else type(computed).__name__
        raise InputError(
            f"features={name}: gives {came} for {count} trajectories; expected a tensor "
            f"({count}, D); mend it"
        )
    return computed


def names_of(features: FeatureMap, n_features: int) -> tuple[str, ...]:
    """What a function calls its D features.

    Raises:
        InputError: it names others than D.
    """
    return check_names(getattr(features, "names", default_names(n_features)), n_features)


def features_of(name: str, given: FeatureMap | None) -> FeatureMap:
    """The features that a user gave, or those that come with the package for an environment.

    Args:
        name: of the environment.
        given: of the user; None: ours.

    Raises:
        InputError: there are none.
    """
    if given is not None:
        return given
    if name not in READY:
        raise InputError(
            f"features=null: none come with the package for {name}, only for {', '.join(READY)}; "
            "write a function from observations (n T S), actions (n T A) and alive (n T) to "
            "features (n D), and type features=<module>:<its name>"
        )
    return READY[name]


def mountain_car(observations: Tensor, actions: Tensor, alive: Tensor) -> Tensor:
    """APReL's features of MountainCarContinuous (Bıyık, Talati and Sadigh, 2022), in the
    environment's own units: they are normalised with the pool."""
    position, speed = observations[..., 0], observations[..., 1].abs()
    return torch.stack([position.amin(-1), position.amax(-1), _mean(speed, alive)], -1)


def lunar_lander(observations: Tensor, actions: Tensor, alive: Tensor) -> Tensor:
    """Features of LunarLander after Bıyık and Sadigh (CoRL 2018), in the environment's own units;
    the time in steps."""
    place, tilt = observations[..., :2], observations[..., 4]
    return torch.stack(
        [
            _mean(tilt.abs(), alive),
            place[:, -1].norm(dim=-1),
            tilt.diff(dim=-1).abs().sum(-1),
            place.diff(dim=-2).norm(dim=-1).sum(-1),
            observations[:, -1, 3],
            alive.sum(-1) - 1,
        ],
        -1,
    )


def _mean(values: Tensor, alive: Tensor) -> Tensor:
    """The mean (n) of values (n T) while the episode goes on."""
    return (values * alive).sum(-1) / alive.sum(-1)


def _named(features: FeatureMap, *names: str) -> FeatureMap:
    """The function, with what its features are called."""
    vars(features)["names"] = names
    return features


_lander = _named(
    lunar_lander,
    "mean tilt",
    "final distance",
    "rotation",
    "path length",
    "final vertical speed",
    "time",
)
READY: dict[str, FeatureMap] = {
    "MountainCarContinuous-v0": _named(
        mountain_car, "lowest position", "highest position", "mean speed"
    ),
    "LunarLander-v3": _lander,
    "LunarLanderContinuous-v3": _lander,
}
"""Features that come with the package, by environment."""
