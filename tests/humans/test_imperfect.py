"""Humans who are not the belief's, each against its definition in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import settings_of
from torch import Generator, Tensor

from torchrl_pref.build import make_pools, make_query_env, make_task, weigh_steps
from torchrl_pref.errors import InputError
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.humans.drifting import Drifting
from torchrl_pref.humans.imperfect import Myopic, Skipping, Undecided
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.gridworld import GridworldTask

COUNT = 20_000


def asked(generator: Generator) -> tuple[Tensor, Tensor]:
    """Queries (B 2 4), and turns (B), the first."""
    return torch.randn(COUNT, 2, 4, generator=generator), torch.zeros(COUNT, dtype=torch.int64)


@pytest.mark.parametrize("threshold", [-0.5, 0.0, 0.3])
def test_who_skips_refuses_what_is_poor(threshold: float, generator: Generator) -> None:
    human = Skipping(Boltzmann(2.0), threshold)
    drawn = human.draw(COUNT, 1, 2, 4, generator)
    queries, turn = asked(generator)
    answers = human.respond(queries, drawn, turn)
    returns = np.einsum("bkd,bd->bk", queries.numpy(), drawn["omega"].numpy())
    assert np.array_equal(answers.numpy() == REFUSED, (returns < threshold).all(1))
    said = answers != REFUSED
    plain = SimulatedHuman(Boltzmann(2.0)).respond(queries, drawn, turn)
    assert torch.equal(answers[said], plain[said])


def test_who_is_undecided_calls_equal_what_is_within_the_threshold(generator: Generator) -> None:
    tau, threshold, lapse = 2.0, 0.8, 0.2
    human = Undecided(Boltzmann(tau, Weak(1.0), lapse), threshold)
    drawn = human.draw(COUNT, 1, 3, 4, generator)
    queries, turn = asked(generator)
    answers = human.respond(queries, drawn, turn).numpy()
    returns = np.einsum("bkd,bd->bk", queries.numpy(), drawn["omega"].numpy())
    gap = tau * (returns[:, 0] - returns[:, 1])
    clear = np.abs(np.abs(gap) - threshold) > 1e-5
    assert np.array_equal((answers == 2)[clear], (np.abs(gap) < threshold)[clear])
    # Of the rest as many as a Boltzmann human with lapses picks, in three bands of the gap.
    for low, high in ((0.8, 1.5), (1.5, 3.0), (3.0, 20.0)):
        band = (np.abs(gap) > low) & (np.abs(gap) < high)
        expected = (1 - lapse) / (1 + np.exp(-np.abs(gap[band]))) + lapse / 2
        found = (answers[band] == (gap[band] < 0)).mean()
        assert found == pytest.approx(expected.mean(), abs=5 * 0.5 / band.sum() ** 0.5)


def test_who_drifts_walks_to_where_they_end(generator: Generator) -> None:
    drift, budget = 0.2, 10
    human = Drifting(Optimal(), drift)
    drawn = human.draw(COUNT, budget, 2, 4, generator)
    places = drawn["omega"].unsqueeze(1) + drawn["walk"]
    places = (places / places.norm(dim=-1, keepdim=True)).double()
    assert torch.allclose(places[:, -1], drawn["omega"].double(), atol=1e-6)
    last_turn = (places[:, -1] * places[:, -2]).sum(-1).clamp(max=1).acos()
    assert float(last_turn.square().mean().sqrt()) == pytest.approx(drift, rel=0.06)
    # What is added grows like a random walk: its variance with the number of steps.
    variance = drawn["walk"].square().sum(-1).mean(0).flip(0) / (drift**2 * 4 / 3)
    assert torch.allclose(variance, torch.arange(budget).float(), rtol=0.05)
    queries, _ = asked(generator)
    for turn in (0, 4, 9):
        answers = human.respond(queries, drawn, torch.full((COUNT,), turn))
        returns = np.einsum("bkd,bd->bk", queries.double().numpy(), places[:, turn].numpy())
        assert (answers.numpy() == returns.argmax(1)).mean() > 0.9999


def test_who_is_myopic_sees_the_end() -> None:
    """The pool's features are means of the steps'; theirs weigh step t of T by discount^(T-t)."""
    human, task = Myopic(Optimal(), 0.5), GridworldTask(5, 4)
    walks = task.trajectories(6, seed=0)
    steps = task.step_features(walks)
    assert torch.allclose(steps.mean(-2), task.features(walks))
    corners = np.array([[0, 0], [0, 4], [4, 0], [4, 4]])
    distances = np.sqrt(np.square(walks.numpy()[:, :, None] - corners).sum(-1))
    assert np.allclose(steps.numpy(), distances, atol=1e-6)
    weights = human.step_weights(4)
    assert np.allclose(weights.numpy(), np.array([1, 2, 4, 8]) / 15)

    settings = settings_of("query")
    settings["human"] = {"name": "myopic", "discount": 0.5, "tau": None, "lapse": 0.0}
    problem = make_task(*make_pools(settings), "optimal", settings)
    env = make_query_env(settings, problem, problem.test, 7, seed=0)
    walks = problem.test.trajectories
    assert walks is not None
    ends = 0.5 ** np.arange(19, -1, -1)
    own = GridworldTask().step_features(walks).numpy()
    expected = np.einsum("t,nktd->nkd", ends / ends.sum(), own)
    expected = (expected - problem.normalizer.mean.numpy()) / problem.normalizer.std.numpy()
    assert np.allclose(env.seen.numpy(), expected, atol=1e-4)
    start = env.reset()
    answers = env.step(start.set("action", torch.arange(7)))["next", "session", "history"]
    returns = np.einsum("bkd,bd->bk", expected[:7], start["human", "omega"].numpy())
    assert np.array_equal(answers["answers"][:, 0].numpy(), returns.argmax(1))
    assert torch.equal(answers["options"][:, 0], problem.test.features[:7])


class Whole(Task):
    """Of somebody who knows trajectories as a whole alone."""

    feature_names = ("a", "b")

    def trajectories(self, count: int, seed: int) -> Tensor:
        return torch.rand(count, 3, generator=Generator().manual_seed(seed))

    def features(self, trajectories: Tensor) -> Tensor:
        return trajectories[..., :2]


def test_steps_that_nobody_knows_are_refused() -> None:
    with pytest.raises(InputError, match="Whole has features of whole trajectories alone"):
        Whole().step_features(Whole().trajectories(2, 0))
    settings = settings_of("query")
    pool = make_pools(settings)[0]
    without = type(pool)(pool.features)
    with pytest.raises(InputError, match="which only a task tells"):
        weigh_steps(settings, Myopic(Optimal()), without)
    assert weigh_steps(settings, SimulatedHuman(Optimal()), without) is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Skipping(Optimal(), float("nan")), "threshold=nan"),
        (lambda: Undecided(Boltzmann(1.0, Choice())), "expected question=weak"),
        (lambda: Undecided(Boltzmann(1.0, Weak()), -1), "threshold=-1"),
        (lambda: Myopic(Optimal(), 0), "discount=0"),
        (lambda: Myopic(Optimal(), 1.1), "discount=1.1"),
        (lambda: Drifting(Optimal(), -0.1), "drift=-0.1"),
    ],
)
def test_impossible_humans_are_refused(make: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()  # type: ignore[operator]


def test_a_tau_of_their_own_and_what_a_title_says() -> None:
    """The human answers by theirs and the belief expects the other; titles tell both."""
    settings = settings_of("query")
    pools = make_pools(settings)
    plain = make_task(*pools, 4.0, settings)
    assert plain.title == "noisy human (tau=4)"
    settings["human"]["tau"] = 0.5
    other = make_task(*pools, 4.0, settings)
    assert (repr(other.human_model), repr(other.response_model)) == (
        "Boltzmann(tau=0.5)",
        "Boltzmann(tau=4)",
    )
    assert other.title == "noisy human (tau=0.5); assumed tau=4"
    assert make_task(*pools, "optimal", settings).title == "noisy human (tau=0.5); assumed optimal"
    settings["human"] = {"name": "drifting", "drift": 0.1, "tau": "optimal", "lapse": 0.1}
    settings["question"] = {"name": "choice"}
    settings["belief"]["lapse"] = 0.05
    found = make_task(*pools, 4.0, settings).title
    assert found == "optimal human (lapse=0.1), drifting drift=0.1; assumed tau=4, lapse=0.05"
    settings = settings_of("query")
    settings["task"], settings["belief"]["name"] = {"name": "driver"}, "rationality"
    settings["question"] = {"name": "weak", "threshold": 1.0}
    found = make_task(*pools, 4.0, settings).title
    assert found == "driver, noisy human (tau=4), weak questions threshold=1.0; tau inferred"
