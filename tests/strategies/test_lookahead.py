"""Looking ahead at alignment, against loops."""

from __future__ import annotations

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import make, session_of
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import STRATEGIES, AlignmentLookahead


def best(weights: Tensor, probs: Tensor, units: Tensor, steps: int) -> Tensor:
    """The highest expected squared length of the mean of weighted directions, by recursion."""
    if steps == 0:
        return (weights @ units).square().sum()
    values = []
    for query in probs:
        value = torch.zeros((), dtype=torch.double)
        for answer in query.unbind(-1):
            share = (weights * answer).sum()
            if share > 0:
                value += share * best(weights * answer / share, probs, units, steps - 1)
        values.append(value)
    return torch.stack(values).max()


@pytest.mark.parametrize("options", [2, 3])
@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_it_asks_what_leads_to_most(
    model: ResponseModel, steps: int, options: int, generator: Generator
) -> None:
    pool = QueryPool(torch.randn(6, options, 4, generator=generator))
    session = session_of(make(QueryEnv, pool, model, batch=3))
    session["action_mask"][:, 4:] = False
    chosen = AlignmentLookahead(model, steps, beam=30)(session.clone())["action"]
    for b in range(3):
        samples, queries = session["samples"][b : b + 1], session["queries"][b : b + 1, :4]
        probs = predict_answers(samples, queries, model).probs[0].double()
        units = samples[0].double()
        even = torch.full((len(units),), 1 / len(units), dtype=torch.double)
        ways = [
            sum(
                (even * a).sum() * best(even * a / (even * a).sum(), probs, units, steps - 1)
                for a in query.unbind(-1)
                if (even * a).sum() > 0
            )
            for query in probs
        ]
        assert float(ways[int(chosen[b])]) == pytest.approx(float(max(ways)), abs=1e-6)


def test_with_one_question_left_it_is_greedy(generator: Generator) -> None:
    model = RESPONSE_MODELS[0]
    pool = QueryPool(torch.randn(30, 2, 4, generator=generator))
    session = session_of(make(QueryEnv, pool, model, batch=8))
    session["session", "history", "answers"][:, :-1] = 0
    chosen = AlignmentLookahead(model, 3)(session)["action"]
    gain = score_queries(session["samples"], session["queries"], model, alignment_gain)
    assert torch.allclose(gain[range(8), chosen], gain.amax(1), atol=1e-6)


@pytest.mark.parametrize("name", ["lookahead", "alignment_lookahead"])
def test_too_many_answers_are_refused_where_it_is_made(name: str) -> None:
    def env(options: int) -> QueryEnv:
        pool = QueryPool(torch.randn(3, options, 4))
        made = make(QueryEnv, pool, Boltzmann(2.0, Ranking()), 1)
        assert isinstance(made, QueryEnv)
        return made

    with pytest.raises(InputError, match=r"120 answers: .* 14400 sequences .* at most 1000"):
        STRATEGIES[name](env(5))
    few = env(4)
    assert STRATEGIES[name](few)(few.reset())["action"].shape == (1,)
    with pytest.raises(InputError, match="looking 3 questions ahead"):
        AlignmentLookahead(Boltzmann(2.0, Ranking()), steps=3)(few.reset())


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"beam": 0}])
def test_bad_numbers_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(wrong))}=0"):
        AlignmentLookahead(RESPONSE_MODELS[0], **wrong)
