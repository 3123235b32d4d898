import math

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from reference import answer_probs
from reference import information_gain as reference_gain
from torch import Generator, Tensor

from torchrl_pref import acquisition
from torchrl_pref.acquisition import (
    Acquisition,
    alignment_gain,
    information_gain,
    predict_answers,
    score_queries,
    volume_removal,
)
from torchrl_pref.belief import uniform_sphere
from torchrl_pref.responses import Boltzmann, Optimal, ResponseModel

FUNCTIONS: dict[str, Acquisition] = {
    "information gain": information_gain,
    "volume removal": volume_removal,
    "alignment gain": alignment_gain,
}


def belief_and_queries(generator: Generator, n_options: int = 3) -> tuple[Tensor, Tensor]:
    """Samples (B M D) that agree a little, and queries (B C K D)."""
    samples = uniform_sphere((2, 150, 4), generator)
    samples = torch.nn.functional.normalize(samples + torch.tensor([0.7, 0.0, 0.0, 0.2]), dim=-1)
    return samples, torch.randn(2, 6, n_options, 4, generator=generator)


@pytest.mark.parametrize("n_options", [2, 3])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_agree_with_brute_force(model: ResponseModel, n_options: int, generator: Generator) -> None:
    samples, queries = belief_and_queries(generator, n_options)
    predicted = predict_answers(samples, queries, model)
    tau = getattr(model, "tau", None)
    gain, removal = information_gain(predicted, samples), volume_removal(predicted, samples)
    alignment = alignment_gain(predicted, samples)
    for b in range(2):
        omegas = samples[b].double().numpy()
        for c in range(6):
            options = queries[b, c].double().numpy()
            expected = reference_gain(omegas, options, tau)
            assert float(gain[b, c]) == pytest.approx(expected, abs=1e-5)
            probs = np.array([answer_probs(options @ omega, tau) for omega in omegas])
            assert float(removal[b, c]) == pytest.approx(
                1 - sum(p**2 for p in probs.mean(0)), abs=1e-5
            )
            total = -float(omegas.mean(0) @ omegas.mean(0))
            for q in range(n_options):
                weight = probs[:, q].sum()
                if weight > 0:
                    posterior_mean = (probs[:, q] / weight) @ omegas
                    total += weight / len(omegas) * (posterior_mean @ posterior_mean)
            assert float(alignment[b, c]) == pytest.approx(total, abs=1e-5)


def test_alignment_gain_of_a_narrow_belief_is_not_lost_in_rounding(generator: Generator) -> None:
    samples = 0.01 * uniform_sphere((2, 150, 4), generator) + torch.tensor([1.0, 0.0, 0.0, 0.0])
    samples = torch.nn.functional.normalize(samples, dim=-1)
    queries, model = torch.randn(2, 6, 2, 4, generator=generator), Boltzmann(5.0)
    gain = alignment_gain(predict_answers(samples, queries, model), samples)
    samples, queries = samples.double(), queries.double()
    exact = alignment_gain(predict_answers(samples, queries, model), samples)
    assert (gain - exact).abs().max() < 1e-3 * exact.max()


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_do_not_depend_on_the_order_of_options_or_on_the_batch(
    model: ResponseModel, name: str, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator)
    function = FUNCTIONS[name]
    values = function(predict_answers(samples, queries, model), samples)
    swapped = function(predict_answers(samples, queries.flip(2), model), samples)
    assert torch.allclose(values, swapped, atol=1e-6)
    singles = [
        function(
            predict_answers(samples[b : b + 1], queries[b : b + 1, c : c + 1], model),
            samples[b : b + 1],
        )
        for b in range(2)
        for c in range(6)
    ]
    assert torch.allclose(values.flatten(), torch.cat(singles).flatten(), atol=1e-6)


@pytest.mark.parametrize("tau", [1e-6, 1.0, 1e3, 1e8, None])
@pytest.mark.parametrize("n_options", [2, 4])
def test_information_gain_is_bounded_and_finite_at_any_tau(
    tau: float | None, n_options: int, generator: Generator
) -> None:
    model: ResponseModel = Optimal() if tau is None else Boltzmann(tau)
    samples, queries = belief_and_queries(generator, n_options)
    gain = score_queries(samples, queries * 100, model, information_gain)
    assert ((gain >= 0) & (gain <= math.log2(n_options))).all()
    same = queries[:, :, :1].expand_as(queries)
    assert (score_queries(samples, same, model, information_gain).abs() < 1e-6).all()


def test_information_gain_reaches_one_bit_where_the_belief_is_split() -> None:
    samples = torch.tensor([[[1.0, 0.0]] * 50 + [[0.0, 1.0]] * 50])
    queries = torch.eye(2).view(1, 1, 2, 2)
    for model in (Optimal(), Boltzmann(100)):
        gain = score_queries(samples, queries, model, information_gain)
        assert float(gain) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_chunks_change_nothing(
    model: ResponseModel, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, queries = belief_and_queries(generator)
    expected = information_gain(predict_answers(samples, queries, model), samples)
    for chunk in (1, 150 * 2 * 4, 150 * 2 * 6, 10**9):
        monkeypatch.setattr(acquisition, "CHUNK", chunk)
        assert torch.allclose(
            score_queries(samples, queries, model, information_gain), expected, atol=1e-6
        )
