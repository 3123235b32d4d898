"""What those who come from APReL know to go wrong (docs/aprel.md), and does not here."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Generator, Tensor

from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.acquisition.functions import information_gain, volume_removal
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.objectives import alignment_of_mean
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.prior_evidence import demonstration
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.questions.weak import Weak
from torchrl_pref.session import Session
from torchrl_pref.strategies import STRATEGIES


@pytest.fixture
def samples(generator: Generator) -> Tensor:
    """(1 100 3), a belief that has learned something: all near the first axis."""
    return torch.nn.functional.normalize(
        0.2 * torch.randn(1, 100, 3, generator=generator) + torch.tensor([1.0, 0, 0]), dim=-1
    )


def test_volume_removal_prefers_what_is_uncertain(samples: Tensor) -> None:
    """Of a question whose answer is known and one whose answer is not, APReL asks the first."""
    known, open_one = (
        torch.tensor([[3.0, 0, 0], [-3.0, 0, 0]]),
        torch.tensor([[0, 1.0, 0], [0, -1.0, 0]]),
    )
    queries = torch.stack([known, open_one]).unsqueeze(0)
    scores = score_queries(samples, queries, Boltzmann(4.0), volume_removal)[0]
    assert scores[1] > 0.3 > 0.01 > scores[0]


@pytest.mark.parametrize("name", ACQUISITIONS)
def test_nothing_is_nan_where_probabilities_underflow(name: str, samples: Tensor) -> None:
    queries = torch.tensor([[[3.0, 0, 0], [-3.0, 0, 0]], [[0, 1.0, 0], [0, -1.0, 0]]]).unsqueeze(0)
    scores = score_queries(samples, queries, Boltzmann(1e5), ACQUISITIONS[name])[0]
    assert scores.isfinite().all()
    assert scores[1] > scores[0]


def test_answers_that_are_certain_carry_no_information(samples: Tensor) -> None:
    queries = torch.tensor([[[3.0, 0, 0], [-3.0, 0, 0]]]).unsqueeze(0)
    assert float(score_queries(samples, queries, Boltzmann(1e5), information_gain)) == 0.0


def test_about_equal_can_be_answered() -> None:
    features = torch.randn(20, 2, 3, generator=Generator().manual_seed(1))
    session = Session(features, Boltzmann(2.0, Weak(0.5)))
    assert session.answers == ("the first", "the second", "about equal")
    session.ask()
    session.tell(2)
    assert session.n_answered == 1


@pytest.mark.parametrize("shift", [0.0, -100.0])
def test_regret_needs_no_rewards_above_zero(shift: float, samples: Tensor) -> None:
    """It is a difference: what all options have in common makes none."""
    queries = torch.randn(1, 30, 2, 3, generator=Generator().manual_seed(2))
    moved = queries + torch.tensor([shift, 0, 0])
    regret = ACQUISITIONS["max_regret"]
    first, second = (
        score_queries(samples, each, Boltzmann(2.0), regret) for each in (queries, moved)
    )
    assert (first >= 0).all()
    assert torch.allclose(first, second, atol=1e-3)


@pytest.mark.parametrize("name", ["max_regret", "disagreement", "thompson"])
def test_they_run_and_learn(name: str, pool: QueryPool) -> None:
    """APReL's stop with today's NumPy."""
    model = Boltzmann(4.4)
    env = QueryEnv(pool, SimulatedHuman(model), Belief(model), 8, batch_size=(40,), seed=0)
    data = env.rollout(8, STRATEGIES[name](env))
    before, after = (
        alignment_of_mean(samples, data["human", "omega"][:, 0]).mean()
        for samples in (data["samples"][:, 0], data["next", "samples"][:, -1])
    )
    assert float(before) < 0.2
    assert float(after) > 0.5


def test_samples_are_worth_what_they_are(generator: Generator) -> None:
    """Of 100 samples of APReL's chain after 20 answers, six count."""
    model = Boltzmann(4.5)
    omega = uniform_sphere((3,), generator)
    session = Session(torch.randn(200, 2, 3, generator=generator), model, "information_gain")
    sizes = []
    for _ in range(20):
        session.tell(int((session.ask().features @ omega).argmax()))
        sizes.append(float(session._states[-1]["ess"]))
    assert min(sizes) > 60


def test_a_demonstration_is_a_probability() -> None:
    """However large its features are, what is shown beside it counts as much."""
    options = 50 * torch.randn(11, 3, generator=Generator().manual_seed(3))
    told = [demonstration(options[0], options[1:]), demonstration(options[0] + 7, options[1:] + 7)]
    features = torch.randn(20, 2, 3, generator=Generator().manual_seed(1))
    first, second = (Session(features, Boltzmann(0.1), given=[each]) for each in told)
    assert torch.allclose(first.samples, second.samples, atol=1e-3)


def test_no_question_comes_twice() -> None:
    session = Session(torch.randn(30, 2, 3, generator=Generator().manual_seed(1)), Boltzmann(1.0))
    asked = []
    for turn in range(20):
        asked.append(int(session.ask().query))
        session.tell(turn % 2)
    assert len({*asked}) == 20
    assert math.isfinite(float(session.expected_alignment[-1]))
