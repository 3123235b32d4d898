import numpy as np
import pytest
import scipy.stats
import torch
from conftest import RESPONSE_MODELS
from test_envs import make
from test_training import settings_of, trainer_of
from torch import Generator

from torchrl_pref.comparison import check_evaluation
from torchrl_pref.envs import FeedEnv, QueryEnv
from torchrl_pref.evaluation import CURVES, bootstrap_interval, draw_humans, evaluate
from torchrl_pref.experiment import make_query_env
from torchrl_pref.queries import QueryPool
from torchrl_pref.strategies import Greedy, RandomAsk, RandomQuery


def test_query_curves_are_those_of_the_rollout(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, batch=6, seed=2)
    humans = draw_humans(env)
    env.set_seed(5)
    result = evaluate(env, RandomQuery(3), humans)
    env.set_seed(5)
    start = env.reset(humans.clone(), set_state=True)
    data = env.rollout(5, RandomQuery(3), auto_reset=False, tensordict=start)
    for name in CURVES:
        curve = torch.cat([start["metrics", name], data["next", "metrics", name].squeeze(-1)], 1)
        assert torch.equal(getattr(result, name), curve)
    asked = data["next", "history", "queries"][:, -1]
    assert result.repeated.tolist() == [5 - len(row.unique()) for row in asked]
    assert (result.asked == 5).all()
    assert (result.information.diff(dim=1) >= 0).all()
    assert result.seconds_per_query > 0


def test_feed_curves_count_answers_and_not_offers(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=8, offers=7)
    humans = draw_humans(env)
    result = evaluate(env, RandomAsk(0.4, seed=1), humans)
    assert (result.asked <= 5).all()
    assert (result.offered <= 7).all()
    assert (result.asked < 5).any()
    for human in range(8):
        asked = int(result.asked[human])
        tail = result.alignment[human, asked:]
        assert (tail == tail[0]).all()
        steps = result.information[human].diff()
        assert (steps[:asked] > 0).all()
        assert (steps[asked:] == 0).all()
    nothing = evaluate(env, RandomAsk(0.0), humans)
    assert (nothing.asked == 0).all()
    assert torch.equal(nothing.alignment[:, 0], nothing.alignment[:, -1])


def test_strategies_face_the_same_humans_and_luck(pool: QueryPool) -> None:
    """With one query in the pool every strategy asks the same, and must hear the same."""
    single = QueryPool(pool.features[:1])
    query_env, feed_env = make(QueryEnv, single, batch=30), make(FeedEnv, single, batch=30)
    humans = draw_humans(query_env)
    answers = []
    for env, strategy in (
        (query_env, RandomQuery()),
        (query_env, Greedy(RESPONSE_MODELS[0])),
        (feed_env, RandomAsk()),
    ):
        start = env.reset(humans.clone(), set_state=True)
        data = env.rollout(5, strategy, auto_reset=False, tensordict=start)
        answers.append(data["next", "history", "answers"][:, -1])
    assert torch.equal(answers[0], answers[1])
    assert torch.equal(answers[0], answers[2])
    assert 0 < float(answers[0].float().mean()) < 1


def test_bootstrap_agrees_with_scipy(generator: Generator) -> None:
    values = torch.randn(60, generator=generator) ** 2
    expected = scipy.stats.bootstrap(
        (values.numpy(),), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert bootstrap_interval(values) == pytest.approx(tuple(expected), abs=0.03)
    assert bootstrap_interval(torch.full((9,), 2.0)) == (2.0, 2.0)


def test_humans_of_the_evaluation_are_not_those_of_the_training() -> None:
    settings = settings_of()
    settings["evaluation"] = {"humans": settings["training"]["sessions"], "seed": settings["seed"]}
    trainer, task = trainer_of(settings)
    n_humans, seed = check_evaluation(settings)
    judged = draw_humans(make_query_env(settings, task, task.test, n_humans, seed))
    trained = trainer.sessions.now
    assert not torch.isclose(judged["human", "omega"], trained["human", "omega"]).any()
