import math

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from reference import answer_probs
from reference import information_gain as reference_gain
from torch import Generator, Tensor

from torchrl_pref.acquisition import scoring as acquisition
from torchrl_pref.acquisition.functions import (
    Acquisition,
    alignment_gain,
    information_gain,
    volume_removal,
)
from torchrl_pref.acquisition.scoring import (
    predict_answers,
    score_in_tensors,
    score_queries,
    together,
)
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.questions.response_model import Prediction, ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal

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
            score_in_tensors(samples, queries, model, information_gain), expected, atol=1e-6
        )


@pytest.mark.parametrize("n_features", [2, 4, 5, 9])
@pytest.mark.parametrize("n_options", [2, 3, 5])
@pytest.mark.parametrize("tau", [0.01, 4.5, 1e4, None])
def test_compiled_scores_are_those_of_the_tensors(
    tau: float | None, n_options: int, n_features: int, generator: Generator
) -> None:
    model: ResponseModel = Optimal() if tau is None else Boltzmann(tau)
    functions = together(*reversed(FUNCTIONS.values()))
    size = (3, 40, n_options, n_features)
    scales = torch.tensor([1e-4, 1.0, 1e3]).view(3, 1, 1, 1)  # options nearly alike, and far apart
    queries = scales * torch.randn(size, generator=generator)
    queries[:, :3, 1] = queries[:, :3, 0]  # two that tie
    for n_samples in (2, 100, 301):
        samples = uniform_sphere((3, n_samples, n_features), generator)
        compiled = score_queries(samples, queries, model, functions)
        for convert, share in ((torch.Tensor.double, 0.98), (torch.Tensor.float, 0.95)):
            expected = score_in_tensors(convert(samples), convert(queries), model, functions)
            apart = (compiled - expected).abs()
            assert apart.median() < 1e-6
            # A few samples are within rounding of a tie, or of where a tie ends.
            assert (apart < 1e-5).float().mean() > share
        assert torch.equal(
            compiled[..., 2], score_queries(samples, queries, model, information_gain)
        )


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_options_that_are_alike_teach_exactly_nothing(
    model: ResponseModel, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator)
    alike = queries[:, :, :1].expand(-1, -1, 3, -1)
    scores = score_queries(samples, alike, model, together(information_gain, alignment_gain))
    assert torch.equal(scores, torch.zeros(2, 6, 2))


def test_a_small_gain_is_not_lost_in_rounding(generator: Generator) -> None:
    """Where an answer is all but certain, what the other one would teach is small, and exact."""
    samples, queries = belief_and_queries(generator, 2)
    direction = torch.tensor([0.7, 0.0, 0.0, 0.2])
    samples = torch.nn.functional.normalize(samples + 3 * direction, dim=-1)
    queries[:, :, 0] += 12 * direction
    for model in (Boltzmann(1.0), Boltzmann(3.0)):
        gain = score_queries(samples, queries, model, alignment_gain)
        exact = score_in_tensors(samples.double(), queries.double(), model, alignment_gain)
        assert torch.allclose(gain.double(), exact, rtol=1e-4, atol=1e-12)
        assert exact.min() < 1e-3


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_scores_serve_shared_queries_no_candidates_and_gradients(
    model: ResponseModel, generator: Generator
) -> None:
    samples, queries = belief_and_queries(generator)
    shared = queries[:1].expand(2, -1, -1, -1)
    copied = shared.contiguous()
    for each in FUNCTIONS.values():
        found = score_queries(samples, shared, model, each)
        assert torch.equal(found, score_queries(samples, copied, model, each))
        flipped = score_queries(samples.flip(-1), shared.flip(-1), model, each)
        assert torch.allclose(found, flipped, atol=1e-6)
    assert score_queries(samples[:0], queries[:0], model, information_gain).shape == (0, 6)
    if isinstance(model, Boltzmann):
        score_queries(samples, queries.requires_grad_(), model, alignment_gain).sum().backward()
        assert queries.grad is not None
        assert queries.grad.abs().sum() > 0


def test_a_function_or_model_of_ones_own_is_scored_in_tensors(generator: Generator) -> None:
    samples, queries = belief_and_queries(generator)

    class Cautious(ResponseModel):
        def log_likelihood(self, gaps: Tensor) -> Tensor:
            return RESPONSE_MODELS[0].log_likelihood(0.5 * gaps)

    def doubled(predicted: Prediction, samples: Tensor) -> Tensor:
        return 2 * information_gain(predicted, samples)

    once = score_queries(samples, queries, RESPONSE_MODELS[0], information_gain)
    twice = score_queries(samples, queries, RESPONSE_MODELS[0], doubled)
    assert torch.allclose(2 * once, twice, atol=1e-5)
    own = score_queries(samples, queries, Cautious(), information_gain)
    assert torch.allclose(
        own, score_queries(samples, queries, Boltzmann(2.2), information_gain), atol=1e-6
    )
