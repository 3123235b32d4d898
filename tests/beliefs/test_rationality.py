"""A belief that infers tau and a lapse rate with ω, against importance sampling and by SBC."""

import math

import numpy as np
import pytest
import torch
from helpers import chi_square
from reference import answer_probs
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import score_in_tensors, score_queries
from torchrl_pref.beliefs.lapses import RATES, SHARES
from torchrl_pref.beliefs.rationality import (
    RationalityBelief,
    compiled_lengths,
    move_lengths,
    tensor_lengths,
)
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.beliefs.slice import ARC, MAX_SHRINKS, Target, compiled_moves, tensor_moves
from torchrl_pref.envs.transition import begin, hear, tell
from torchrl_pref.errors import InputError
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.best_worst import BestWorst
from torchrl_pref.questions.prior_evidence import Given, evidence_of
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.session import Session
from torchrl_pref.tensors import directions, lengths

MODELS = [Boltzmann(2.0), Boltzmann(4.0, lapse=0.1)]


def let_in(
    belief: RationalityBelief, options: Tensor, answers: Tensor, generator: Generator
) -> Tensor:
    """Samples (S M D) after answers (S H) to options (S H K D)."""
    size, n_answers = answers.shape
    samples = belief.prior(size, options.shape[-1], generator)
    ess = torch.full((size,), float(belief.n_samples))
    for h in range(1, n_answers + 1):
        evidence = belief.response_model.evidence(options[:, :h], answers[:, :h])
        samples, ess, used = belief.update(samples, ess, evidence, generator)
        assert used.all()
        assert ((ess >= 1) & (ess <= belief.n_samples)).all()
    return samples


CALIBRATED = [
    (MODELS[0], 3, 2, 500),
    (MODELS[1], 3, 2, 500),
    (Boltzmann(2.0, lapse=0.1), 8, 2, 200),
    (Boltzmann(2.0, Weak(), lapse=0.1), 2, 2, 200),
    (Boltzmann(2.0, Ranking()), 6, 3, 200),
    (Boltzmann(2.0, BestWorst(), lapse=0.1), 3, 4, 200),
    (Boltzmann(2.0, Approve()), 4, 1, 200),
]
"""Model, features, options and people."""


@pytest.mark.parametrize(("model", "n_features", "n_options", "sessions"), CALIBRATED, ids=str)
def test_calibration(
    model: Boltzmann, n_features: int, n_options: int, sessions: int, generator: Generator
) -> None:
    """Simulation-based calibration of ω and ln tau, for people whom the prior itself makes."""
    n_answers, spread = 6, 5.0
    belief = RationalityBelief(model, spread, samples=99)
    omega = uniform_sphere((sessions, n_features), generator)
    log_s = torch.randn(sessions, generator=generator) * math.log(spread)
    rates = model.lapse * torch.tensor(RATES)
    rate = rates[torch.tensor(SHARES).multinomial(sessions, replacement=True, generator=generator)]
    options = torch.randn(sessions, n_answers, n_options, n_features, generator=generator)
    returns = (options @ omega[:, None, :, None]).squeeze(-1) * log_s.exp()[:, None, None]
    sincere = Boltzmann(model.tau, model.question)(returns).exp()
    likely = (1 - rate[:, None, None]) * sincere + rate[:, None, None] / sincere.shape[-1]
    answers = likely.flatten(0, 1).multinomial(1, generator=generator).view(sessions, n_answers)
    samples = let_in(belief, options, answers, generator)
    ranks = [(directions(samples)[..., d] < omega[:, None, d]).sum(1) for d in range(n_features)]
    ranks.append((samples.norm(dim=-1).log() < log_s[:, None]).sum(1))
    for rank in ranks:
        assert chi_square(rank) < 33.7


