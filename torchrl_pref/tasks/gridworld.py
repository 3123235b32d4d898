"""The paper's Gridworld as a batched TorchRL environment, and random trajectories from it.

Shapes: B parallel walks, T trajectory length.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Generator, Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_pref.errors import check_count
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks.base import Task, make_pool
from torchrl_pref.tasks.scene import Disc, Line, Patch, Scene, Shape

MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Change of (row, column) for each of the four actions: up, down, left, right."""


class Gridworld(EnvBase):
    """A square grid: two-dimensional state, one-dimensional action, deterministic, walls stop you.

    The start is uniform over the cells. There is no reward: which walk is better is for the human
    to say. An episode is truncated after ``length`` actions.

    Args:
        size: cells along an edge, at least 2.
        length: T, actions in an episode, at least 1.
        batch_size: (B,), walks that run side by side.
        seed: seeds the environment's own generator; the global generators are never used.
        device: where the tensors live.

    Raises:
        InputError: ``size`` or ``length`` is too small.
    """

    def __init__(
        self,
        size: int = 8,
        length: int = 20,
        batch_size: tuple[int, ...] = (64,),
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.size = check_count("size", size, 2)
        self.length = check_count("length", length, 1)
        self.register_buffer("moves", torch.tensor(MOVES, device=device))
        self._set_seed(seed)
        batch = self.batch_size
        self.observation_spec = Composite(
            position=Bounded(0, size - 1, shape=(*batch, 2), dtype=torch.int64, device=device),
            step_count=Unbounded(shape=(*batch, 1), dtype=torch.int64, device=device),
            shape=batch,
        )
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Categorical(len(MOVES), shape=batch, device=device)
        self.reward_spec = Unbounded(shape=(*batch, 1), device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=batch
        )

    def _set_seed(self, seed: int | None) -> None:
        self._generator = Generator(self.device).manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        shape = (*self.batch_size, 2)
        position = torch.randint(
            self.size, shape, generator=self._generator, device=self._generator.device
        ).to(self.device)
        count = torch.zeros((*self.batch_size, 1), dtype=torch.int64, device=self.device)
        return TensorDict(
            {"position": position, "step_count": count}, self.batch_size, device=self.device
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        position = tensordict["position"] + self.moves[tensordict["action"]]
        count = tensordict["step_count"] + 1
        truncated = count >= self.length
        return TensorDict(
            {
                "position": position.clamp(0, self.size - 1),
                "step_count": count,
                "reward": torch.zeros(truncated.shape, device=self.device),
                "done": truncated,
                "terminated": torch.zeros_like(truncated),
                "truncated": truncated.clone(),
            },
            self.batch_size,
            device=self.device,
        )


def random_walks(count: int, size: int = 8, length: int = 20, seed: int = 0) -> Tensor:
    """Roll out uniformly random moves.

    Args:
        count: how many walks.
        size: cells along an edge.
        length: T, cells in a walk, the start included.
        seed: fixes the starts and the moves.

    Returns:
        (count T 2) int64, the cells in which the T actions were taken.
    """
    env = Gridworld(size, length, (count,), seed)
    generator = Generator().manual_seed(seed + 1)

    def random_move(position: Tensor) -> Tensor:
        return torch.randint(len(MOVES), position.shape[:-1], generator=generator)

    policy = TensorDictModule(random_move, in_keys=["position"], out_keys=["action"])
    return env.rollout(length, policy)["position"]


def corner_distances(positions: Tensor, size: int) -> Tensor:
    """The paper's four features (section 4.1): mean distance to each corner of the Gridworld.

    Args:
        positions: (… T 2), cells visited, from 0 to ``size`` - 1.
        size: cells along an edge.

    Returns:
        (… 4), Euclidean distances in cells, averaged over the trajectory.
    """
    return distances_of_steps(positions, size).mean(-2)


def distances_of_steps(positions: Tensor, size: int) -> Tensor:
    """The distance of each step (… T 4) to each corner, in cells; see :func:`corner_distances`."""
    edge = float(size - 1)
    corners = torch.tensor([[0.0, 0.0], [0.0, edge], [edge, 0.0], [edge, edge]])
    offsets = positions.float().unsqueeze(-2) - corners.to(positions.device)
    return offsets.norm(dim=-1)


class GridworldTask(Task):
    """The paper's: random walks on a grid, and their mean distances to its corners (section 4.1).

    Args:
        size: cells along an edge, at least 2.
        length: T, cells in a walk, at least 1.

    Raises:
        InputError: a number is below its minimum.
    """

    feature_names = ("top left", "top right", "bottom left", "bottom right")

    def __init__(self, size: int = 8, length: int = 20) -> None:
        self.size = check_count("size", size, 2)
        self.length = check_count("length", length, 1)

    def trajectories(self, count: int, seed: int) -> Tensor:
        """See :meth:`Task.trajectories`: (count T 2) int64, cells."""
        return random_walks(count, self.size, self.length, seed)

    def features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.features`: (… 4), mean distances in cells."""
        return corner_distances(trajectories, self.size)

    def step_features(self, trajectories: Tensor) -> Tensor:
        """See :meth:`Task.step_features`: (… T 4), distances in cells."""
        return distances_of_steps(trajectories, self.size)

    def scene(self, trajectory: Tensor) -> Scene:
        """See :meth:`Task.scene`: the cells, darker the longer the walk stayed there, its way
        from a ring at the start, and a disc that goes along it."""
        cells = [(row, column) for row, column in trajectory.tolist()]
        longest = max(cells.count(cell) for cell in cells)
        ground: list[Shape] = []
        for row in range(self.size):
            for column in range(self.size):
                ground.append(square(column, -row, cells.count((row, column)) / longest))
        way = [(float(column), -float(row)) for row, column in cells]
        start = (Disc(way[0], 0.34, WAY), Disc(way[0], 0.26, "#ffffff"))
        frames = tuple((Disc(at, 0.2, WALKER),) for at in way)
        edge = self.size - 0.5
        return Scene(
            (-0.5, -edge), (edge, 0.5), (*ground, *start, Line(tuple(way), WAY, 2.0)), frames
        )


WAY, WALKER = "#33628f", "#d55e00"


def square(x: float, y: float, share: float) -> Patch:
    """A cell, white where the walk never was and the darker the larger its share of the time."""
    red, green, blue = (round(245 - share * (245 - full)) for full in (140, 185, 222))
    half = 0.47
    sides = ((-half, -half), (half, -half), (half, half), (-half, half))
    points = tuple((x + across, y + up) for across, up in sides)
    return Patch(points, f"#{red:02x}{green:02x}{blue:02x}")


def gridworld_pool(
    n_queries: int = 1000, n_options: int = 2, size: int = 8, length: int = 20, seed: int = 0
) -> QueryPool:
    """The paper's pool: K random walks a query, mean distances to the corners, not normalised.

    Args:
        n_queries: N, at least 1.
        n_options: K, at least 1.
        size: cells along an edge of the Gridworld.
        length: T, cells in a walk.
        seed: fixes the pool.

    Raises:
        InputError: a number is below its minimum.
    """
    return make_pool(GridworldTask(size, length), n_queries, n_options, seed)
