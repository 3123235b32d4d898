import math
from typing import Any

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import chi_square, told
from posterior import posterior
from torch import Generator, Tensor

from benchmarks.posterior import Case, compare, history
from torchrl_pref.beliefs.resampling import kish_share
from torchrl_pref.beliefs.sampled import RESTART_SHARE, Belief, uniform_sphere
from torchrl_pref.beliefs.slice import Target
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.session import Session


class Unknown(ResponseModel):
    """A model that the compiled step does not know."""

    def log_likelihood(self, gaps: Tensor) -> Tensor:
        return Boltzmann(2.0).log_likelihood(gaps)


def grid_of_sphere(n_features: int) -> tuple[Tensor, Tensor]:
    """Points (G D) and weights (G) of a quadrature of the circle or of the sphere, in float64."""
    if n_features == 2:
        angle = torch.arange(20000, dtype=torch.float64) * (2 * math.pi / 20000)
        return torch.stack([angle.cos(), angle.sin()], -1), torch.ones_like(angle)
    # Equal areas: the height is uniform, by the theorem of Archimedes.
    height = (torch.arange(600, dtype=torch.float64) + 0.5) / 300 - 1
    turn = torch.arange(600, dtype=torch.float64) * (2 * math.pi / 600)
    height, turn = torch.meshgrid(height, turn, indexing="ij")
    radius = (1 - height.square()).sqrt()
    points = torch.stack([radius * turn.cos(), radius * turn.sin(), height], -1).flatten(0, 1)
    return points, torch.ones(len(points), dtype=torch.float64)


def exact_moments(model: ResponseModel, queries: Tensor, answers: Tensor) -> tuple[Tensor, Tensor]:
    """Posterior mean (D) and covariance (D D) by brute force over all answers at once."""
    points, weights = grid_of_sphere(queries.shape[-1])
    log_probs = model(torch.einsum("gd,hkd->ghk", points, queries.double()))
    picked = log_probs.gather(-1, answers.expand(len(points), -1).unsqueeze(-1)).squeeze(-1)
    weights = weights * (picked.sum(-1)).exp()
    weights = weights / weights.sum()
    mean = weights @ points
    return mean, (points * weights.unsqueeze(1)).T @ points - torch.outer(mean, mean)


def converse(
    belief: Belief, queries: Tensor, answers: Tensor, sessions: int, generator: Generator
) -> tuple[Tensor, Tensor]:
    """Samples and effective sizes of many sessions that get the same answers (H)."""
    samples = belief.prior(sessions, queries.shape[-1], generator)
    ess = torch.full((sessions,), float(belief.n_samples))
    gaps = feature_gaps(queries, answers)
    for h in range(len(queries)):
        earlier = gaps[:h].expand(sessions, *gaps[:h].shape)
        newest = gaps[h].expand(sessions, *gaps[h].shape)
        update = belief.update(samples, ess, told(earlier, newest), generator)
        assert update.used.all()
        samples, ess = update.samples, update.ess
    return samples, ess


@pytest.mark.parametrize("n_options", [2, 3])
@pytest.mark.parametrize("n_features", [2, 3])
@pytest.mark.parametrize("model", [*RESPONSE_MODELS, Unknown()], ids=str)
def test_moments_agree_with_quadrature(
    model: ResponseModel, n_features: int, n_options: int, generator: Generator
) -> None:
    queries = torch.randn(6, n_options, n_features, generator=generator)
    omega = uniform_sphere((n_features,), generator)
    answers = model(queries @ omega).exp().multinomial(1, generator=generator).squeeze(-1)
    mean, covariance = exact_moments(model, queries, answers)
    sessions = 400 if model in RESPONSE_MODELS else 150  # in tensors, which are slow
    samples, _ = converse(Belief(model), queries, answers, sessions, generator)

    per_session = samples.double().mean(1)
    error = per_session.std(0) / math.sqrt(sessions)
    assert ((per_session.mean(0) - mean).abs() < 5 * error).all()

    # Second moments about the exact mean, so that nothing is lost to the mean's own estimate.
    centred = samples.double() - mean
    moments = torch.einsum("smd,sme->sde", centred, centred) / samples.shape[1]
    error = moments.std(0) / math.sqrt(sessions)
    assert ((moments.mean(0) - covariance).abs() < 5 * error + 1e-12).all()


