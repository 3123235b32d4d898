"""What every task keeps to: the package's, and one written outside of it."""

from collections.abc import Callable

import my_task
import pytest
import torch

from torchrl_pref.errors import InputError
from torchrl_pref.pool import Normalizer
from torchrl_pref.tasks import TASKS
from torchrl_pref.tasks.base import Task, make_pool
from torchrl_pref.tasks.gridworld import GridworldTask, gridworld_pool

MAKE = [*TASKS.values(), my_task.Table]


@pytest.mark.parametrize("make", MAKE)
def test_a_seed_fixes_the_trajectories(make: Callable[[], Task]) -> None:
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first, again = make().trajectories(20, 5), make().trajectories(20, 5)
    assert torch.equal(first, again)
    assert not torch.equal(first, make().trajectories(20, 6))
    assert torch.equal(torch.get_rng_state(), state)  # nobody else's luck is used


@pytest.mark.parametrize("make", MAKE)
def test_features_have_names_and_vary(make: Callable[[], Task]) -> None:
    task = make()
    trajectories = task.trajectories(60, 0)
    features = task.features(trajectories)
    assert features.shape == (60, len(task.feature_names))
    assert len(set(task.feature_names)) == len(task.feature_names)
    Normalizer.fit(features)  # finite, and each varies
    singles = torch.stack([task.features(one) for one in trajectories])
    assert torch.allclose(features, singles, atol=1e-6)
    pairs = task.features(trajectories.unflatten(0, (30, 2)))
    assert torch.equal(pairs.flatten(0, 1), features)


@pytest.mark.parametrize("make", MAKE)
def test_pools(make: Callable[[], Task]) -> None:
    pool = make_pool(make(), 7, 3, seed=1)
    assert pool.features.shape[:2] == (7, 3)
    assert pool.trajectories is not None
    assert torch.allclose(make().features(pool.trajectories), pool.features)
    for bad in ((0, 2), (5, 1)):
        with pytest.raises(InputError):
            make_pool(make(), *bad, seed=0)


def test_the_gridworlds_pool_is_the_tasks() -> None:
    assert gridworld_pool(9, 2, 5, 7, 3).digest == make_pool(GridworldTask(5, 7), 9, 2, 3).digest
