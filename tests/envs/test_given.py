"""Environments whose humans show something first: state, resets, specs, other processes."""

from __future__ import annotations

import pytest
import torch
from helpers import ENVS, coin, make, same
from tensordict import TensorDict
from torch import Generator, Tensor
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import LEFT_OUT, OPEN, tell
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.humans.demonstrations import Demonstrations
from torchrl_pref.humans.imperfect import Skipping
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.strategies import Greedy, RandomQuery

SHOWN = Demonstrations(2, 4, 3.0)


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("model", [Boltzmann(4.4), Optimal()], ids=str)
def test_specs_and_many_resets(
    kind: type[QueryEnv] | type[FeedEnv], model: Boltzmann | Optimal, pool: QueryPool
) -> None:
    """What a session was given stays what it was until it ends, and never mixes with another's."""
    shown = Demonstrations(2, 4, None if isinstance(model, Optimal) else 3.0)
    env = make(kind, pool, model, demonstrations=shown)
    check_env_specs(env)
    data = env.rollout(60, coin(env), break_when_any_done=False)
    kept, human = data["session"], data["human", "omega"]
    assert kept["given", "rows"].shape == (4, 60, 2, 4, 4)
    same_human = (human[:, 1:] == human[:, :-1]).all(-1)
    same_rows = (kept["given", "rows"][:, 1:] == kept["given", "rows"][:, :-1]).flatten(2).all(-1)
    assert torch.equal(same_human, same_rows)
    assert not same_human.all()


def test_the_belief_knows_before_the_first_question(pool: QueryPool) -> None:
    aligned = []
    for shown in (None, SHOWN):
        env = make(QueryEnv, pool, batch=300, demonstrations=shown)
        start = env.reset()
        cosines = (start["samples"] * start["human", "omega"].unsqueeze(1)).sum(-1)
        aligned.append(float(cosines.mean()))
        assert torch.equal(start["mean"], start["session", "samples"].mean(1))
        assert "given" in start["session"].keys() or shown is None  # noqa: SIM118
    assert abs(aligned[0]) < 0.1
    assert aligned[1] > 0.3


def test_none_are_as_if_there_were_no_such_thing(pool: QueryPool) -> None:
    plain, none = (
        make(QueryEnv, pool, demonstrations=shown).rollout(5, RandomQuery(1))
        for shown in (None, Demonstrations(0))
    )
    assert same(plain.to_dict(), none.to_dict())


def test_a_batch_is_its_sessions_one_by_one(pool: QueryPool) -> None:
    """What one was given says nothing of another: the update by an answer, session by session."""
    env = make(QueryEnv, pool, Boltzmann(4.4), batch=3, demonstrations=SHOWN)
    start = env.reset()
    _, state = env._session_of(start)
    rows = state["given"]["rows"]
    query, answers = pool.features[:3], torch.tensor([0, 1, REFUSED])
    after = tell(env.belief, state, query, answers, torch.arange(3), Generator().manual_seed(1))
    assert torch.equal(after["given"]["rows"], rows)
    assert torch.equal(after["samples"][2], state["samples"][2])
    changed = {**state, "given": {**state["given"], "rows": rows.clone()}}
    changed["given"]["rows"][0] *= -1
    other = tell(env.belief, changed, query, answers, torch.arange(3), Generator().manual_seed(1))  # type: ignore[arg-type]
    assert torch.equal(other["samples"][1:], after["samples"][1:])
    assert not torch.equal(other["samples"][0], after["samples"][0])


def test_strategies_meet_the_same_humans_who_showed_the_same(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, batch=50, demonstrations=SHOWN)
    humans = draw_humans(env)
    results = [evaluate(env, RandomQuery(seed), humans) for seed in (0, 1)]
    first, second = (result.alignment[:, 0] for result in results)
    assert torch.equal(first, second)
    start = env.reset(humans.clone(), set_state=True)
    assert torch.equal(start["session", "given", "rows"], humans["session", "given", "rows"])
    assert torch.equal(start["session", "ess"], humans["session", "ess"])


@pytest.mark.parametrize("left", [("session", "given"), ("session", "samples")])
def test_humans_come_with_what_they_showed(left: tuple[str, ...], pool: QueryPool) -> None:
    env = make(QueryEnv, pool, demonstrations=SHOWN)
    humans = draw_humans(env).exclude(left)
    with pytest.raises(InputError, match=r"without session\." + left[1]):
        env.reset(humans, set_state=True)


def test_spoiled_demonstrations_are_refused(pool: QueryPool) -> None:
    env = make(QueryEnv, pool, demonstrations=SHOWN)
    for key, value in (("rows", torch.nan), ("offsets", torch.nan), ("offsets", -torch.inf)):
        humans = draw_humans(env).clone()
        humans["session", "given", key][0] = value
        with pytest.raises(InputError, match=rf"session\.given\.{key}: NaN"):
            env.reset(humans, set_state=True)
    humans = draw_humans(env).clone()
    humans["session", "given", "offsets"][0, 0, 0] = torch.inf  # no such row
    env.reset(humans, set_state=True)


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
def test_other_processes(kind: type[SerialEnv] | type[ParallelEnv], pool: QueryPool) -> None:
    def made() -> QueryEnv:
        env = make(QueryEnv, pool, Boltzmann(4.4), batch=2, demonstrations=SHOWN)
        assert isinstance(env, QueryEnv)
        return env

    options = {"mp_start_method": "fork"} if kind is ParallelEnv else {}
    envs = kind(2, made, **options)
    try:
        data = envs.rollout(12, break_when_any_done=False)
    finally:
        envs.close()
    rows = data["next", "session", "given", "rows"]
    assert rows.shape == (2, 2, 12, 2, 4, 4)
    assert torch.equal(rows[:, :, 0], rows[:, :, 3])
    assert not torch.equal(rows[:, :, 0], rows[:, :, 7])


def test_humans_may_see_other_features(pool: QueryPool) -> None:
    """They judge by them, and the belief learns of its own."""
    seen = -pool.features
    human = Skipping(Optimal(), threshold=-0.2)
    env = QueryEnv(pool, human, Belief(Optimal(), 20), 4, batch_size=(40,), seed=0, seen=seen)
    data = env.rollout(4, Greedy(Optimal()))[:, -1]["next", "session", "history"]
    answers: Tensor = data["answers"]
    assert (answers == REFUSED).any()
    assert set(answers.unique().tolist()) <= {0, 1, REFUSED, LEFT_OUT}
    assert (answers != OPEN).all()
    shown: TensorDict = env.reset()
    options = pool.features[:40]
    after = env._answered(env._session_of(shown)[1], shown["human"].to_dict(), torch.arange(40))
    answers = after["history"]["answers"][:, 0]
    returns = (options @ shown["human", "omega"].unsqueeze(-1)).squeeze(-1)
    poor = (-returns).amax(-1) < -0.2
    assert torch.equal(answers == REFUSED, poor)
    assert torch.equal(answers[~poor], returns.argmin(-1)[~poor])
    with pytest.raises(InputError, match="seen of shape"):
        QueryEnv(pool, human, Belief(Optimal(), 20), seen=seen[1:])
