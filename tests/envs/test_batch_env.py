"""Several questions in one action: what is asked, what is known when, and what comes out."""

from __future__ import annotations

import pytest
import torch
from conftest import RESPONSE_MODELS
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import RewardSum, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.base import HumanBase
from torchrl_pref.humans.drifting import Drifting
from torchrl_pref.humans.imperfect import Skipping
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.strategies import RandomQuery

SOME = torch.tensor([[3, 7, 1], [3, 4, 5], [0, 2, 9], [8, 6, 2]])
"""Three questions for each of four sessions."""

CASES = [{}, {"repeats": False}, {"candidates": 10}, {"candidates": 10, "repeats": False}]


def env_of(
    pool: QueryPool,
    batch: int = 3,
    model: ResponseModel = RESPONSE_MODELS[0],
    human: type[HumanBase] = SimulatedHuman,
    **options: object,
) -> QueryEnv:
    usual = {"budget": 6, "batch_size": (4,), "seed": 0, "objective": "information_gain"}
    options = {"batch": batch, **usual, **options}
    return QueryEnv(pool, human(model), Belief(model, 20, 2), **options)  # type: ignore[arg-type]


def asked(env: QueryEnv, session: TensorDictBase, action: Tensor) -> TensorDictBase:
    stepped = env.step(session.set("action", action))
    return stepped["next"].copy().update(stepped.select("human", "candidates", strict=False))


@pytest.mark.parametrize("options", CASES, ids=str)
def test_specs_hold_and_sessions_end_after_whole_batches(
    options: dict[str, object], pool: QueryPool
) -> None:
    env = env_of(pool, **options)
    check_env_specs(env)
    assert env.max_steps == 2
    data = env.rollout(130, break_when_any_done=False)
    assert data["action"].shape == (4, 130, 3)
    ends = data["next", "done"].squeeze(-1)
    assert torch.equal(ends, (torch.arange(130) % 2 == 1).expand(4, -1))
    assert data["next", "n_asked"].unique().tolist() == [3, 6]
    if "repeats" in options:
        assert all(
            len(row.unique()) == 6 for row in data["next", "session", "history", "index"][ends]
        )
        assert all(len(row.unique()) == 3 for row in data["action"].flatten(0, 1))


@pytest.mark.parametrize("human", [SimulatedHuman, Drifting, Skipping])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_a_batch_is_the_same_questions_one_by_one_to_the_last_bit(
    model: ResponseModel, human: type[HumanBase], pool: QueryPool
) -> None:
    at_once, singly = (env_of(pool, n, model, human) for n in (3, 1))
    first, second = at_once.reset(), singly.reset()
    bits = torch.zeros(4, 1)
    for batch in (SOME, SOME + 10):
        first = asked(at_once, first, batch)
        for question in batch.unbind(1):
            second = asked(singly, second, question)
            bits = bits + second["reward"]
        assert (first.exclude("reward", "action") == second.exclude("reward", "action")).all()
    assert first["done"].all()
    assert torch.allclose(first["session", "information"], bits, atol=1e-5)


def test_candidates_of_a_session_are_places_in_its_own_list(pool: QueryPool) -> None:
    env = env_of(pool, candidates=10)
    begun = env.reset()
    after = asked(env, begun, SOME)
    index = after["session", "history", "index"][:, :3]
    assert torch.equal(index, begun["candidates"].gather(1, SOME))


def test_the_reward_of_a_batch_is_what_all_its_answers_add(pool: QueryPool) -> None:
    env = env_of(pool)
    data = env.rollout(2, RandomQuery(batch=3))
    total = data["next", "reward"].sum(1)
    assert torch.allclose(total, data["next", "session", "information"][:, -1], atol=1e-5)
    assert (total > 0).all()


def test_a_session_that_has_ended_is_asked_nothing_more(pool: QueryPool) -> None:
    env = env_of(pool, repeats=False)
    ended = asked(env, asked(env, env.reset(), SOME), SOME + 10)
    again = asked(env, ended.exclude("reward"), SOME)
    assert (again["reward"] == 0).all()
    kept = [key for key in ended.keys() if key != "reward"]  # noqa: SIM118
    assert (again.select(*kept) == ended.select(*kept)).all()


