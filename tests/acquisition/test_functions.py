"""What every acquisition function keeps to: the package's, and one written outside of it."""

import math

import my_acquisition
import pytest
import torch
from torch import Generator

from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.acquisition.functions import (
    Acquisition,
    information_gain,
    least_confidence,
    volume_removal,
)
from torchrl_pref.acquisition.knowledge_gradient import KnowledgeGradient
from torchrl_pref.acquisition.per_second import Cost, PerSecond
from torchrl_pref.acquisition.scoring import score_in_tensors, score_queries
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak

TRAJECTORIES = torch.randn(30, 4, generator=Generator().manual_seed(1))
FUNCTIONS = [
    *ACQUISITIONS.values(),
    KnowledgeGradient(TRAJECTORIES),
    my_acquisition.vote_entropy,
]
NOT_ZERO_WHERE_ALIKE = volume_removal, least_confidence
MODELS = [Boltzmann(4.0), Optimal(), Boltzmann(1e5), Boltzmann(4.0, Weak(0.5), lapse=0.1)]


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_values(function: Acquisition, model: ResponseModel, generator: Generator) -> None:
    samples = uniform_sphere((3, 40, 4), generator)
    queries = torch.randn(3, 7, 2, 4, generator=generator)
    queries[0] *= 1e4
    found = score_queries(samples, queries, model, function)
    assert found.shape == (3, 7)
    assert found.isfinite().all()
    assert (found >= -1e-6).all()
    # Neither the order of the options nor who else is scored makes a difference.
    assert torch.allclose(
        score_queries(samples, queries.flip(2), model, function), found, atol=1e-5
    )
    alone = score_queries(samples[1:2], queries[1:2, 3:5], model, function)
    assert torch.allclose(alone, found[1:2, 3:5], atol=1e-5)
    assert torch.allclose(score_in_tensors(samples, queries, model, function), found, atol=1e-4)
    # Nothing is to be had where the belief is certain, and less than from a query that splits it.
    certain = score_queries(samples[:, :1].expand(3, 40, 4), queries, model, function)
    assert certain[1:].mean() <= found[1:].mean() + 1e-6


@pytest.mark.parametrize("n_options", [2, 3, 4])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_options_that_are_alike_are_worth_nothing(
    function: Acquisition, n_options: int, generator: Generator
) -> None:
    """Or, of what is about the answer alone, most of all: nobody knows what it will be."""
    samples = uniform_sphere((3, 40, 4), generator)
    queries = torch.randn(3, 7, n_options, 4, generator=generator)
    alike = queries[:, :, :1].expand_as(queries)
    for model in (Boltzmann(0.001), Boltzmann(4.0), Boltzmann(1e5), Optimal()):
        found = score_queries(samples, alike, model, function)
        if function not in NOT_ZERO_WHERE_ALIKE:
            assert found.abs().max() < 1e-6
        else:
            assert torch.allclose(found, torch.tensor(1 - 1 / n_options))
            assert (score_queries(samples, queries, model, function) <= found + 1e-6).all()


def test_a_question_takes_longer_where_the_person_is_undecided(generator: Generator) -> None:
    """Gains by a loop over samples and options, divided by seconds that are counted by hand."""
    samples = uniform_sphere((1, 30, 4), generator)
    queries = torch.randn(1, 5, 3, 4, generator=generator)
    found = score_queries(
        samples, queries, Boltzmann(2.0), PerSecond(information_gain, Cost(watch=6, decide=3))
    )
    for query, value in zip(queries[0], found[0], strict=True):
        answers = [torch.softmax(2.0 * query @ omega, 0) for omega in samples[0]]
        hard = sum(float(torch.special.entr(each).sum()) for each in answers) / len(answers)
        mean = torch.stack(answers).mean(0)
        bits = (float(torch.special.entr(mean).sum()) - hard) / math.log(2)
        assert float(value) == pytest.approx(bits / (6 + 3 * (1 + hard / math.log(3))), abs=1e-5)
    with pytest.raises(InputError, match="watch=0: expected a finite number above 0"):
        Cost(watch=0)