@pytest.mark.parametrize(
    ("model", "moves"), list(zip(RESPONSE_MODELS, (2, 3), strict=True)), ids=str
)
def test_effective_sample_size_is_what_it_says(
    model: ResponseModel, moves: int, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Var(ω) / ESS is the variance of the mean over independent runs of the same answers."""
    monkeypatch.setattr("torchrl_pref.beliefs.sampled.MAX_ROUNDS", 1)
    queries = torch.randn(3, 2, 4, generator=generator)
    omega = uniform_sphere((4,), generator)
    answers = (queries @ omega).argmax(-1)
    samples, ess = converse(Belief(model, moves=moves), queries, answers, 400, generator)
    true = samples.flatten(0, 1).var(0).sum() / samples.mean(1).var(0).sum()
    assert float(true) < 80  # so few moves leave copies alike: there is something to report
    assert float(ess.mean()) == pytest.approx(float(true), rel=0.15)
    assert ((ess >= 1) & (ess <= 100)).all()


class Still(Belief):
    """Its samples forget nothing."""

    def _move(self, samples: Tensor, target: Target, generator: Generator) -> Tensor:
        return samples


def test_what_was_lost_before_counts_until_it_is_forgotten(generator: Generator) -> None:
    """An answer about options that are alike loses nothing more."""
    belief = Still(Boltzmann(2.0))
    samples, ess = belief.prior(5, 4, generator), torch.tensor([100.0, 80.0, 50.0, 20.0, 5.0])
    alike = told(torch.zeros(5, 0, 1, 4), torch.zeros(5, 1, 4))
    assert torch.allclose(belief.update(samples, ess, alike, generator).ess, ess, rtol=0.01)


@pytest.mark.parametrize(("n_features", "n_options"), [(4, 2), (10, 3)])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_calibration(
    model: ResponseModel, n_features: int, n_options: int, generator: Generator
) -> None:
    """Simulation-based calibration (Talts et al., 2018): the rank of the truth is uniform."""
    sessions, budget = 6_000 // n_features, 8
    belief = Belief(model, samples=99)
    omega = uniform_sphere((sessions, n_features), generator)
    samples = belief.prior(sessions, n_features, generator)
    ess = torch.full((sessions,), 99.0)
    gaps = torch.zeros(sessions, 0, n_options - 1, n_features)
    for _ in range(budget):
        queries = torch.randn(sessions, n_options, n_features, generator=generator)
        log_probs = model((queries @ omega.unsqueeze(-1)).squeeze(-1))
        answers = log_probs.exp().multinomial(1, generator=generator).squeeze(-1)
        newest = feature_gaps(queries, answers)
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        gaps = torch.cat([gaps, newest.unsqueeze(1)], 1)
        # Hard answers never exclude the human who gave them.
        returns = (gaps.flatten(1, 2) @ omega.unsqueeze(-1)).view(gaps.shape[:3])
        assert model.log_likelihood(returns).sum(-1).isfinite().all()
    assert samples.isfinite().all()
    for feature in range(n_features):
        # The samples of a session are not independent, which makes it a little wider.
        assert chi_square((samples[..., feature] < omega[:, None, feature]).sum(1)) < 33.7


CASES = [
    Case(2, 3, 4.5, "contradictory"),
    Case(2, 3, 30.0, "collinear"),  # a needle of the posterior, which grows by ordinary answers
    Case(2, 2, None, "60 answers"),
    Case(4, 5, 4.5, "surprising"),
    Case(4, 5, 30.0, "surprising"),
    Case(4, 2, 30.0, "gaps of 1e3"),
    Case(4, 3, 4.5, "gaps of 1e-4"),
    Case(6, 3, 4.5, "collinear"),
    Case(8, 2, 4.5, "greedy"),
    Case(8, 3, None, "random"),
    Case(16, 2, 4.5, "greedy"),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_samples_agree_with_importance_sampling(case: Case) -> None:
    """Over features, options, noise and odd histories; the benchmark has all of them."""
    gaps = history(case)
    draws = 100_000 if case.features > 6 else 400_000  # each costs more, and says more
    exact = posterior(gaps.double().numpy(), case.tau, draws)
    found = compare(case, gaps, exact, 500 if case.kind == "greedy" else 200)
    assert exact.draws > 5000
    assert found.bias < 0.01 + 3 * found.bias_error
    assert abs(found.variance - 1) < 0.01 + 3 * found.variance_error
    assert found.effective > 60


def test_one_question_answered_both_ways_without_error_is_left_out(generator: Generator) -> None:
    """It could hold on a plane of ties alone."""
    belief, sessions = Belief(Optimal()), 50
    queries = torch.randn(sessions, 3, 5, generator=generator)
    samples, ess = belief.prior(sessions, 5, generator), torch.full((sessions,), 100.0)
    gaps = torch.zeros(sessions, 0, 2, 5)
    for answer, used in ((0, True), (1, False), (0, True), (2, False)):
        newest = feature_gaps(queries, torch.full((sessions,), answer))
        after = belief.update(samples, ess, told(gaps, newest), generator)
        assert (after.used == used).all()
        if used:
            gaps = torch.cat([gaps, newest.unsqueeze(1)], 1)
        else:
            assert torch.equal(after.samples, samples)
        samples, ess = after.samples, after.ess


def test_contradicting_hard_answer_is_left_out(generator: Generator) -> None:
    """Three half-planes whose normals are 120° apart have only the origin in common."""
    turns = torch.arange(3) * (2 * math.pi / 3)
    normals = torch.stack([turns.cos(), turns.sin()], -1)
    gaps = normals.view(3, 1, 1, 2).expand(3, 5, 1, 2)
    belief = Belief(Optimal())
    samples, ess = belief.prior(5, 2, generator), torch.full((5,), 100.0)
    evidence = told(gaps[:0].transpose(0, 1), gaps[0])
    before, ess, used = belief.update(samples, ess, evidence, generator)
    assert used.all()
    evidence = told(gaps[:1].transpose(0, 1), gaps[1])
    before, ess, used = belief.update(before, ess, evidence, generator)
    assert used.all()
    assert (before @ normals[:2].T >= -1e-5).all()
    after = belief.update(before, ess, told(gaps[:2].transpose(0, 1), gaps[2]), generator)
    assert not after.used.any()
    assert torch.equal(after.samples, before)
    assert torch.equal(after.ess, ess)


@pytest.mark.parametrize("model", [*RESPONSE_MODELS, Boltzmann(1e4)], ids=str)
def test_surprising_answers_leave_neither_copies_nor_nan(
    model: ResponseModel, generator: Generator
) -> None:
    """The second answer has a prior probability of about 1 in 500: few or none of 100 agree."""
    angle = math.pi / 250
    normals = torch.tensor([[0.0, 1.0], [math.sin(angle), -math.cos(angle)]])
    queries = torch.stack([normals, torch.zeros(2, 2)], 1) * 3
    samples, ess = converse(Belief(model), queries, torch.tensor([0, 0]), 50, generator)
    assert samples.isfinite().all()
    assert all(len(session.unique(dim=0)) > 50 for session in samples)
    if not isinstance(model, Boltzmann):
        assert (samples @ normals.T >= -1e-5).all()
        assert ess.mean() > 50


def test_soft_answers_are_never_left_out(generator: Generator) -> None:
    """However surprising: a careless human, a belief that thinks them careful."""
    normals = uniform_sphere((12, 2), generator)
    gaps = normals.view(12, 1, 1, 2).expand(12, 20, 1, 2)
    belief = Belief(Boltzmann(1000.0))
    samples, ess = belief.prior(20, 2, generator), torch.full((20,), 100.0)
    for h in range(12):
        evidence = told(gaps[:h].transpose(0, 1), gaps[h])
        samples, ess, used = belief.update(samples, ess, evidence, generator)
        assert used.all()
    assert samples.isfinite().all()


@pytest.mark.parametrize(("n_options", "tau"), [(2, 4.5), (3, 4.5), (5, 0.5), (12, 0.5)])
def test_ordinary_answers_are_no_surprise(
    n_options: int, tau: float, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of twelve options each is unlikely, and to a careless human no answer is ever likely."""
    begun: list[int] = []
    begin_anew = Belief._begin_anew

    def counted(belief: Belief, samples: Tensor, *rest: Any) -> Any:
        begun.append(len(samples))
        return begin_anew(belief, samples, *rest)

    monkeypatch.setattr(Belief, "_begin_anew", counted)
    model, sessions = Boltzmann(tau), 300
    belief = Belief(model)
    omega = uniform_sphere((sessions, 4, 1), generator)
    samples, ess = belief.prior(sessions, 4, generator), torch.full((sessions,), 100.0)
    gaps = torch.zeros(sessions, 0, n_options - 1, 4)
    for _ in range(4):
        queries = torch.randn(sessions, n_options, 4, generator=generator)
        answers = model((queries @ omega).squeeze(-1)).exp().multinomial(1, generator=generator)
        newest = feature_gaps(queries, answers.squeeze(-1))
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        gaps = torch.cat([gaps, newest.unsqueeze(1)], 1)
    assert sum(begun) < 0.1 * 4 * sessions


def test_ties_are_no_surprise_to_a_human_who_never_errs(generator: Generator) -> None:
    """Of twelve alike each has a twelfth, and what was answered before still holds."""
    model, sessions = Optimal(), 20
    queries = torch.zeros(2, 12, 3)
    queries[0] = torch.randn(12, 3, generator=generator)
    samples, ess = converse(Belief(model), queries, torch.tensor([3, 5]), sessions, generator)
    gaps = feature_gaps(queries[:1], torch.tensor([3]))[0]
    assert (samples @ gaps.T >= -1e-5).all()
    assert all(len(session.unique(dim=0)) > 90 for session in samples)
    assert (ess > 60).all()


def test_however_sharp_the_likelihood_a_stage_keeps_enough(generator: Generator) -> None:
    likelihood = -1e13 * torch.rand(40, 100, generator=generator)
    power = Belief(Boltzmann(4.5))._next_power(
        lambda now, to: (to - now).unsqueeze(-1) * likelihood, torch.zeros(40), RESTART_SHARE
    )
    assert (power > 0).all()
    assert (kish_share(power.unsqueeze(1) * likelihood) > RESTART_SHARE - 0.01).all()


def test_on_a_circle_each_mode_holds_what_it_should() -> None:
    """Careful people who now and then slip, and contradict themselves: four modes, by a grid."""
    sessions, tau, lapse = 1000, 30.0, 0.1
    features = torch.randn(40, 2, 2, generator=Generator().manual_seed(2))
    session = Session(features, Boltzmann(tau, lapse=lapse), people=sessions, repeats=True)
    angles = torch.arange(10**5).double() / 10**5 * 2 * math.pi
    omega, log_likelihood = torch.stack([angles.cos(), angles.sin()], -1), torch.zeros(10**5)
    for query, answer in ((0, 0), (0, 1), (0, 0), (0, 1), (1, 0), (1, 0)):
        session.put([query] * sessions)
        session.tell([answer] * sessions)
        gap = (features[query, answer] - features[query, 1 - answer]).double()
        right = (tau * omega @ gap).sigmoid()
        log_likelihood = log_likelihood + ((1 - lapse) * right + lapse / 2).log()
    weights = log_likelihood.softmax(0)
    mean = weights @ omega
    deviation = (weights @ (omega - mean).square().sum(-1)).sqrt()
    off = (session.samples.double().mean((0, 1)) - mean).norm() / deviation
    assert off < 0.025  # .046 with larger steps; its standard error is .004


def test_narrow_posteriors_are_still_explored(generator: Generator) -> None:
    """Fourteen hard answers halve the circle each time: an arc of under a thousandth is left."""
    sessions = 50
    belief = Belief(Optimal(tolerance=0.0))
    samples, ess = belief.prior(sessions, 2, generator), torch.full((sessions,), 100.0)
    gaps = torch.zeros(sessions, 0, 1, 2)
    for h in range(14):
        mean = samples.mean(1)
        normal = torch.stack([-mean[:, 1], mean[:, 0]], -1).unsqueeze(1)
        samples, ess, used = belief.update(samples, ess, told(gaps, normal), generator)
        assert used.all()
        gaps = torch.cat([gaps, normal.unsqueeze(1)], 1)
        assert ess.mean() > 40, h


def test_identical_options_teach_nothing(belief: Belief, generator: Generator) -> None:
    queries = torch.ones(3, 2, 4)
    samples, ess = converse(belief, queries, torch.tensor([0, 1, 0]), 300, generator)
    assert samples.mean((0, 1)).norm() < 5 / math.sqrt(300 * 100)
    assert (ess > 90).all()


def test_permuting_options_permutes_the_answer(generator: Generator) -> None:
    queries = torch.randn(20, 4, 3, generator=generator)
    answers = torch.randint(4, (20,), generator=generator)
    order = torch.randperm(4, generator=generator)
    renamed = (order == answers.unsqueeze(1)).long().argmax(1)
    gaps, other = feature_gaps(queries, answers), feature_gaps(queries[:, order], renamed)
    assert torch.allclose(gaps.sort(1).values, other.sort(1).values)
    assert (feature_gaps(queries, torch.full((20,), -1)) == 0).all()


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_large_batches_lose_no_answer(
    model: ResponseModel, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sessions are moved some at a time, with answers of their own number."""
    monkeypatch.setattr("torchrl_pref.beliefs.sampled.MOVED", 40 * 4 * 10)
    sessions = 37
    belief = Belief(model, samples=40)
    normals = torch.eye(3)
    earlier = torch.zeros(sessions, 3, 1, 3)
    for row, count in enumerate((2, 3)):
        earlier[row::2, 1:count, 0] = normals[: count - 1]
    samples = belief.prior(sessions, 3, generator)
    # A belief that knows its earlier answers, which the step must keep.
    for row, count in enumerate((2, 3)):
        samples[row::2, :, : count - 1] = samples[row::2, :, : count - 1].abs()
    newest = normals[2].expand(sessions, 1, 3)
    ess = torch.full((sessions,), 40.0)
    after, _, used = belief.update(samples, ess, told(earlier, newest), generator)
    assert used.all()
    kept = [(after[row::2, :, :count] >= -1e-5).float().mean() for row, count in enumerate((1, 2))]
    assert min(kept) > (0.999 if isinstance(model, Optimal) else 0.8)
    assert (after[..., 2] >= -1e-5).float().mean() > (0.999 if isinstance(model, Optimal) else 0.8)
    # Every session is where it was: the two kinds differ in the second direction.
    assert after[0::2, :, 1].mean() < 0.15 < after[1::2, :, 1].mean()
