import math

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from reference import answer_probs
from torch import Generator

from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal


@pytest.mark.parametrize("n_options", [2, 3, 5])
@pytest.mark.parametrize("model", [*RESPONSE_MODELS, Boltzmann(0.01), Boltzmann(50)], ids=str)
def test_agrees_with_the_reference(
    model: ResponseModel, n_options: int, generator: Generator
) -> None:
    returns = torch.randn(7, 4, n_options, generator=generator)
    returns[0] = 1.5  # ties
    probs = model(returns).exp()
    for row, found in zip(
        returns.reshape(-1, n_options), probs.reshape(-1, n_options), strict=True
    ):
        expected = answer_probs(row.double().numpy(), getattr(model, "tau", None))
        assert np.allclose(found.numpy(), expected, atol=1e-5)
    order = torch.randperm(n_options, generator=generator)
    assert torch.allclose(model(returns[..., order]), model(returns)[..., order], atol=1e-6)


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_batch_equals_singles(model: ResponseModel, generator: Generator) -> None:
    returns = torch.randn(5, 6, 3, generator=generator)
    singles = torch.stack([torch.stack([model(row) for row in rows]) for rows in returns])
    assert torch.allclose(model(returns), singles, atol=1e-6)


def test_optimal_is_the_limit_of_boltzmann(generator: Generator) -> None:
    returns = torch.randn(100, 3, generator=generator)
    assert torch.allclose(Boltzmann(1e6)(returns).exp(), Optimal()(returns).exp(), atol=1e-3)
    for tau in (1e-6, 1e6, 1e30):
        assert Boltzmann(tau)(returns * 1e3).isnan().sum() == 0


@pytest.mark.parametrize("parent", [Boltzmann, Optimal])
def test_closed_forms_are_not_inherited(parent: type) -> None:
    with pytest.raises(TypeError, match="derive from ResponseModel"):
        type("Lapsing", (parent,), {})


@pytest.mark.parametrize("model", [Boltzmann(1.0), Optimal()], ids=str)
def test_simulated_humans_answer_as_often_as_they_should(
    model: ResponseModel, generator: Generator
) -> None:
    count = 40_000
    human = SimulatedHuman(model).draw(count, 2, 3, 2, generator)
    human["omega"] = torch.tensor([1.0, 0.0]).expand(count, 2)
    options = torch.tensor([[0.3, 9.0], [1.0, -5.0], [1.0, 0.0]])
    turn = torch.ones(count, dtype=torch.int64)
    answers = SimulatedHuman(model).respond(options.expand(count, 3, 2), human, turn)
    found = answers.bincount(minlength=3) / count
    expected = torch.tensor(answer_probs(np.array([0.3, 1.0, 1.0]), getattr(model, "tau", None)))
    error = (expected * (1 - expected) / count).sqrt()
    assert ((found - expected).abs() <= 5 * error).all()


def test_calibrated_tau_gives_the_accuracy(pool: QueryPool, generator: Generator) -> None:
    omega = uniform_sphere((500, 4), generator)
    returns = torch.einsum("nkd,md->nmk", pool.features, omega)
    tau = calibrate_tau(returns, 0.9)
    gap = (returns[..., 0] - returns[..., 1]).abs().double().numpy()
    assert float(np.mean(1 / (1 + np.exp(-tau * gap)))) == pytest.approx(0.9, abs=1e-4)
    three = torch.randn(400, 3, generator=generator)
    best = torch.softmax(calibrate_tau(three, 0.7) * three.double(), -1).amax(-1).mean()
    assert float(best) == pytest.approx(0.7, abs=1e-4)


def test_accuracy_out_of_reach_is_an_input_error() -> None:
    with pytest.raises(InputError, match="cannot be reached"):
        calibrate_tau(torch.zeros(10, 2))


@pytest.mark.parametrize("tau", [0, -1, math.nan, math.inf, "noisy", True, None])
def test_bad_tau_is_refused(tau: object) -> None:
    with pytest.raises(InputError, match="expected a finite number above 0"):
        Boltzmann(tau)  # type: ignore[arg-type]
