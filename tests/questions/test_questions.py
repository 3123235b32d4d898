"""Every kind of question, held to one form: probabilities, evidence, belief, humans, scores."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.base import Answers, Question
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak

OPTIONS = {"choice": (2, 3, 5), "weak": (2,), "ranking": (3,), "best_worst": (4,), "approve": (1,)}
"""About how many options each kind is tried."""

CASES = [
    pytest.param(Boltzmann(tau, kind(), lapse), n_options, id=f"{name}-{tau}-{lapse}-{n_options}")
    for name, kind in QUESTIONS.items()
    for n_options in OPTIONS[name]
    for tau in (0.5, 4.5)
    for lapse in (0.0, 0.1)
]
CASES.append(pytest.param(Optimal(lapse=0.1), 3, id="optimal-lapse"))


class InTensors(ResponseModel):
    """The same model, in a way that no compiled loop knows."""

    def __init__(self, model: Boltzmann) -> None:
        self.model, self.question = model, model.question
        self.lapse, self.scale = model.lapse, model.scale

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        return self.model.log_likelihood(gaps)


def test_every_kind_is_tried() -> None:
    assert set(OPTIONS) == set(QUESTIONS)


@pytest.mark.parametrize(("model", "n_options"), CASES)
def test_answers_are_likely_as_their_evidence_says(
    model: ResponseModel, n_options: int, generator: Generator
) -> None:
    """The probability of an answer is its evidence's likelihood, up to a factor that is its own."""
    omega = uniform_sphere((50, 4), generator)
    query = torch.randn(n_options, 4, generator=generator)
    probs = model(omega @ query.T).exp()
    assert probs.shape == (50, model.n_answers(n_options))
    assert torch.allclose(probs.sum(-1), torch.ones(50), atol=1e-5)
    for answer, expected in enumerate(probs.unbind(-1)):
        evidence = model.evidence(query[None], torch.tensor([answer]))
        gaps = evidence[None].gaps(omega[None])[0]
        found = model.joint_log_likelihood(gaps, evidence.floor).exp()
        ratio = found / expected
        assert torch.allclose(ratio, ratio[:1].expand(50), rtol=1e-4)
    # Which option comes first makes no difference to what is known.
    assert (
        model(omega @ query.flip(0).T)
        .exp()
        .sort(-1)
        .values.allclose(probs.sort(-1).values, atol=1e-5)
    )


@pytest.mark.parametrize(("model", "n_options"), CASES)
def test_no_answer_says_nothing(model: ResponseModel, n_options: int, generator: Generator) -> None:
    options = torch.randn(3, n_options, 4, generator=generator)
    evidence = model.evidence(options, torch.full((3,), -1))
    gaps = evidence[None].gaps(uniform_sphere((1, 20, 4), generator))[0]
    assert (model.joint_log_likelihood(gaps, evidence.floor) == 0).all()
    with pytest.raises(InputError, match="answers from 99"):
        model.evidence(options, torch.full((3,), 99))


def quadrature() -> Tensor:
    """Points (G 3), spread evenly over the sphere, in float64."""
    place = torch.arange(40_000, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * place / len(place), place * math.pi * (1 + math.sqrt(5))
    radius = (1 - height.square()).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), height], -1)


@pytest.mark.parametrize("in_tensors", [False, True], ids=["compiled", "tensors"])
@pytest.mark.parametrize(("model", "n_options"), CASES)
def test_the_posterior_is_that_of_the_probabilities(
    model: ResponseModel, n_options: int, in_tensors: bool, generator: Generator
) -> None:
    """Of three answers once each and the first again, by quadrature over probabilities alone."""
    n_answers = model.n_answers(n_options)
    answers = torch.tensor([*range(min(n_answers, 3)), 0])
    queries = torch.randn(len(answers), n_options, 3, generator=generator)
    if isinstance(model, Boltzmann) and in_tensors:
        model = InTensors(model)
    points = quadrature()
    log_probs = model(torch.einsum("gd,hkd->ghk", points, queries.double()))
    weights = (
        log_probs.gather(-1, answers.expand(len(points), -1)[..., None]).sum((1, 2)).softmax(0)
    )
    mean = weights @ points
    covariance = (points * weights[:, None]).T @ points - torch.outer(mean, mean)
    sessions, belief = 40 if in_tensors else 200, Belief(model)
    samples, ess = belief.prior(sessions, 3, generator), torch.full((sessions,), 100.0)
    for h in range(1, len(queries) + 1):
        evidence = model.evidence(queries[:h], answers[:h]).expand(sessions, h)
        samples, ess, used = belief.update(samples, ess, evidence, generator)
        assert used.all()
    means = samples.double().mean(1)
    error = means.std(0) / math.sqrt(sessions)
    assert ((means.mean(0) - mean).abs() < 5 * error).all()
    spread = (samples.double() - mean).square().sum(-1).mean(1)
    error = spread.std() / math.sqrt(sessions)
    assert (spread.mean() - covariance.trace()).abs() < 5 * error
    assert ess.mean() > 80


@pytest.mark.parametrize(("model", "n_options"), CASES)
def test_humans_answer_as_often_as_they_should(
    model: ResponseModel, n_options: int, generator: Generator
) -> None:
    count = 20_000
    human = SimulatedHuman(model)
    drawn = human.draw(count, 1, model.n_answers(n_options), 2, generator)
    drawn["omega"] = uniform_sphere((2,), generator).expand(count, 2)
    query = torch.randn(n_options, 2, generator=generator)
    answers = human.respond(query.expand(count, -1, -1), drawn, torch.zeros(count).long())
    found = answers.bincount(minlength=model.n_answers(n_options)) / count
    expected = model(query @ drawn["omega"][0]).exp()
    assert ((found - expected).abs() <= 5 * (expected / count).sqrt() + 1e-6).all()


