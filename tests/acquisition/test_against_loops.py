"""The acquisition functions of the literature that came later, against loops over samples."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from reference import Array, answer_probs
from torch import Generator, Tensor

from torchrl_pref.acquisition import knowledge_gradient
from torchrl_pref.acquisition.functions import Acquisition, least_confidence
from torchrl_pref.acquisition.knowledge_gradient import KnowledgeGradient
from torchrl_pref.acquisition.pairs import disagreement, max_regret
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal

TRAJECTORIES = torch.randn(25, 4, generator=Generator().manual_seed(3))
TAUS = [0.001, 4.4, 1e5, None]


def model_of(tau: float | None) -> ResponseModel:
    return Optimal() if tau is None else Boltzmann(tau)


def belief_and_queries(generator: Generator, n_options: int) -> tuple[Tensor, Tensor]:
    """Samples (B M D), wide and narrow beliefs, of lengths of their own, and queries (B C K D), the
    first ones with two options alike."""
    samples = uniform_sphere((3, 12, 4), generator)
    middle = torch.tensor([1.0, 0.0, 0.0, 0.5]) * torch.tensor([0.0, 1.0, 5.0]).view(3, 1, 1)
    samples = torch.nn.functional.normalize(samples + middle, dim=-1)
    queries = torch.randn(3, 6, n_options, 4, generator=generator)
    queries[:, :2, -1] = queries[:, :2, 0]
    return samples, queries


def by_loops(name: str, omegas: Array, options: Array, tau: float | None) -> float:
    """The value of a query (K D) under samples (M D) of length 1, as the docstrings have it."""
    returns = omegas @ options.T
    ways = range(len(options))
    if name in ("max regret", "disagreement"):
        best = [{k for k in ways if row[k] > row.max() - 1e-6} for row in returns]
        most = 0.0
        for i, j in itertools.product(range(len(omegas)), repeat=2):
            if best[i] & best[j]:
                continue
            lost = max(
                returns[i, a] - returns[i, b] + returns[j, b] - returns[j, a]
                for a in best[i]
                for b in best[j]
            )
            far = float(np.linalg.norm(omegas[i] - omegas[j]))
            most = max(most, lost if name == "max regret" else far)
        return most
    probs = np.array([answer_probs(row, tau) for row in returns])
    if name == "least confidence":
        return 1 - max(sum(probs[:, q]) / len(omegas) for q in ways)
    trajectories = TRAJECTORIES.double().numpy()
    gain = -max(float(omegas.mean(0) @ one) for one in trajectories)
    for q in ways:
        if probs[:, q].sum() > 0:
            after = probs[:, q] @ omegas / probs[:, q].sum()
            gain += probs[:, q].mean() * max(float(after @ one) for one in trajectories)
    return gain


FUNCTIONS: dict[str, Acquisition] = {
    "max regret": max_regret,
    "disagreement": disagreement,
    "least confidence": least_confidence,
    "knowledge gradient": KnowledgeGradient(TRAJECTORIES),
}


@pytest.mark.parametrize("n_options", [2, 3, 4])
@pytest.mark.parametrize("tau", TAUS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_agree_with_brute_force(
    name: str, tau: float | None, n_options: int, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator, n_options)
    found = score_queries(samples, queries, model_of(tau), FUNCTIONS[name])
    expected = [
        [by_loops(name, omegas, options, tau) for options in of_session]
        for omegas, of_session in zip(
            samples.double().numpy(), queries.double().numpy(), strict=True
        )
    ]
    assert torch.allclose(found.double(), torch.tensor(expected, dtype=torch.double), atol=1e-5)
    if tau != 0.001:  # where an answer may be too poor to change any choice
        assert len(set(found.flatten().tolist())) > 2


@pytest.mark.parametrize("n_options", [2, 3, 4])
@pytest.mark.parametrize("tau", TAUS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_order_of_options_makes_no_difference_and_all_is_finite(
    name: str, tau: float | None, n_options: int, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator, n_options)
    for scale in (1e-3, 1.0, 1e3):
        values = score_queries(samples, scale * queries, model_of(tau), FUNCTIONS[name])
        assert values.isfinite().all()
        assert (values >= 0).all()
        for order in itertools.permutations(range(n_options)):
            other = scale * queries[:, :, list(order)]
            again = score_queries(samples, other, model_of(tau), FUNCTIONS[name])
            assert torch.allclose(again, values, atol=1e-5 * max(1.0, scale))


@pytest.mark.parametrize("name", ["max regret", "disagreement", "knowledge gradient"])
def test_the_length_of_a_sample_changes_only_how_it_answers(
    name: str, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator, 3)
    longer = samples * (0.2 + 3 * torch.rand(3, 12, 1, generator=generator))
    model, function = Boltzmann(4.4), FUNCTIONS[name]
    predicted = predict_answers(longer, queries, model)
    found = function(predicted, longer)
    if name == "knowledge gradient":
        expected = function(predicted, samples)
    else:
        expected = score_queries(samples, queries, model, function)
    assert torch.allclose(found, expected, atol=1e-5)


def test_no_two_samples_differ_about_options_that_are_alike(generator: Generator) -> None:
    """Not even by rounding, which tells the returns of equal options apart in some sums."""
    samples = uniform_sphere((2, 60, 9), generator)
    queries = 100 * torch.randn(2, 50, 4, 9, generator=generator)
    best = torch.nn.functional.normalize(samples.mean(1), dim=-1).view(2, 1, 9)
    samples = torch.nn.functional.normalize(samples + 100 * best, dim=-1)
    queries[:, :, 0] = queries[:, :, 1] = 2000 * best
    for tiny in (0.0, 1e-5):
        queries[:, :, 1] += tiny
        for function in (max_regret, disagreement):
            values = score_queries(samples, queries, Boltzmann(1.0), function)
            assert values.max() < 1e-2


def test_a_pair_that_is_not_among_the_farthest_is_found() -> None:
    """Of a long row of samples and one beside its middle, which alone prefers the first option."""
    row = torch.stack([torch.linspace(-1, 1, 40), torch.zeros(40), torch.ones(40)], -1)
    samples = torch.cat([row, torch.tensor([[0.0, 0.3, 1.0]])])
    samples = torch.nn.functional.normalize(samples, dim=-1)
    options = torch.tensor([[0.0, 1.0, -0.15], [0.0, 0.0, 0.0]])
    found = score_queries(samples[None], options[None, None], Boltzmann(1.0), disagreement)
    expected = torch.linalg.vector_norm(samples[0] - samples[-1])
    assert float(found) == pytest.approx(float(expected), abs=1e-6)
    assert (torch.pdist(samples) > expected + 1e-3).sum() > 2 * len(samples)


def test_of_queries_with_the_same_farthest_pair_the_order_of_the_pool_decides_nothing(
    generator: Generator,
) -> None:
    """They tie at its distance: asked is where these two samples have most at stake."""
    samples, queries = (
        uniform_sphere((1, 20, 3), generator),
        torch.randn(1, 200, 2, 3, generator=generator),
    )
    found = score_queries(samples, queries, Boltzmann(4.4), disagreement)[0]
    tied = (found.float() == found.float().max()).nonzero().squeeze(-1)
    assert len(tied) > 10
    apart = torch.cdist(samples[0], samples[0])
    one, other = divmod(int(apart.argmax()), 20)
    psi = queries[0, tied, 0] - queries[0, tied, 1]
    stake = (psi @ (samples[0, one] - samples[0, other])).abs()
    assert int(found.argmax()) == int(tied[stake.argmax()])
    order = torch.randperm(200, generator=generator)
    again = score_queries(samples, queries[:, order].flip(2), Boltzmann(4.4), disagreement)[0]
    assert int(order[again.argmax()]) == int(found.argmax())


def test_knowledge_gradient_is_in_parts_what_it_is_as_a_whole(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, queries = belief_and_queries(generator, 3)
    whole = score_queries(samples, queries, Boltzmann(4.4), FUNCTIONS["knowledge gradient"])
    for held in (1, 60, 200):
        monkeypatch.setattr(knowledge_gradient, "HELD", held)
        parts = score_queries(samples, queries, Boltzmann(4.4), FUNCTIONS["knowledge gradient"])
        assert torch.allclose(parts, whole, atol=1e-6)


def test_knowledge_gradient_is_about_what_would_be_chosen(generator: Generator) -> None:
    """Of a feature in which no two trajectories differ there is nothing to gain."""
    samples = uniform_sphere((1, 50, 3), generator)
    # Whatever is thought of the third feature, as much speaks for the others.
    samples = torch.cat([samples, samples * torch.tensor([1.0, 1.0, -1.0])], 1)
    trajectories = torch.randn(20, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    queries = torch.randn(1, 2, 2, 3, generator=generator)
    queries[:, 0, :, :2] = 0.0  # about the third feature alone
    gain = score_queries(samples, queries, Boltzmann(50.0), KnowledgeGradient(trajectories))[0]
    assert gain[1] > 0.1
    assert gain[0] < 1e-6
    one = KnowledgeGradient(trajectories[:1])
    assert torch.equal(score_queries(samples, queries, Boltzmann(50.0), one), torch.zeros(1, 2))
    with pytest.raises(InputError, match=r"trajectories of shape \(20, 2, 3\)"):
        KnowledgeGradient(torch.randn(20, 2, 3))
