"""What everybody who answers keeps to: the package's humans, and one written outside of it."""

from collections.abc import Callable
from typing import Any

import my_human
import pytest
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans import HUMANS
from torchrl_pref.humans.base import REFUSED, HumanBase
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.strategies import Greedy

MAKE = [*HUMANS.values(), my_human.Tiring]
MODELS = [Boltzmann(4.0), Optimal(), Boltzmann(4.0, Weak(0.3), lapse=0.1)]
CASES = [
    pytest.param(make, model, id=f"{make.__name__}-{model}")
    for make in MAKE
    for model in MODELS
    if make is not HUMANS["undecided"] or isinstance(model.question, Weak)
]


@pytest.mark.parametrize(("make", "model"), CASES)
def test_answers(
    make: Callable[[ResponseModel], HumanBase], model: ResponseModel, generator: Generator
) -> None:
    human, n_answers = make(model), model.n_answers(2)
    drawn = human.draw(500, 3, n_answers, 4, generator)
    assert drawn.batch_size == (500,)
    assert torch.allclose(drawn["omega"].norm(dim=-1), torch.ones(500), atol=1e-5)
    queries = torch.randn(500, 2, 4, generator=generator)
    before = drawn.clone()
    for turn in range(3):
        answers = human.respond(queries, drawn, torch.full((500,), turn))
        assert answers.dtype == torch.int64
        assert ((answers >= 0) & (answers < n_answers) | (answers == REFUSED)).all()
        # All luck is drawn beforehand, and nobody's depends on who else is asked.
        some = human.respond(queries[7:9], drawn[7:9], torch.full((2,), turn))
        assert torch.equal(some, answers[7:9])
        returns = (queries @ drawn["omega"].unsqueeze(-1)).squeeze(-1)
        picked = (answers >= 0) & (answers < 2)
        assert (answers == returns.argmax(-1))[picked].float().mean() > 0.75
    assert (drawn == before).all()
    weights = human.step_weights(7)
    assert weights is None or (weights.shape == (7,) and weights.sum() == pytest.approx(1.0))


@pytest.mark.parametrize(("make", "model"), CASES)
def test_both_environments_ask_them(
    make: Callable[[ResponseModel], HumanBase], model: ResponseModel, generator: Generator
) -> None:
    """Sessions go to their end, and the belief stays in order."""
    pool = QueryPool(torch.randn(30, 2, 3, generator=generator))
    for kind in (QueryEnv, FeedEnv):
        env = kind(pool, make(model), Belief(model, 20), 4, batch_size=(20,), seed=0)
        after = env.rollout(20, break_when_any_done=False)["next", "session"]
        assert after["samples"].isfinite().all()
        assert ((after["samples"].norm(dim=-1) - 1).abs() < 1e-4).all()
        assert (after["history", "answers"] >= -3).all()


@pytest.mark.parametrize("make", MAKE)
def test_a_generator_fixes_them(make: Callable[[ResponseModel], HumanBase]) -> None:
    human = make(MODELS[-1])
    first, again = (human.draw(9, 2, 2, 4, Generator().manual_seed(3)) for _ in range(2))
    assert (first == again).all()


def test_who_tires_errs_more_and_more(generator: Generator) -> None:
    human = my_human.Tiring(Optimal(), patience=5)
    drawn = human.draw(4000, 20, 2, 4, generator)
    queries = torch.randn(4000, 2, 4, generator=generator)
    best = (queries @ drawn["omega"].unsqueeze(-1)).squeeze(-1).argmax(-1)
    right = [
        float((human.respond(queries, drawn, torch.full((4000,), t)) == best).float().mean())
        for t in (0, 5, 19)
    ]
    assert right == pytest.approx([1.0, 0.75, 1 - 19 / 24 / 2], abs=0.04)


class Plain(HumanBase):
    """No more than what is promised of all."""

    response_model = Optimal()

    def draw(
        self, n_sessions: int, budget: int, n_answers: int, n_features: int, generator: Generator
    ) -> TensorDict:
        omega = torch.randn(n_sessions, n_features, generator=generator)
        return TensorDict({"omega": omega / omega.norm(dim=-1, keepdim=True)}, [n_sessions])

    def respond(self, queries: Tensor, human: Any, turn: Tensor) -> Tensor:
        return (queries @ human["omega"].unsqueeze(-1)).squeeze(-1).argmax(-1)


def test_omega_is_all_that_an_environment_needs(pool: QueryPool) -> None:
    """Also where humans are handed on, as each evaluation does."""
    env = QueryEnv(pool, Plain(), Belief(Optimal(), 20), 4, batch_size=(5,), seed=0)
    result = evaluate(env, Greedy(Optimal()), draw_humans(env))
    assert result.alignment.shape == (5, 5)
