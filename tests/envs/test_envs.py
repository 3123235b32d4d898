from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import ENVS, coin, make
from reference import FeedSession, Session, alignment
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import (
    ActionMask,
    Compose,
    ParallelEnv,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import alignment as true_alignment
from torchrl_pref.envs.objectives import alignment_of_mean
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import LEFT_OUT, NOT_OF_THE_POOL, OPEN
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import RandomAsk, RandomQuery
from torchrl_pref.tasks.gridworld import gridworld_pool


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
@pytest.mark.parametrize("on_skip", ["new", "repeat"])
@pytest.mark.parametrize("kind", ENVS)
def test_agrees_with_the_reference_step_by_step(
    kind: type, on_skip: str, model: ResponseModel, pool: QueryPool
) -> None:
    options = {"on_skip": on_skip} if kind is FeedEnv else {}
    env = make(kind, pool, model, batch=3, **options)
    tau = getattr(model, "tau", None)
    td = env.reset()
    sessions = []
    for b in range(3):
        human = td["human"][b].double()
        arguments = (
            pool.features.double().numpy(),
            human["omega"].numpy(),
            human["noise"].numpy(),
            tau,
            5,
        )
        if kind is FeedEnv:
            stream = td["offers"][b].tolist()
            sessions.append(FeedSession(*arguments, offers=stream, on_skip=on_skip))
        else:
            sessions.append(Session(*arguments))
    policy = coin(env)
    for _ in range(12):
        td = env.step(policy(td))
        after = td["next"]
        for b, session in enumerate(sessions):
            if td["done"][b]:
                continue
            samples = td["samples"][b].double().numpy()
            action = int(td["action"][b])
            if isinstance(session, FeedSession):
                assert torch.equal(td["offer"][b], pool.features[session.offered])
                reward = session.decide(action == 1, samples)
                assert after["truncated"][b] == session.truncated
                assert after["n_offered"][b] == session.n_offered
            else:
                reward = session.ask(action, samples)
            asked = len(session.queries)
            assert float(after["reward"][b]) == pytest.approx(reward, abs=1e-5)
            known = after["session"][b]
            history = known["history"]
            assert history["index"][:asked].tolist() == session.queries
            assert torch.equal(history["options"][:asked], pool.features[session.queries])
            assert history["answers"][:asked].tolist() == session.answers
            assert (history["index"][asked:] == NOT_OF_THE_POOL).all()
            assert (history["answers"][asked:] == OPEN).all()
            assert after["n_asked"][b] == asked
            assert after["terminated"][b] == session.done
            assert float(known["information"]) == pytest.approx(session.information, abs=1e-4)
            belief, omega = after["samples"][b : b + 1], td["human", "omega"][b : b + 1]
            new = belief[0].double().numpy()
            mean = new.mean(0, keepdims=True)
            for ours, theirs in ((true_alignment, new), (alignment_of_mean, mean)):
                expected = alignment(theirs, session.omega)
                assert float(ours(belief, omega)) == pytest.approx(expected, abs=1e-5)
            assert np.allclose(after["mean"][b].numpy(), mean[0], atol=1e-6)
        td = env.step_mdp(td)


@pytest.mark.parametrize("options", [2, 3])
@pytest.mark.parametrize("kind", ENVS)
def test_specs_hold_over_many_resets(kind: type, options: int) -> None:
    env = make(kind, gridworld_pool(30, options))
    check_env_specs(env)
    data = env.rollout(130, coin(env), break_when_any_done=False)
    done = data["next", "done"].squeeze(-1)
    assert done.sum() >= 4 * 130 // 10
    assert env.observation_spec.is_in(data[:, -1].select(*env.observation_spec.keys()))
    # A session starts anew exactly where the one before has ended.
    fresh = (data["n_asked"] == 0).squeeze(-1)[:, 1:] & done[:, :-1]
    assert torch.equal(fresh, done[:, :-1])
    going_on = ~done[:, :-1]
    for key in ("omega", "noise"):
        now, then = data["human", key][:, 1:], data["human", key][:, :-1]
        assert torch.equal(now[going_on], then[going_on])
        assert not torch.equal(now[~going_on], then[~going_on])


@pytest.mark.parametrize("kind", ENVS)
def test_seed_fixes_every_bit_and_global_state_is_left_alone(kind: type, pool: QueryPool) -> None:
    before = torch.get_rng_state()
    runs = []
    for seed in (3, 3, 4):
        env = make(kind, pool, seed=seed)
        runs.append(env.rollout(12, coin(env), break_when_any_done=False))
    assert (runs[0] == runs[1]).all()
    assert not torch.equal(runs[0]["samples"], runs[2]["samples"])
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("kind", ENVS)
def test_given_humans_are_faced(kind: type, pool: QueryPool) -> None:
    prior = ("session", "samples")
    humans = make(kind, pool, seed=1).reset().select("human", prior)
    env = make(kind, pool, seed=2)
    td = env.reset(humans.clone(), set_state=True)
    number = ("human", "number")
    assert (td.select("human", prior).exclude(number) == humans.exclude(number)).all()
    assert torch.equal(td["samples"], humans[prior])
    assert (td["n_asked"] == 0).all()
    ignored = env.reset(humans.clone(), set_state=False)
    assert not torch.equal(ignored["human", "omega"], humans["human", "omega"])


def test_set_state_goes_on_mid_session(pool: QueryPool) -> None:
    env = make(QueryEnv, pool)
    middle = env.step_mdp(env.rollout(3, coin(env))[:, -1])
    state = middle.select(*env.state_spec.keys()).clone()
    resumed = env.reset(state, set_state=True)
    for key in env.observation_spec.keys(True, True):
        assert torch.equal(resumed[key], middle[key]) or key == ("session", "number")
    assert (resumed["session", "number"] != middle["session", "number"]).all()


@pytest.mark.parametrize("kind", ENVS)
def test_step_on_a_finished_session_changes_nothing(kind: type, pool: QueryPool) -> None:
    env = make(kind, pool)
    ask = RandomAsk(1.0) if kind is FeedEnv else RandomQuery()
    ended = env.rollout(5, ask)[:, -1]["next"]
    assert ended["done"].all()
    after = env.step(ask(ended.exclude("reward")))["next"]
    assert (after["reward"] == 0).all()
    assert (after.exclude("reward") == ended.exclude("reward")).all()


def test_feed_truncates_at_its_offers(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, offers=7)
    data = env.rollout(20, RandomAsk(0.0))
    assert data.shape == (4, 7)
    assert data["next", "truncated"][:, -1].all()
    assert not data["next", "terminated"].any()
    assert (data["next", "reward"] <= 0).all()
    assert make(FeedEnv, pool).n_offers == 10


@pytest.mark.parametrize("kind", ENVS)
def test_what_is_left_is_told_as_shares_of_all_asks_and_offers(kind: type, pool: QueryPool) -> None:
    env = make(kind, pool)
    ask = RandomAsk(0.5) if kind is FeedEnv else RandomQuery()
    data = env.rollout(10, ask)
    asked = (data["session", "history", "answers"] != OPEN).sum(-1, keepdim=True)
    left = [1 - asked / 5]
    if kind is FeedEnv:
        offered = torch.arange(data.shape[1])[:, None].expand_as(asked)
        left.append(1 - offered / 10)
    assert torch.equal(data["remaining"], torch.cat(left, -1))


def test_candidates_are_a_fresh_subset_for_each_session(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, candidates=10)
    data = env.rollout(10, coin(env), break_when_any_done=False)
    chosen = data["candidates"]
    assert chosen.shape == (4, 10, 10)
    assert torch.equal(data["queries"], pool.features[chosen])
    assert all(len(row.unique()) == 10 for row in chosen.flatten(0, 1))
    assert torch.equal(chosen[:, 0], chosen[:, 4])
    assert not torch.equal(chosen[0, 0], chosen[1, 0])
    assert not torch.equal(chosen[:, 4], chosen[:, 5])
    assert make(QueryEnv, pool, candidates=10**6).n_candidates == len(pool)


def test_without_repeats_every_question_is_new(pool: QueryPool) -> None:
    small = QueryPool(pool.features[:6])
    env = make(QueryEnv, small, repeats=False)
    asked = env.rollout(5, coin(env))["next", "session", "history", "index"][:, -1]
    assert all(len(row.unique()) == 5 for row in asked)
    with pytest.raises(InputError, match=r"4 candidates and budget=.* without repeats"):
        make(QueryEnv, small, repeats=False, candidates=4)


@pytest.mark.parametrize("kind", ENVS)
def test_works_in_a_collector_with_transforms(kind: type, pool: QueryPool) -> None:
    env = make(kind, pool)
    transforms = [RewardSum(), StepCounter()]
    if kind is QueryEnv:
        transforms.append(ActionMask())
    env = TransformedEnv(env, Compose(*transforms))
    check_env_specs(env)
    collector = Collector(
        env, None, frames_per_batch=80, total_frames=160, auto_register_policy_transforms=False
    )
    for data in collector:
        assert data.shape == (4, 20)
        ended = data["next", "done"].squeeze(-1)
        assert (data["next", "step_count"][ended] >= 5).all()
        assert data["next", "episode_reward"].isfinite().all()
    collector.shutdown()


def _make_for_worker() -> QueryEnv | FeedEnv:
    return make(FeedEnv, gridworld_pool(30), batch=2)


def test_works_in_parallel_env() -> None:
    env = ParallelEnv(2, _make_for_worker, mp_start_method="fork")
    try:
        env.set_seed(0)
        data = env.rollout(25, break_when_any_done=False)
        assert data.shape == (2, 2, 25)
        assert not torch.equal(data["samples"][0], data["samples"][1])
    finally:
        env.close()


def test_action_mask_is_obeyed_by_random_actions(pool: QueryPool) -> None:
    small = QueryPool(pool.features[:6])
    env = TransformedEnv(make(QueryEnv, small, repeats=False), ActionMask())
    asked = env.rollout(5)["next", "session", "history", "index"][:, -1]
    assert all(len(row.unique()) == 5 for row in asked)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (QueryEnv, {"budget": 0}, "setup.budget=0: expected a whole number of at least 1"),
        (QueryEnv, {"candidates": 0}, "setup.candidates=0"),
        (QueryEnv, {"batch_size": ()}, "batch_size"),
        (FeedEnv, {"offers": 4}, "setup.offers=4: expected a whole number of at least 5"),
        (FeedEnv, {"on_skip": "stay"}, "setup.on_skip='stay': expected one of new, repeat"),
    ],
)
def test_bad_options_are_refused(
    kind: type, options: dict[str, object], message: str, pool: QueryPool
) -> None:
    with pytest.raises(InputError) as error:
        make(kind, pool, **options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_belief_may_assume_another_model_than_the_human(pool: QueryPool) -> None:
    human, belief = SimulatedHuman(Boltzmann(0.5)), Belief(RESPONSE_MODELS[1], 20, 2)
    env = QueryEnv(pool, human, belief, 15, batch_size=(20,), seed=0)
    last = env.rollout(15, RandomQuery())[:, -1]["next"]
    assert last["samples"].isfinite().all()
    # A careless human contradicts themselves; such answers are left out of the history.
    assert (last["session", "history", "answers"] == LEFT_OUT).any()


def _read_keys(module: TensorDictSequential) -> set[str]:
    return {key if isinstance(key, str) else key[0] for key in module.in_keys}


def test_strategies_do_not_read_what_is_hidden(pool: QueryPool) -> None:
    from torchrl_pref.policies.paper import paper_policy
    from torchrl_pref.policies.scorer import scorer_policy
    from torchrl_pref.strategies import Greedy

    hidden = {"human", "session", "offers", "candidates"}
    modules: list[TensorDictBase] = [RandomQuery(), RandomAsk(), Greedy(RESPONSE_MODELS[0])]
    for kind in ENVS:
        for policy in (paper_policy, scorer_policy):
            made = policy(make(kind, pool))
            modules += [made.strategy, made.critic]
    for module in modules:
        assert not _read_keys(module) & hidden
