"""Tasks: where trajectories come from, and what of them a person's reward may depend on.

Shapes: N queries, K options per query, T trajectory length, D features.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks.scene import Label, Patch, Scene, Shape


class Task(ABC):
    """A kind of trajectory, and its features.

    Attributes:
        feature_names: D, what each feature is called.
    """

    feature_names: tuple[str, ...]

    @abstractmethod
    def trajectories(self, count: int, seed: int) -> Tensor:
        """Trajectories (count T …) that a seed fixes; it may use ``seed`` and ``seed + 1``."""

    @abstractmethod
    def features(self, trajectories: Tensor) -> Tensor:
        """Features (… D) of trajectories (… T …), not normalised."""

    def split(self, seed: int) -> tuple[Task, Task]:
        """The task that training queries are about, and the one that test queries are about, which
        share no trajectory; the same task where every seed gives new ones."""
        return self, self

    def queries(self, n_queries: int, n_options: int, seed: int) -> Tensor:
        """Trajectories (N K T …) of queries that a seed fixes; fewer than N where there are no
        more."""
        shape = (n_queries, n_options)
        return self.trajectories(n_queries * n_options, seed).unflatten(0, shape)

    def step_features(self, trajectories: Tensor) -> Tensor:
        """Features (… T D) of the steps of trajectories (… T …), not normalised, whose mean over
        the steps are the features, where a task has such.

        Raises:
            InputError: it has not.
        """
        raise InputError(
            f"{type(self).__name__} has features of whole trajectories alone: expected a task "
            "whose features are means over the steps, such as task=gridworld, or another human"
        )

    def scene(self, trajectory: Tensor) -> Scene:
        """What a person is shown of one trajectory (T …); the features as bars, where a task has
        nothing better."""
        features = self.features(trajectory)
        return feature_bars(self.feature_names, features, features)


def make_pool(task: Task, n_queries: int, n_options: int, seed: int) -> QueryPool:
    """Queries about a task: K trajectories each, with their features, not normalised.

    Args:
        task: where trajectories come from.
        n_queries: N, at least 1; there are fewer where the task has no more.
        n_options: K, at least 1.
        seed: fixes the pool.

    Raises:
        InputError: a number is below its minimum, or the features cannot be used.
    """
    check_count("pool.size", n_queries, 1)
    check_count("pool.options", n_options, 1)
    trajectories = task.queries(n_queries, n_options, seed)
    features = task.features(trajectories.flatten(0, 1)).unflatten(0, trajectories.shape[:2])
    return QueryPool(features, trajectories, task.feature_names)


def feature_bars(names: tuple[str, ...], features: Tensor, sizes: Tensor) -> Scene:
    """Named features (D) as bars of these sizes (D), in one frame."""
    bars: list[Shape] = []
    for row, (name, value, size) in enumerate(
        zip(names, features.tolist(), sizes.tolist(), strict=True)
    ):
        low, high = -row - 0.8, -row - 0.4
        bars.append(Patch(((0.0, low), (size, low), (size, high), (0.0, high)), "#4477aa"))
        bars.append(Label((0.0, -row - 0.2), f"{name}: {value:.3g}"))
    reach = max(1e-9, float(sizes.abs().max())) * 1.1
    # As much room above the first name as below the last bar.
    return Scene((-reach, -float(len(names))), (reach, 0.2), (), (tuple(bars),), equal=False)
