import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from reference import answer_probs
from reference import information_gain as reference_gain
from torch import Generator, Tensor

from torchrl_pref import acquisition
from torchrl_pref.acquisition import (
    expected_alignment,
    information_gain,
    score_queries,
    volume_removal,
)
from torchrl_pref.belief import uniform_sphere
from torchrl_pref.responses import Boltzmann, Optimal, Prediction, ResponseModel

Value = Callable[[Prediction, Tensor], Tensor]

FUNCTIONS: dict[str, Value] = {
    "information gain": lambda predicted, samples: information_gain(predicted),
    "volume removal": lambda predicted, samples: volume_removal(predicted),
    "expected alignment": expected_alignment,
}


def belief_and_queries(generator: Generator, n_options: int = 3) -> tuple[Tensor, Tensor]:
    """Samples (B M D) that agree a little, and queries (B C K D)."""
    samples = uniform_sphere((2, 150, 4), generator)
    samples = torch.nn.functional.normalize(samples + torch.tensor([0.7, 0.0, 0.0, 0.2]), dim=-1)
    return samples, torch.randn(2, 6, n_options, 4, generator=generator)


def predict(samples: Tensor, queries: Tensor, model: ResponseModel) -> Prediction:
    """What the samples predict of the answers to B C queries."""
    return model.predict(torch.einsum("bmd,bckd->bcmk", samples, queries))


@pytest.mark.parametrize("n_options", [2, 3])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_agree_with_brute_force(model: ResponseModel, n_options: int, generator: Generator) -> None:
    samples, queries = belief_and_queries(generator, n_options)
    predicted = predict(samples, queries, model)
    tau = getattr(model, "tau", None)
    gain, removal = information_gain(predicted), volume_removal(predicted)
    alignment = expected_alignment(predicted, samples)
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
            total = 0.0
            for q in range(n_options):
                weight = probs[:, q].sum()
                if weight > 0:
                    posterior_mean = (probs[:, q] / weight) @ omegas
                    total += weight / len(omegas) * (posterior_mean @ posterior_mean)
            assert float(alignment[b, c]) == pytest.approx(total, abs=1e-5)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_do_not_depend_on_the_order_of_options_or_on_the_batch(
    model: ResponseModel, name: str, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator)
    function = FUNCTIONS[name]
    values = function(predict(samples, queries, model), samples)
    swapped = function(predict(samples, queries.flip(2), model), samples)
    assert torch.allclose(values, swapped, atol=1e-6)
    singles = [
        function(
            predict(samples[b : b + 1], queries[b : b + 1, c : c + 1], model), samples[b : b + 1]
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
    gain = information_gain(predict(samples, queries * 100, model))
    assert ((gain >= 0) & (gain <= math.log2(n_options))).all()
    same = queries[:, :, :1].expand_as(queries)
    assert (information_gain(predict(samples, same, model)).abs() < 1e-6).all()


def test_information_gain_reaches_one_bit_where_the_belief_is_split() -> None:
    returns = torch.tensor([[1.0, 0.0]] * 50 + [[0.0, 1.0]] * 50)
    assert float(information_gain(Optimal().predict(returns))) == pytest.approx(1)
    assert float(information_gain(Boltzmann(100).predict(returns))) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_chunks_change_nothing(
    model: ResponseModel, generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples, queries = belief_and_queries(generator)
    expected = information_gain(predict(samples, queries, model))
    for chunk in (1, 2 * 150 * 3 * 4, 10**9):
        monkeypatch.setattr(acquisition, "CHUNK", chunk)
        assert torch.allclose(score_queries(samples, queries, model), expected, atol=1e-6)