def reference(
    options: Tensor,
    answers: Tensor,
    model: Boltzmann,
    spread: float,
    shown: Tensor | None = None,
    draws: int = 400_000,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of (ω, ln s) after answers (H), and what was shown (G J D), by importance
    sampling in NumPy."""
    rng = np.random.default_rng(0)
    omega = rng.standard_normal((draws, options.shape[-1]))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    log_s = rng.normal(0, np.log(spread), draws)
    rate = model.lapse * rng.choice(RATES, draws, p=SHARES)
    log_weights = np.zeros(draws)
    for pair, answer in zip(options.double().numpy(), answers.tolist(), strict=True):
        lead = (pair[answer] - pair[1 - answer]) @ omega.T
        sincere = np.exp(-np.logaddexp(0, -model.tau * np.exp(log_s) * lead))
        log_weights += np.log((1 - rate) * sincere + rate / 2 + 1e-300)
    for rows in [] if shown is None else shown.double().numpy():
        others = np.logaddexp.reduce(-model.tau * np.exp(log_s) * (rows @ omega.T))
        log_weights -= np.logaddexp(0, others)  # no lapse: nobody shows at random
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    assert 1 / np.square(weights).sum() > 3000
    values = np.concatenate([omega, log_s[:, None]], 1)
    mean = weights @ values
    return mean, weights @ np.square(values - mean)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("model", [Boltzmann(4.0), Boltzmann(4.0, lapse=0.1)], ids=str)
def test_samples_agree_with_importance_sampling(
    model: Boltzmann, turned: bool, generator: Generator
) -> None:
    """As a careful person answers; and where at last they answer quite otherwise."""
    options = torch.randn(9, 2, 3, generator=generator)
    answers = (options @ uniform_sphere((3,), generator)).argmax(-1)
    if turned:
        options[6:], answers[6:] = 2 * options[:3], 1 - answers[:3]
    mean, variance = reference(options, answers, model, 3.0)
    sessions = 150
    shown = options.expand(sessions, -1, -1, -1), answers.expand(sessions, -1)
    samples = let_in(RationalityBelief(model), *shown, generator)
    log_s = samples.norm(dim=-1, keepdim=True).log()
    values = torch.cat([directions(samples), log_s], -1).double().numpy()
    sd = np.sqrt(variance)
    error = values.mean(1).std(0) / math.sqrt(sessions) / sd
    assert (np.abs(values.mean((0, 1)) - mean) / sd < 0.03 + 4 * error).all()
    assert (error**2 < 1 / 50 / sessions).all()  # the samples are worth at least 50 of their 100
    assert np.abs(np.square(values - mean).mean((0, 1)) / variance - 1).max() < 0.08


@pytest.mark.parametrize("model", [Boltzmann(2.0), Boltzmann(2.0, lapse=0.2)], ids=str)
def test_demonstrations_agree_with_importance_sampling(
    model: Boltzmann, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was shown is no lapse, and counts whatever the lapse rate is believed to be."""
    options = torch.randn(4, 2, 3, generator=generator)
    omega = uniform_sphere((3,), generator)
    answers = (options @ omega).argmax(-1)
    rows = torch.randn(3, 4, 3, generator=generator)
    rows *= (rows @ omega).sum(-1, keepdim=True).sign().unsqueeze(-1)
    mean, variance = reference(options, answers, model, 3.0, rows)
    # Without moves, which would mend them, the samples must be right when they are reweighted.
    monkeypatch.setattr(RationalityBelief, "_move", lambda self, samples, *_: samples)
    sessions, belief = 20, RationalityBelief(model, samples=4000)
    given: Given = {
        "rows": rows.expand(sessions, -1, -1, -1),
        "offsets": torch.zeros(sessions, 3, 4),
    }
    start = begin(belief.prior(sessions, 3, generator), 4, 2)
    session = hear(belief, start, given, generator)
    for shown, answer in zip(options, answers, strict=True):
        asked = shown.expand(sessions, -1, -1), answer.expand(sessions)
        session = tell(belief, session, *asked, torch.zeros(sessions).long(), generator)
    samples = session["samples"]
    log_s = samples.norm(dim=-1, keepdim=True).log()
    values = torch.cat([directions(samples), log_s], -1).double().numpy()
    sd = np.sqrt(variance)
    error = values.mean(1).std(0) / math.sqrt(sessions) / sd
    assert (np.abs(values.mean((0, 1)) - mean) / sd < 0.03 + 4 * error).all()
    assert np.abs(np.square(values - mean).mean((0, 1)) / variance - 1).max() < 0.08


@pytest.mark.parametrize("model", [Boltzmann(2.0), Boltzmann(2.0, lapse=0.2)], ids=str)
def test_what_was_shown_weighs_as_if_nobody_lapsed(model: Boltzmann, generator: Generator) -> None:
    belief = RationalityBelief(model)
    samples = belief.prior(2, 3, generator)
    rows = torch.randn(2, 1, 4, 3, generator=generator)
    evidence = evidence_of({"rows": rows, "offsets": torch.zeros(2, 1, 4)})
    returns = np.einsum("smd,sgjd->smj", samples.double(), rows.double())
    likely = -np.log1p(np.exp(-2.0 * returns).sum(-1))
    likelihood = belief._likelihood(samples, evidence[:, -1])
    found = belief._foreseen(samples, evidence, likelihood).numpy()
    assert np.allclose(found, likely, atol=1e-4)


@pytest.mark.parametrize("model", [Boltzmann(3.0), Boltzmann(3.0, lapse=0.2)], ids=str)
def test_compiled_moves_count_by_the_same_scales(model: Boltzmann, generator: Generator) -> None:
    size, n_samples = 20, 50
    samples = uniform_sphere((size, n_samples, 3), generator)
    options = torch.randn(size, 7, 2, 3, generator=generator)
    evidence = model.evidence(options, torch.randint(0, 2, (size, 7), generator=generator))
    poles = 0.3 * torch.randn(2, size, 5, 3, generator=generator)
    uniform = torch.rand(2, size, n_samples, 2 + MAX_SHRINKS, generator=generator)
    scales = 4 * torch.rand(size, 2, n_samples, generator=generator)
    slack, power = torch.rand(size, generator=generator) / 10, torch.full((size,), 0.7)
    target = Target(evidence, slack, power, model, scales)
    given = evidence.rows, evidence.offsets, evidence.floor, scales, slack, power
    compiled = compiled_moves(samples, poles, uniform, *given, ARC, model.tau, 0.0)
    expected = tensor_moves(samples, poles, uniform, target)
    assert ((compiled - expected).norm(dim=-1) < 1e-3).float().mean() > 0.99
    plain = tensor_moves(samples, poles, uniform, target._replace(scales=None))
    assert ((plain - expected).norm(dim=-1) < 1e-3).float().mean() < 0.8


@pytest.mark.parametrize(
    "model",
    [Boltzmann(3.0), Boltzmann(3.0, lapse=0.2), Boltzmann(2.0, Weak(1.0)), Boltzmann(40.0)],
    ids=str,
)
def test_compiled_lengths_are_those_in_tensors(model: Boltzmann, generator: Generator) -> None:
    """With answers that were not given among them, some not at all, and a power of the density."""
    size, n_samples, deviation = 20, 50, 1.1
    omega = uniform_sphere((size, n_samples, 3), generator)
    options = torch.randn(size, 7, 2, 3, generator=generator)
    answers = torch.randint(-1, 2, (size, 7), generator=generator)
    answers[:, -1] = 1
    scales = 0.01 + 4 * torch.rand(size, 2, n_samples, generator=generator)
    slack, power = torch.rand(size, generator=generator) / 10, torch.full((size,), 0.7)
    target = Target(model.evidence(options, answers), slack, power, model, scales)
    uniform = torch.rand(size, n_samples, 1 + MAX_SHRINKS, generator=generator)
    compiled = compiled_lengths(omega, uniform, target, deviation, model.tau)
    expected = tensor_lengths(omega, uniform, target, deviation)
    assert ((compiled / expected - 1).abs() < 1e-3).float().mean() > 0.99
    assert torch.equal(move_lengths(omega, uniform, target, deviation), compiled)
    moved = (compiled.squeeze(-1) / scales[:, 0]).log().abs()
    assert float(moved.mean()) > 0.3


def test_scores_take_returns_from_samples_and_directions_for_alignment(
    generator: Generator,
) -> None:
    samples = RationalityBelief(Boltzmann(2.0), samples=40).prior(2, 3, generator)
    queries = torch.randn(2, 6, 2, 3, generator=generator)
    omega = (samples / samples.norm(dim=-1, keepdim=True)).double().numpy()
    for s, c in np.ndindex(2, 6):
        shown = queries[s, c].double().numpy()
        table = np.array([answer_probs(shown @ w, 2.0) for w in samples[s].double().numpy()])
        of_answer = table.mean(0)
        means = table.T @ omega[s] / 40 / of_answer[:, None]
        gain = of_answer @ np.square(means).sum(1) - np.square(omega[s].mean(0)).sum()
        bits = np.log2(np.maximum(table, 1e-300))
        information = (table * (bits - np.log2(of_answer))).sum(1).mean()
        for function, expected in ((alignment_gain, gain), (information_gain, information)):
            given = samples, queries, Boltzmann(2.0), function
            assert float(score_queries(*given)[s, c]) == pytest.approx(expected, abs=2e-5)
            assert float(score_in_tensors(*given)[s, c]) == pytest.approx(expected, abs=2e-5)


def test_directions_leave_unit_vectors_as_they_are(generator: Generator) -> None:
    unit = uniform_sphere((1000, 7), generator)
    assert torch.equal(directions(unit), unit)
    assert torch.equal(lengths(unit), torch.ones(1000, 1))
    assert torch.allclose(directions(3 * unit), unit, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "spread", "message"),
    [
        (Optimal(), 16.0, "never errs"),
        (Boltzmann(1.0), 0.5, "belief.spread=0.5"),
        (Boltzmann(1.0, lapse=0.25), 16.0, "lapse=0.25"),
    ],
)
def test_what_cannot_be_inferred_is_refused(
    model: ResponseModel, spread: float, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        RationalityBelief(model, spread)


@pytest.mark.parametrize("care", [0.25, 8.0])
def test_a_session_tells_how_careful_the_person_is(care: float, generator: Generator) -> None:
    model, omega = Boltzmann(4.0), torch.tensor([0.6, 0.0, 0.8])
    options = torch.randn(200, 2, 3, generator=generator)
    session = Session(options, model, "random", RationalityBelief(model), budget=60)
    for _ in range(60):
        chances = (4.0 * care * session.ask().features @ omega).softmax(-1)
        session.tell(int(chances.multinomial(1, generator=generator)))
    median, low, high = session.rationality.tolist()
    assert low < 4.0 * care < high
    assert low < median < high < 4.0 * care * 6
    assert session.weights.mean.norm() <= 1
    assert torch.equal(Session(options, model).rationality, torch.full((3,), 4.0))
    with pytest.raises(InputError, match="never errs"):
        _ = Session(options, Optimal()).rationality
