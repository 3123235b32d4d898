import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
import torch
from conftest import RESPONSE_MODELS
from helpers import make, settings_of, trainer_of
from torch import Generator

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.build import make_query_env
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment, alignment_of_mean
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import (
    check_evaluation,
    compare,
    evaluate_task,
    group_checkpoints,
)
from torchrl_pref.evaluation.run import CURVES, draw_humans, evaluate
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.pool import QueryPool
from torchrl_pref.strategies import Greedy, RandomAsk, RandomQuery
from torchrl_pref.training.start import make_checkpoint


def test_query_curves_are_those_of_the_rollout(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, batch=6, seed=2)
    humans = draw_humans(env)
    env.set_seed(5)
    result = evaluate(env, RandomQuery(3), humans)
    env.set_seed(5)
    start = env.reset(humans.clone(), set_state=True)
    data = env.rollout(5, RandomQuery(3), auto_reset=False, tensordict=start)
    states = [start["session"], *data["next", "session"].unbind(1)]
    for name in ("information", "ess"):
        curve = torch.cat([state[name] for state in states], 1)
        assert torch.equal(getattr(result, name), curve)
    for measure in (alignment, alignment_of_mean):
        curve = torch.cat(
            [measure(state["samples"], humans["human", "omega"]) for state in states], 1
        )
        assert torch.equal(getattr(result, measure.__name__), curve)
    asked = data["next", "session", "history", "index"][:, -1]
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


def test_repeats_are_asked_queries_and_not_open_slots(pool: QueryPool) -> None:
    single = QueryPool(pool.features[:1])
    env = make(FeedEnv, single, batch=40, offers=7)
    result = evaluate(env, RandomAsk(0.4, seed=1), draw_humans(env))
    assert result.asked.min() == 0
    assert result.asked.max() > 2
    assert torch.equal(result.repeated, (result.asked - 1).clamp(min=0))


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
        answers.append(data["next", "session", "history", "answers"][:, -1])
    assert torch.equal(answers[0], answers[1])
    assert torch.equal(answers[0], answers[2])
    assert 0 < float(answers[0].float().mean()) < 1


def test_a_policy_draws_its_actions_only_where_it_is_told_to(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, batch=200, offers=20)
    policy = paper_policy(env)
    with torch.no_grad():
        for weight in policy.weights.parameters():
            weight.zero_()
        list(policy.actor.parameters())[-1][1] = 1.0  # asks with probability e / (1 + e)
    humans = draw_humans(env)
    assert (evaluate(env, policy.strategy, humans).offered == 5).all()
    drawn = evaluate(env, policy.strategy, humans, sample=True)
    assert (drawn.asked == 5).all()
    # Offers until the fifth ask: a negative binomial.
    assert float(drawn.offered.float().mean()) == pytest.approx(5 * (1 + 1 / math.e), abs=0.5)


def test_time_is_told_for_each_asked_query(
    pool: QueryPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(FeedEnv, pool, batch=8, offers=7)
    humans = draw_humans(env)
    clock = SimpleNamespace(perf_counter=iter([10.0, 12.0]).__next__)
    monkeypatch.setattr("torchrl_pref.evaluation.run.time", clock)
    result = evaluate(env, RandomAsk(0.4, seed=1), humans)
    assert result.seconds_per_query == pytest.approx(2.0 / int(result.asked.sum()))


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_compared_strategies_have_the_luck_that_they_have_alone(setup: str) -> None:
    """Nothing depends on what ran before: neither the belief's luck nor a policy's own dice."""
    settings = settings_of(setup)
    settings["policy"]["sample"] = True
    trainer, task = trainer_of(settings)
    checkpoint = make_checkpoint(settings, task, trainer)
    results = compare(
        settings, task, task.test, {"policy_feed:one": checkpoint, "policy_feed:other": checkpoint}
    )
    n_humans, seed = check_evaluation(settings)
    env = make_query_env(settings, task, task.test, n_humans, seed)
    humans = draw_humans(env)
    for name, strategy in (
        ("greedy_information", Greedy(task.response_model)),
        ("greedy_alignment", Greedy(task.response_model, alignment_gain)),
    ):
        env.set_seed(seed)
        alone = evaluate(env, strategy, humans)
        for curve in CURVES:
            assert torch.equal(getattr(results[name], curve), getattr(alone, curve)), (name, curve)
    for curve in CURVES:
        assert torch.equal(
            *(getattr(results[f"policy_feed:{name}"], curve) for name in ("one", "other"))
        )
    assert len({float(result.alignment[:, 0].sum()) for result in results.values()}) == 1


def test_a_policy_that_picks_indices_is_shown_on_its_own_pool_too() -> None:
    settings = settings_of("query", "paper")
    trainer, task = trainer_of(settings)
    learned = {"policy_query": make_checkpoint(settings, task, trainer)}
    records = evaluate_task(settings, task, learned)
    held_out, own = records.tasks
    assert held_out.endswith("held-out pool")
    assert own.endswith("training pool")
    found = []
    for title, pool in ((held_out, task.test), (own, task.train)):
        for key, result in compare(settings, task, pool, learned).items():
            values = records.of_task(title).values(key, "alignment")
            assert torch.equal(values[0, 0], result.alignment)
        found.append(values)
    assert not torch.equal(*found)


def test_runs_of_one_kind_are_told_apart_by_their_names() -> None:
    runs = []
    for name, setup in (("a", "query"), ("b", "query"), ("c", "feed")):
        settings = settings_of(setup)
        trainer, task = trainer_of(settings)
        runs.append((name, make_checkpoint(settings, task, trainer), task))
    ((settings, _, learned),) = group_checkpoints(runs)
    assert list(learned) == ["policy_query:a", "policy_query:b", "policy_feed"]
    assert settings["setup"]["name"] == "feed"  # the baselines of a feed are shown too


def test_what_a_skip_costs_is_a_matter_of_feeds_alone() -> None:
    runs = []
    for name, setup, skip in (
        ("a", "query", "regret"),
        ("b", "query", "free"),
        ("c", "feed", "free"),
    ):
        settings = settings_of(setup)
        settings["skip"] = skip
        trainer, task = trainer_of(settings)
        runs.append((name, make_checkpoint(settings, task, trainer), task))
    ((settings, _, learned),) = group_checkpoints(runs)
    assert len(learned) == 3
    assert settings["skip"] == "free"
    _, other, task = runs[-1]
    regretful = replace(other, settings={**other.settings, "skip": "regret"})
    with pytest.raises(InputError, match="differ in skip: regret and free"):
        group_checkpoints([*runs, ("d", regretful, task)])


def test_bootstrap_agrees_with_scipy(generator: Generator) -> None:
    values = torch.randn(60, generator=generator) ** 2
    expected = scipy.stats.bootstrap(
        (values.numpy(),), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert bootstrap_interval(values) == pytest.approx(tuple(expected), abs=0.03)
    assert bootstrap_interval(torch.full((9,), 2.0)) == (pytest.approx(2.0), pytest.approx(2.0))


def test_humans_of_the_evaluation_are_not_those_of_the_training() -> None:
    settings = settings_of()
    settings["evaluation"] = {"humans": settings["training"]["sessions"], "seed": settings["seed"]}
    trainer, task = trainer_of(settings)
    n_humans, seed = check_evaluation(settings)
    judged = draw_humans(make_query_env(settings, task, task.test, n_humans, seed))
    trained = trainer.sessions.hidden["human"]["omega"]
    assert not torch.isclose(judged["human", "omega"], trained).any()