def test_without_repeats_no_question_comes_twice(pool: QueryPool) -> None:
    env = env_of(pool, repeats=False)
    twice = SOME.clone()
    twice[2, 2] = twice[2, 0]
    with pytest.raises(InputError, match="a query that was asked before"):
        asked(env, env.reset(), twice)
    after = asked(env, env.reset(), SOME)
    later = SOME + 10
    later[1, 1] = SOME[1, 2]
    with pytest.raises(InputError, match="a query that was asked before"):
        asked(env, after, later)
    assert asked(env_of(pool), env_of(pool).reset(), twice)["n_asked"].unique().tolist() == [3]


def test_partial_resets_begin_some_sessions_anew(pool: QueryPool) -> None:
    env = env_of(pool, repeats=False)
    session = env.step_mdp(env.step(env.reset().set("action", SOME)))
    session["_reset"] = torch.tensor([[True], [False], [False], [True]])
    session = env.reset(session, set_state=False)
    assert session["n_asked"].squeeze(-1).tolist() == [0, 3, 3, 0]
    drawn = torch.stack([env.rand_action(session)["action"].clone() for _ in range(100)])
    assert drawn.shape == (100, 4, 3)
    for b, mask in enumerate(session["action_mask"]):
        assert mask[drawn[:, b]].all()
        assert mask.sum() == (60 if b in (0, 3) else 57)
    after = env.step(session)["next"]
    assert after["done"].squeeze(-1).tolist() == [False, True, True, False]


def test_collectors_transforms_and_serial_environments_take_batches(pool: QueryPool) -> None:
    env = TransformedEnv(env_of(pool, repeats=False), RewardSum())
    env.append_transform(StepCounter())
    check_env_specs(env)
    collector = Collector(
        env, None, frames_per_batch=40, total_frames=80, auto_register_policy_transforms=False
    )
    for data in collector:
        assert data["action"].shape == (4, 10, 3)
        assert (data["step_count"] < 2).all()
    collector.shutdown()
    several = SerialEnv(2, lambda: env_of(pool))
    assert several.rollout(4, break_when_any_done=False)["action"].shape == (2, 4, 4, 3)


def test_an_evaluation_knows_of_no_answer_before_the_batch_is_told(pool: QueryPool) -> None:
    env = env_of(pool)
    result = evaluate(env, RandomQuery(batch=3), draw_humans(env))
    assert result.alignment.shape == (4, 7)
    for name in ("alignment", "alignment_of_mean", "information", "ess"):
        curve = getattr(result, name)
        assert torch.equal(curve[:, 0:3], curve[:, :1].expand(-1, 3))
        assert torch.equal(curve[:, 3:6], curve[:, 3:4].expand(-1, 3))
    assert not torch.equal(result.alignment[:, 2], result.alignment[:, 3])
    assert not torch.equal(result.alignment[:, 5], result.alignment[:, 6])
    assert result.asked.tolist() == [6] * 4


def test_random_batches_are_of_different_candidates(pool: QueryPool) -> None:
    session = env_of(pool).reset()
    session["action_mask"][:, 5:] = False
    action = RandomQuery(seed=1, batch=3)(session)["action"]
    assert action.shape == (4, 3)
    assert (action < 5).all()
    assert all(len(row.unique()) == 3 for row in action)


def test_one_at_a_time_is_what_it_was(pool: QueryPool) -> None:
    assert env_of(pool, batch=1).action_spec.shape == (4,)
    action = RandomQuery(seed=1)(env_of(pool, batch=1).reset())["action"]
    assert action.shape == (4,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch": 0}, "setup.batch=0: expected a whole number of at least 1"),
        ({"batch": 4}, r"setup\.budget=6 with setup\.batch=4: expected a budget of whole batches"),
        ({"batch": 12}, r"set setup\.budget=12, or another batch"),
    ],
)
def test_bad_batches_are_refused(options: dict[str, int], message: str, pool: QueryPool) -> None:
    with pytest.raises(InputError, match=message):
        env_of(pool, **options)  # type: ignore[arg-type]


def test_an_action_of_another_size_is_refused(pool: QueryPool) -> None:
    env = env_of(pool)
    with pytest.raises(InputError, match=r"action of shape \(4,\): expected \(4, 3\), 3 numbers"):
        env._step(env.reset().set("action", SOME[:, 0]))
