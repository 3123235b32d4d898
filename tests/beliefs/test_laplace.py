"""The Gaussian belief: its mode and curvature by autograd, and beside the samples."""

import math
from typing import Any

import pytest
import torch
from helpers import chi_square
from torch import Generator, Tensor

from torchrl_pref.beliefs import laplace
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.laplace import LaplaceBelief, find_mode, rows_there
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.best_worst import BestWorst
from torchrl_pref.questions.prior_evidence import evidence_of, joined
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.questions.weak import Weak

D = 6


@pytest.mark.parametrize(
    ("model", "n_options"),
    [(Boltzmann(4.5), 2), (Boltzmann(4.5), 4), (Boltzmann(2.0, Weak(0.3), lapse=0.1), 2)],
    ids=str,
)
def test_newton_finds_the_mode(model: Boltzmann, n_options: int, generator: Generator) -> None:
    options = torch.randn(3, 8, n_options, D, generator=generator)
    answers = torch.randint(0, 2, (3, 8), generator=generator)
    answers[:, 2] = -1
    evidence = model.evidence(options, answers).double()
    there = rows_there(evidence)
    assert (there // evidence.offsets[0, 0].numel() != 2).all()
    found = find_mode(evidence.rows.flatten(1, -2)[:, there], there, evidence, model)
    for s in range(3):

        def log_posterior(omega: Tensor, s: int = s) -> Tensor:
            gaps = evidence.rows[s] @ omega + evidence.offsets[s]
            likelihood = model.answer_log_likelihood(gaps, evidence.floor[s]).sum()
            return likelihood - D / 2 * omega.square().sum()

        omega = found.mode[s].clone().requires_grad_()
        (slope,) = torch.autograd.grad(log_posterior(omega), omega)
        assert slope.abs().max() < 1e-3
        if not model.lapse:
            hessian = torch.autograd.functional.hessian(log_posterior, omega.detach())
            seen = found.roots[s].T @ evidence.rows[s].flatten(0, -2)[there]
            curvature = D * torch.eye(D).double() + seen.T @ seen
            assert torch.allclose(curvature, -hessian, atol=1e-8)


def test_samples_have_the_gaussian_s_moments(generator: Generator) -> None:
    """Against draws by a D times D Cholesky factor, put out and stretched in the same way."""
    model, sessions = Boltzmann(4.5), 500
    options = torch.randn(1, 8, 2, D, generator=generator)
    answers = (options @ uniform_sphere((D,), generator)).argmax(-1)
    evidence = model.evidence(options, answers)
    rows = evidence.rows.flatten(1, -2).double()
    found = find_mode(rows, rows_there(evidence), evidence, model)
    seen = found.roots[0].T @ rows[0]
    covariance = torch.linalg.inv(D * torch.eye(D).double() + seen.T @ seen)
    length = math.sqrt(1 - float(covariance.trace()))
    centre = found.mode[0] / found.mode[0].norm() * length
    normal = torch.randn(50_000, D, generator=generator).double()
    exact = centre + normal @ torch.linalg.cholesky(covariance).T
    exact /= exact.norm(dim=-1, keepdim=True)
    belief = LaplaceBelief(model)
    many = evidence.expand(sessions, 8)
    samples = belief.update(
        belief.prior(sessions, D, generator), torch.full((sessions,), 100.0), many, generator
    ).samples.double()
    assert torch.allclose(samples.mean((0, 1)), exact.mean(0), atol=0.01)
    centred, expected = samples - exact.mean(0), exact - exact.mean(0)
    second = torch.einsum("smd,sme->de", centred, centred) / sessions / 100
    assert torch.allclose(second, expected.T @ expected / len(exact), atol=0.005)


def after(
    belief: BeliefBase, options: Tensor, answers: Tensor, at_once: bool
) -> tuple[Tensor, Tensor]:
    """Samples after answers (S H), and their mean."""
    generator = Generator().manual_seed(1)
    samples = belief.prior(len(answers), options.shape[-1], generator)
    ess = torch.full((len(answers),), 100.0)
    n_answers = answers.shape[1]
    for h in range(n_answers if at_once else 1, n_answers + 1):
        evidence = belief.response_model.evidence(options[:, :h], answers[:, :h])
        samples, ess, _ = belief.update(samples, ess, evidence, generator)
    return samples, samples.mean(1)


@pytest.mark.parametrize("n_features", [4, 8])
def test_it_is_near_to_the_samples(n_features: int, generator: Generator) -> None:
    model, sessions = Boltzmann(2.0), 200
    omega = uniform_sphere((sessions, n_features), generator)
    options = torch.randn(sessions, 12, 2, n_features, generator=generator)
    chances = model((options @ omega[:, None, :, None]).squeeze(-1)).exp().flatten(0, 1)
    answers = chances.multinomial(1, generator=generator).view(sessions, 12)
    _, right = after(Belief(model), options, answers, at_once=False)
    samples, mean = after(LaplaceBelief(model), options, answers, at_once=True)
    cosines = [torch.cosine_similarity(each, omega).mean() for each in (mean, right)]
    assert cosines[0] > cosines[1] - 0.015
    shown = torch.randn(sessions, n_features, 1, generator=generator)
    low, high = torch.quantile((samples @ shown).squeeze(-1), torch.tensor([0.1, 0.9]), dim=1)
    true = (omega * shown.squeeze(-1)).sum(-1)
    assert float(((low < true) & (true < high)).float().mean()) == pytest.approx(0.8, abs=0.08)


@pytest.mark.parametrize(
    ("model", "n_features", "n_options", "least"),
    [
        (Boltzmann(2.0), 16, 2, 0.76),
        (Boltzmann(2.0), 64, 2, 0.76),
        (Boltzmann(2.0, lapse=0.1), 16, 2, 0.72),
        (Boltzmann(2.0, Weak()), 16, 2, 0.75),
        (Boltzmann(2.0, Ranking()), 8, 3, 0.77),
        (Boltzmann(2.0, BestWorst()), 8, 4, 0.77),
        (Boltzmann(2.0, Approve()), 16, 1, 0.75),
    ],
    ids=str,
)
def test_calibration(
    model: Boltzmann, n_features: int, n_options: int, least: float, generator: Generator
) -> None:
    """Ranks of ω are even, but for a Gaussian that is a little too sure, most so with lapses."""
    sessions, n_answers = 300, 20
    belief = LaplaceBelief(model, samples=99)
    omega = uniform_sphere((sessions, n_features), generator)
    options = torch.randn(sessions, n_answers, n_options, n_features, generator=generator)
    likely = model((options @ omega[:, None, :, None]).squeeze(-1)).exp()
    answers = likely.flatten(0, 1).multinomial(1, generator=generator).view(sessions, n_answers)
    samples, ess = belief.prior(sessions, n_features, generator), torch.full((sessions,), 99.0)
    samples, _, _ = belief.update(samples, ess, model.evidence(options, answers), generator)
    ranks = (samples < omega.unsqueeze(1)).sum(1)
    for rank in ranks.unbind(-1)[:8]:
        assert chi_square(rank) < 33.7
    assert least < ((ranks >= 10) & (ranks < 90)).double().mean() < 0.82  # 80%


def test_hundreds_of_features(generator: Generator) -> None:
    belief, n_features = LaplaceBelief(Boltzmann(4.5)), 512
    omega = uniform_sphere((5, n_features), generator)
    options = torch.randn(5, 60, 2, n_features, generator=generator)
    answers = (options @ omega[:, None, :, None]).squeeze(-1).argmax(-1)
    samples, mean = after(belief, options, answers, at_once=True)
    assert torch.allclose(samples.norm(dim=-1), torch.ones(1), atol=1e-5)
    assert (torch.cosine_similarity(mean, omega) > 0.1).all()


def test_padding_costs_nothing_and_changes_nothing(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A demonstration against many others pads every answer; the curvature knows no padding."""
    model, sessions = Boltzmann(4.5), 2
    options = torch.randn(sessions, 5, 2, D, generator=generator)
    answers = model.evidence(options, torch.zeros(sessions, 5, dtype=torch.long))
    shown = torch.randn(sessions, 1, 40, D, generator=generator)
    demonstrated = evidence_of({"rows": shown, "offsets": torch.zeros(sessions, 1, 40)})
    both, sizes, found = joined(demonstrated, answers), [], []

    def watched(rows: Tensor, *given: Any) -> laplace.Mode:
        sizes.append(rows.shape[1])
        found.append(find_mode(rows, *given))
        return found[-1]

    monkeypatch.setattr(laplace, "find_mode", watched)
    belief = LaplaceBelief(model)
    ess = torch.full((sessions,), 100.0)
    belief.update(belief.prior(sessions, D, generator), ess, both, generator)
    assert sizes == [40 + 5]
    for s in range(sessions):
        omega = found[0].mode[s].clone().requires_grad_()
        gaps = both.rows[s].double() @ omega + both.offsets[s].double()
        posterior = model.log_likelihood(gaps).sum() - D / 2 * omega.square().sum()
        (slope,) = torch.autograd.grad(posterior, omega)
        assert slope.abs().max() < 1e-3


def test_a_row_that_is_there_in_one_session_is_kept_for_all() -> None:
    offsets = torch.full((2, 2, 1, 3), torch.inf)
    offsets[0, 0, 0, 1] = offsets[1, 1, 0, 2] = 0.0
    evidence = Evidence(torch.zeros(2, 2, 1, 3, D), offsets, torch.zeros(2, 2))
    assert rows_there(evidence).tolist() == [1, 5]


def test_no_answers_leave_the_prior(generator: Generator) -> None:
    belief, sessions = LaplaceBelief(Boltzmann(4.5)), 50
    options = torch.randn(sessions, 3, 2, D, generator=generator)
    nothing = belief.response_model.evidence(options, torch.full((sessions, 3), -1))
    samples, ess = belief.prior(sessions, D, generator), torch.full((sessions,), 100.0)
    samples = belief.update(samples, ess, nothing, generator).samples
    assert samples.mean((0, 1)).abs().max() < 0.03
    second = torch.einsum("smd,sme->de", samples, samples) / sessions / 100
    assert torch.allclose(second, torch.eye(D) / D, atol=0.015)


def test_sessions_are_updated_a_few_at_a_time(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, sessions, sizes = Boltzmann(4.5), 7, []
    options = torch.randn(sessions, 5, 2, D, generator=generator)
    answers = (options @ torch.eye(D)[0]).argmax(-1)

    def watched(rows: Tensor, *given: Any) -> laplace.Mode:
        sizes.append(len(rows))
        return find_mode(rows, *given)

    monkeypatch.setattr(laplace, "find_mode", watched)
    belief, ess = LaplaceBelief(model), torch.full((sessions,), 100.0)
    samples = belief.prior(sessions, D, generator)
    held = 3 * laplace.laplace_numbers(100, 5, D)
    for bound in (held, 1):
        monkeypatch.setattr(laplace, "LAPLACE_HELD", bound)
        update = belief.update(samples, ess, model.evidence(options, answers), generator)
        assert update.samples.shape == samples.shape
        assert update.used.shape == update.ess.shape == (sessions,)
        assert (update.samples.mean(1)[:, 0] > 0.1).all()
    assert sizes == [3, 3, 1, *[1] * 7]
