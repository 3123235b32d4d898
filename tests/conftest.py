import os

# Before NumPy and torch are there, which read it once: threads of several test processes that wait
# for each other on the same cores take three times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
import torch
from torch import Generator

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.tasks.gridworld import gridworld_pool

torch.set_num_threads(1)

RESPONSE_MODELS = [Boltzmann(4.4), Optimal()]


@pytest.fixture
def generator() -> Generator:
    return Generator().manual_seed(0)


@pytest.fixture(scope="session")
def pool() -> QueryPool:
    raw = gridworld_pool(60)
    return raw.map_features(Normalizer.fit(raw.features))


@pytest.fixture(params=RESPONSE_MODELS, ids=str)
def belief(request: pytest.FixtureRequest) -> Belief:
    return Belief(request.param)
