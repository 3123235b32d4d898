"""Strategies that choose several questions at once, in their environment."""

from __future__ import annotations

import pytest
import torch
from conftest import RESPONSE_MODELS
from envs.test_batch_env import env_of
from torch import Generator

from torchrl_pref.acquisition.batch import BATCHES, OF_PAIRS, Shortlist, joint, top
from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import BATCH_STRATEGIES, BatchOf, Greedy
from torchrl_pref.tasks.gridworld import gridworld_pool

MODEL = RESPONSE_MODELS[0]


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
@pytest.mark.parametrize("name", BATCH_STRATEGIES)
def test_every_strategy_asks_new_questions_through_a_rollout(
    name: str, model: ResponseModel, pool: QueryPool
) -> None:
    env = env_of(pool, model=model, repeats=False)
    data = env.rollout(2, BATCH_STRATEGIES[name](env))
    asked = data["next", "session", "history", "index"][:, -1]
    assert asked.shape == (4, 6)
    assert all(len(row.unique()) == 6 for row in asked)
    assert data["next", "done"][:, -1].all()


@pytest.mark.parametrize("name", BATCHES)
def test_a_batch_of_sessions_is_chosen_for_as_each_alone(name: str, pool: QueryPool) -> None:
    env = env_of(pool, repeats=False, candidates=30)  # others for each session
    strategy = BATCH_STRATEGIES[name](env)
    session = env.step_mdp(env.step(BATCH_STRATEGIES["random"](env)(env.reset())))
    together = strategy(session.clone())["action"]
    alone = [strategy(session[b : b + 1].clone())["action"] for b in range(4)]
    assert torch.equal(together, torch.cat(alone))
    assert len(together.unique(dim=0)) > 1


def test_the_shortlist_is_of_the_best_that_are_allowed(pool: QueryPool) -> None:
    env = env_of(pool, repeats=False)
    session = env.step_mdp(env.step(BATCH_STRATEGIES["random"](env)(env.reset())))
    shown: list[Shortlist] = []

    def look(best: Shortlist, n: int) -> torch.Tensor:
        shown.append(best)
        return top(best, n)

    action = BatchOf(MODEL, 3, look, alignment_gain, shortlist=4)(session)["action"]
    values = score_queries(session["samples"], session["queries"], MODEL, alignment_gain)
    values = values.masked_fill(~session["action_mask"], -1)
    for b, best in enumerate(shown):
        assert torch.equal(best.values, values[b].topk(12).values)
        assert torch.equal(values[b, action[b]], best.values[:3])
        predicted = predict_answers(session["samples"][b : b + 1], best.queries[None], MODEL)
        assert torch.equal(best.probs, predicted.probs[0])


def test_of_one_option_the_threshold_is_known(pool: QueryPool) -> None:
    shown: list[float] = []

    def look(best: Shortlist, n: int) -> torch.Tensor:
        shown.append(best.threshold)
        return top(best, n)

    session = env_of(pool, batch=1).reset()
    for options, question in ((1, Approve(1.0)), (2, Choice())):
        session["queries"] = pool.features[:, :options].expand(4, -1, -1, -1)
        BatchOf(Boltzmann(2.0, question), 1, look)(session)
    assert shown == [0.5] * 4 + [0.0] * 4


@pytest.mark.parametrize("select", [top, joint])
def test_a_batch_of_one_is_greedy(select: object, pool: QueryPool) -> None:
    session = env_of(pool, batch=1).reset()
    greedy = Greedy(MODEL)(session.clone())["action"]
    assert torch.equal(BatchOf(MODEL, 1, select)(session)["action"], greedy[:, None])  # type: ignore[arg-type]


def test_joint_information_is_of_other_questions_than_the_top(pool: QueryPool) -> None:
    session = env_of(pool).reset()
    first, second = (BatchOf(MODEL, 3, each)(session.clone())["action"] for each in (top, joint))
    assert torch.equal(first[:, 0], second[:, 0])
    assert not torch.equal(first, second)
    values = score_queries(session["samples"], session["queries"], MODEL, information_gain)
    assert values.gather(1, second).sum() < values.gather(1, first).sum()


@pytest.mark.parametrize("name", [name for name in BATCHES if name not in OF_PAIRS])
def test_questions_about_three_options_are_asked_by_what_needs_no_pairs(name: str) -> None:
    env = env_of(gridworld_pool(30, 3))
    assert env.rollout(2, BATCH_STRATEGIES[name](env))["next", "done"][:, -1].all()


def test_random_batches_differ_from_step_to_step(pool: QueryPool) -> None:
    env = env_of(QueryPool(torch.randn(60, 2, 3, generator=Generator().manual_seed(0))))
    actions = env.rollout(2, BATCH_STRATEGIES["random"](env))["action"]
    assert not torch.equal(actions[:, 0], actions[:, 1])