@pytest.mark.parametrize(("model", "n_options"), CASES)
def test_information_is_what_the_probabilities_say(
    model: ResponseModel, n_options: int, generator: Generator
) -> None:
    samples = uniform_sphere((2, 60, 3), generator)
    queries = torch.randn(2, 5, n_options, 3, generator=generator)
    found = score_queries(samples, queries, model, information_gain)
    probs = model(torch.einsum("bckd,bmd->bcmk", queries, samples)).exp().double().numpy()
    probs = np.maximum(probs, 1e-300)
    of_mean = probs.mean(2)
    expected = (probs * np.log2(probs)).sum(-1).mean(2) - (of_mean * np.log2(of_mean)).sum(-1)
    assert np.allclose(found.numpy(), expected, atol=1e-5)
    if n_options == 1:  # which tells something of its return itself
        return
    alike = queries[:, :, :1].expand_as(queries)
    assert score_queries(samples, alike, model, information_gain).abs().max() < 1e-5


@pytest.mark.parametrize(("model", "n_options"), CASES)
@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
def test_sessions_of_every_kind(
    kind: type, model: ResponseModel, n_options: int, generator: Generator
) -> None:
    pool = QueryPool(torch.randn(30, n_options, 3, generator=generator))
    env = kind(pool, SimulatedHuman(model), Belief(model, 40), 8, batch_size=(50,))
    after = env.rollout(40, break_when_any_done=False)["next"]
    assert after["samples"].isfinite().all()
    answers = after["session", "history", "answers"]
    assert set(answers.unique().tolist()) == set(range(-1, model.n_answers(n_options)))


def test_human_and_belief_are_asked_the_same() -> None:
    pool = QueryPool(torch.rand(9, 2, 3))
    human, belief = SimulatedHuman(Boltzmann(2.0, Weak())), Belief(Boltzmann(2.0))
    with pytest.raises(InputError, match=r"Weak\(threshold=1.0\).*Choice\(\)"):
        QueryEnv(pool, human, belief)
    QueryEnv(pool, human, Belief(Boltzmann(1.0, Weak(0.1))))  # the numbers may differ


def test_weak_questions_are_those_of_the_literature(generator: Generator) -> None:
    """FACTS: P(A) = σ(z-δ), P(B) = σ(-z-δ), P(≈) = (e^{2δ} - 1) P(A) P(B)."""
    logits = 3 * torch.randn(20, generator=generator)
    probs = Boltzmann(2.0, Weak(0.7))(torch.stack([logits / 2, torch.zeros(20)], -1)).exp()
    first, second = torch.sigmoid(logits - 0.7), torch.sigmoid(-logits - 0.7)
    equal = math.expm1(1.4) * first * second
    assert torch.allclose(probs, torch.stack([first, second, equal], -1), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Weak(0), "threshold=0"),
        (lambda: Weak().answers(3), "about 3 options: expected 2"),
        (lambda: Choice().answers(1), "options=1"),
        (lambda: Boltzmann(1.0, "weak"), "question of type str"),
        (lambda: Boltzmann(1.0, lapse=1), "lapse=1"),
        (lambda: Optimal(lapse=-0.1), "lapse=-0.1"),
    ],
)
def test_impossible_questions_are_refused(make: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()  # type: ignore[operator]


def test_the_kinds_are_values() -> None:
    assert Weak(0.5) == Weak(0.5) != Weak(0.6)
    assert hash(Weak(0.5)) == hash(Weak(0.5))
    assert isinstance(Weak(), Question)
    assert repr(Boltzmann(2.0, Weak(0.5), 0.1)) == (
        "Boltzmann(tau=2, Weak(threshold=0.5), lapse=0.1)"
    )


class Shouting(Question):
    """Somebody's own, in which the second answer counts too much."""

    def __init__(self, levels: object = 1.0) -> None:
        self.levels = levels

    def answers(self, n_options: int) -> Answers:
        return Choice().answers(n_options)._replace(log_weights=torch.ones(n_options))


def test_tables_of_ones_own_are_looked_at(generator: Generator) -> None:
    """Each has shapes that fit and probabilities that sum to one."""
    options = torch.randn(3, 2, 4, generator=generator)
    answers = torch.zeros(3, dtype=torch.int64)
    with pytest.raises(InputError, match=r"sum to 2.72; expected 1 whatever the returns are"):
        Boltzmann(1.0, Shouting()).evidence(options, answers)
    with pytest.raises(InputError, match="make a list a tuple"):
        Boltzmann(1.0, Shouting([1.0, 2.0])).evidence(options, answers)


def test_answers_of_any_whole_numbers(generator: Generator) -> None:
    options = torch.randn(3, 2, 4, generator=generator)
    model = Boltzmann(1.0, Weak(), lapse=0.1)
    expected = model.evidence(options, torch.tensor([1, 1, 2]))
    found = model.evidence(options, torch.tensor([1, 1, 2], dtype=torch.uint8))
    assert torch.equal(found.floor, expected.floor)
    assert torch.equal(found.rows, expected.rows)
