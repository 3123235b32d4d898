"""A stranger's TorchRL loop: wrappers, transforms, workers and learners meet no surprise.

The lines of docs/torchrl.md are here, each run.
"""

from __future__ import annotations

import contextlib
import copy
import functools
from typing import Any

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import ENVS, coin, make
from scripts import CONTEXT
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector, MultiSyncCollector, _multi_base
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    CatTensors,
    Compose,
    ExcludeTransform,
    ObservationNorm,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import (
    MLP,
    EGreedyModule,
    MaskedCategorical,
    ProbabilisticActor,
    QValueActor,
)
from torchrl.objectives import DiscreteSACLoss, DQNLoss, SoftUpdate

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.frames import PoolOnce
from torchrl_pref.envs.objectives import OBJECTIVES, alignment, make_objective
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.session import is_feed
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.policies.attention import attention_policy
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.policies.scorer import scorer_policy
from torchrl_pref.pool import QueryPool
from torchrl_pref.pretrained import pretrained_policy
from torchrl_pref.strategies import Greedy, QuantileAsk, RandomAsk, RandomQuery
from torchrl_pref.tasks.gridworld import gridworld_pool

COLLECTED = {"frames_per_batch": 80, "total_frames": 160, "auto_register_policy_transforms": False}

SESSION = ("session", "samples")


def free(kind: type) -> dict[str, Any]:
    return {"skip": "free", "objective": "alignment"} if kind is FeedEnv else {}


def few(pool: QueryPool, **options: Any) -> QueryEnv | FeedEnv:
    """Six queries, of which five are to be asked, none twice."""
    return make(QueryEnv, QueryPool(pool.features[:6]), repeats=False, **options)


# What a policy must not see


@pytest.mark.parametrize("kind", ENVS)
def test_what_is_hidden_is_no_observation(kind: type, pool: QueryPool) -> None:
    options = {} if kind is FeedEnv else {"candidates": 10}
    for name in OBJECTIVES:
        env = make(kind, pool, objective=name, **options)
        hidden = {"human", "offers", "candidates"}
        seen = {key if isinstance(key, str) else key[0] for key in env.observation_keys}
        assert not seen & hidden
        data = env.rollout(4, coin(env))
        assert not hidden & set(data["next"].keys())
        omega = data["human", "omega"]
        secrets = [omega, alignment(data["next", "samples"], omega).expand_as(omega)]
        for key in env.observation_keys:
            value = data["next"][key]
            for secret in secrets if value.ndim == 3 and value.is_floating_point() else []:
                assert not torch.isclose(value, secret[..., : value.shape[-1]]).all()


# Transforms


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("key", ["samples", "mean", "remaining"])
def test_a_transform_rewrites_what_is_shown_and_not_the_session(
    kind: type, key: str, pool: QueryPool
) -> None:
    bare = make(kind, pool, seed=3, **free(kind))
    norm = ObservationNorm(loc=1.0, scale=3.0, in_keys=[key])
    env = TransformedEnv(make(kind, pool, seed=3, **free(kind)), norm)
    expected = bare.rollout(12, coin(bare), break_when_any_done=False)
    found = env.rollout(12, coin(bare), break_when_any_done=False)
    assert (found["next", "session"] == expected["next", "session"]).all()
    assert torch.equal(found["next", "reward"], expected["next", "reward"])
    assert torch.allclose(found["next", key], 3 * expected["next", key] + 1)
    check_env_specs(env)


@pytest.mark.parametrize("kind", ENVS)
def test_a_transform_that_writes_in_place_does_not_reach_the_session(
    kind: type, pool: QueryPool
) -> None:
    def spoil(tensordict: TensorDictBase) -> TensorDictBase:
        for key in ("samples", "mean", "n_asked"):
            tensordict[key].mul_(0)
        return tensordict

    bare = make(kind, pool)
    env = TransformedEnv(make(kind, pool), spoil)
    expected, found = bare.rollout(5, coin(bare)), env.rollout(5, coin(bare))
    assert (found["next", "samples"] == 0).all()
    assert (found["next", "session"] == expected["next", "session"]).all()


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers")  # TorchRL's own
@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize(
    "transform",
    [
        lambda: CatTensors(["mean", "remaining"], "observation"),
        lambda: VecNormV2(in_keys=["mean"]),
        lambda: ExcludeTransform("samples"),
    ],
    ids=["CatTensors", "VecNormV2", "ExcludeTransform"],
)
def test_transforms_that_take_keys_away_work(kind: type, transform: Any, pool: QueryPool) -> None:
    env = TransformedEnv(make(kind, pool), transform())
    data = env.rollout(12, break_when_any_done=False)
    assert data.shape == (4, 12)
    assert data["next", "done"].any()
    assert data[("next", *SESSION)].isfinite().all()


@pytest.mark.parametrize("kind", ENVS)
def test_humans_are_not_there_to_be_excluded(kind: type, pool: QueryPool) -> None:
    with pytest.raises(KeyError, match="human not found"):
        TransformedEnv(make(kind, pool, **free(kind)), ExcludeTransform("human")).rollout(2)


@pytest.mark.parametrize("kind", ENVS)
def test_a_compact_collector_leaves_out_what_comes_again(kind: type, pool: QueryPool) -> None:
    env = make(kind, pool, batch=2, **free(kind))
    shown = set(env.observation_spec.keys())
    for compact in (True, False):
        options = {**COLLECTED, "frames_per_batch": 8, "total_frames": 8}
        (batch,) = Collector(env, coin(env), compact_obs=compact, **options)
        assert bool(shown & set(batch["next"].keys()) - {"session"}) != compact
        assert {"reward", "done", "terminated"} <= set(batch["next"].keys())


@pytest.mark.parametrize("kind", ENVS)
def test_observation_norm_takes_its_statistics_from_rollouts(kind: type, pool: QueryPool) -> None:
    norm = ObservationNorm(in_keys=["mean"], standard_normal=True)
    env = TransformedEnv(make(kind, pool), norm)
    norm.init_stats(200, reduce_dim=(0, 1), cat_dim=1)  # the sessions, and the steps
    assert norm.loc.shape == (4,)
    check_env_specs(env)
    shown = env.rollout(200, break_when_any_done=False)["mean"].flatten(0, 1)
    assert torch.allclose(shown.mean(0), torch.zeros(4), atol=0.8)
    assert torch.allclose(shown.std(0), torch.ones(4), atol=0.8)


@pytest.mark.parametrize("kind", ENVS)
def test_evaluation_and_policies_are_the_same_on_a_transformed_environment(
    kind: type, pool: QueryPool
) -> None:
    model = RESPONSE_MODELS[0]
    makers: list[Any] = [
        lambda env: pretrained_policy(env).strategy,
        lambda env: paper_policy(env).strategy,
        lambda env: attention_policy(env).strategy,
        lambda env: QuantileAsk(env) if is_feed(env) else Greedy(model),
    ]
    for maker in makers:
        found = []
        for transforms in (
            [],
            [StepCounter(), ObservationNorm(0.5, 2.0, ["remaining"], ["share"])],
        ):
            env = make(kind, pool, batch=8, **free(kind))
            env = TransformedEnv(env, Compose(*transforms)) if transforms else env
            torch.manual_seed(0)
            strategy = maker(env)
            env.set_seed(1)
            found.append(evaluate(env, strategy, draw_humans(env)))
        for name in ("alignment", "information", "ess", "asked", "offered"):
            assert torch.equal(getattr(found[0], name), getattr(found[1], name))


@pytest.mark.parametrize("kind", ENVS)
def test_partial_resets_of_a_transformed_environment(kind: type, pool: QueryPool) -> None:
    env = TransformedEnv(make(kind, pool), StepCounter())
    data = env.rollout(2, coin(env.base_env))
    now = env.step_mdp(data[:, -1])
    before = now.clone()
    now["_reset"] = torch.tensor([[True], [False], [False], [True]])
    after = env.reset(now, set_state=False)
    for key in (("human", "omega"), "samples", SESSION, ("session", "history", "answers")):
        assert torch.equal(after[key][1:3], before[key][1:3])
    assert not torch.equal(after["human", "omega"][0], before["human", "omega"][0])
    assert (after["n_asked"][[0, 3]] == 0).all()
    env.step(coin(env.base_env)(after))


# Rollouts


@pytest.mark.parametrize("wrap", [False, True])
def test_random_actions_respect_the_mask(wrap: bool, pool: QueryPool) -> None:
    for env in (few(pool), few(pool, candidates=5)):
        env = TransformedEnv(env, StepCounter()) if wrap else env
        for _ in range(3):
            data = env.rollout(17, break_when_any_done=False)
            ended = data["next", "done"].squeeze(-1)
            asked = data["next", "session", "history", "index"][ended]
            assert len(asked) == 4 * 3
            assert all(len(row.unique()) == 5 for row in asked)
        asked = torch.cat([data["action"] for data in Collector(env, None, **COLLECTED)], 1)
        assert asked.shape == (4, 40)
        check_env_specs(env)


def test_random_actions_respect_the_mask_where_sessions_begin_apart(pool: QueryPool) -> None:
    env = few(pool)
    session = env.step_mdp(env.step(env.rand_action(env.reset())))
    session["_reset"] = torch.tensor([[True], [False], [False], [False]])
    session = env.reset(session, set_state=False)
    drawn = torch.stack([env.rand_action(session)["action"].clone() for _ in range(200)])
    allowed = session["action_mask"]
    for b in range(4):
        assert set(drawn[:, b].tolist()) == set(allowed[b].nonzero().squeeze(-1).tolist())


@pytest.mark.parametrize("kind", ENVS)
def test_a_rollout_of_a_policy_keeps_no_gradients(kind: type, pool: QueryPool) -> None:
    env = make(kind, pool, **free(kind))
    for maker in (scorer_policy, attention_policy, paper_policy):
        policy = maker(env)
        data = env.rollout(3, policy.strategy)
        assert not any(value.requires_grad for value in data.values(True, True))
        assert policy.actor(data.reshape(-1))["logits"].requires_grad  # a loss has them


def test_rewards_of_unfinished_steps_add_up_to_the_objective(pool: QueryPool) -> None:
    """TorchRL repeats the last frame of a session that ended before others, reward included."""
    env = make(FeedEnv, pool, batch=20, **free(FeedEnv))
    options = {"break_when_any_done": False, "break_when_all_done": True}
    data = env.rollout(100, RandomAsk(0.4, seed=1), **options)
    assert data["next", "done"].all(0)[-1].all()
    done = data["next", "done"]
    counts = done.long().cumsum(1) - done.long() == 0  # the line of docs/torchrl.md
    total = (data["next", "reward"] * counts).sum(1)
    first, last = data["session"][:, 0], data["next", "session"][:, -1]
    gained = make_objective("alignment").gained(first, last, data["human"][:, 0])
    assert torch.allclose(total, gained, atol=1e-5)
    assert not torch.allclose(data["next", "reward"].sum(1), gained, atol=1e-3)


@pytest.mark.parametrize("options", [{}, {"candidates": 10}])
def test_a_replay_buffer_holds_the_pool_once(options: dict[str, Any], pool: QueryPool) -> None:
    env = make(QueryEnv, pool, **options)
    data = env.rollout(5, RandomQuery()).reshape(-1)
    transform = PoolOnce(env)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20), transform=transform, batch_size=20
    )
    buffer.extend(data)
    stored = buffer[:].exclude("index")
    held = buffer.storage[:]
    assert "queries" not in set(held.keys())
    assert "queries" not in set(held["next"].keys())
    for key, value in data.items(True, True):
        assert torch.equal(stored[key], value), key
    sampled = buffer.sample()
    assert sampled["queries"].shape == (20, *data["queries"].shape[1:])
    whole = make(QueryEnv, QueryPool(torch.rand(1000, 2, 4)), budget=20)
    frame = PoolOnce(whole).inv(whole.rollout(1, RandomQuery())[:1, 0])
    assert sum(value.nbytes for value in frame.values(True, True)) < 6500


def test_pool_once_refuses_what_it_could_not_put_back(pool: QueryPool) -> None:
    with pytest.raises(InputError, match="PoolOnce of a feed"):
        PoolOnce(make(FeedEnv, pool))
    env = TransformedEnv(make(QueryEnv, pool), ObservationNorm(1.0, 2.0, in_keys=["queries"]))
    with pytest.raises(InputError, match="a transform rewrote them"):
        PoolOnce(env).inv(env.rollout(2, RandomQuery()))


def test_a_step_without_the_session_says_so(pool: QueryPool) -> None:
    env = make(QueryEnv, pool)
    with pytest.raises(InputError, match="without the key session"):
        env.step(RandomQuery()(env.reset()).exclude("session"))


@pytest.mark.parametrize("seed", [-1, 1.5, "a", 2**70])
def test_a_seed_that_is_none_is_refused(seed: Any, pool: QueryPool) -> None:
    with pytest.raises(InputError, match="seed="):
        make(QueryEnv, pool).set_seed(seed)


# Workers


def _feed(seed: int | None = None) -> FeedEnv:
    model = RESPONSE_MODELS[0]
    human, belief = SimulatedHuman(model), Belief(model, 20, 2)
    return FeedEnv(gridworld_pool(30), human, belief, 5, batch_size=(3,), seed=seed)


def humans_met(data: TensorDictBase) -> torch.Tensor:
    """The weights of those who begin a session."""
    return data["human", "omega"][(data["n_offered"] == 0).squeeze(-1)]


def test_workers_of_a_collector_never_face_the_same_humans() -> None:
    collector = MultiSyncCollector([_feed, _feed], None, **COLLECTED | {"total_frames": 240})
    try:
        met = torch.cat([humans_met(data) for data in collector])
    finally:
        collector.shutdown()
    assert len(met) > 12
    assert len(met.unique(dim=0)) == len(met)


def test_an_environment_that_is_handed_to_workers_is_another_one_in_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is pickled for workers that are forked from the server of the scripts, as for others."""
    monkeypatch.setattr(_multi_base, "_get_mp_ctx", lambda: CONTEXT)
    monkeypatch.setattr(_multi_base, "_set_mp_start_method_if_unset", lambda method: method)
    env = _feed()
    collector = MultiSyncCollector(
        [functools.partial(_same, env), functools.partial(_same, env)], None, **COLLECTED
    )
    try:
        met = torch.cat([humans_met(data) for data in collector])
    finally:
        collector.shutdown()
    assert len(met.unique(dim=0)) == len(met)


def _same(env: FeedEnv) -> FeedEnv:
    return env


def test_a_policy_is_not_for_the_workers_of_an_environment() -> None:
    with pytest.raises(InputError, match=r"batch size \(2, 3\): expected one size"):
        pretrained_policy(SerialEnv(2, _feed))


def test_a_copy_faces_other_humans_unless_it_has_a_seed() -> None:
    env, seeded = _feed(), _feed(seed=3)
    assert not torch.equal(copy.deepcopy(env).reset()["samples"], env.reset()["samples"])
    assert torch.equal(copy.deepcopy(seeded).reset()["samples"], seeded.reset()["samples"])


def test_a_seed_is_obeyed_and_its_absence_is_new_each_time() -> None:
    first, again, other, another = (_feed(seed).reset()["samples"] for seed in (3, 3, None, None))
    assert torch.equal(first, again)
    assert not torch.equal(other, another)
    env = _feed()
    env.set_seed(3)
    assert torch.equal(env.reset()["samples"], first)


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
@pytest.mark.parametrize("use_buffers", [True, False])
def test_batched_environments_remember_their_humans(kind: type, use_buffers: bool) -> None:
    options = {"mp_start_method": "fork"} if kind is ParallelEnv else {}
    env = kind(2, _feed, use_buffers=use_buffers, **options)
    try:
        env.set_seed(0)
        for _ in range(2):
            data = env.rollout(25, break_when_any_done=False)
            assert data.shape == (2, 3, 25)
            information = data["next", "session", "information"].squeeze(-1)
            fresh = (data["n_offered"] == 0).squeeze(-1)[..., 1:]
            assert (information.diff(dim=-1)[~fresh] >= 0).all()
            assert fresh.any()
            assert not torch.equal(data["samples"][0], data["samples"][1])
        assert env.rollout(25).shape[:2] == (2, 3)
        after = env.step_and_maybe_reset(env.rand_action(env.reset()))[1]
        human = after.get("human", None)
        assert (human is None) == (kind is SerialEnv and use_buffers)
        assert human is None or torch.equal(human["number"], after["session", "number"])
        # With buffers of its own a Collector cannot stack what a first frame lacks.
        sizes = {"frames_per_batch": 84, "total_frames": 168}
        batches = list(Collector(env, None, use_buffers=False, **COLLECTED | sizes))
        assert [batch.shape for batch in batches] == [(2, 3, 14), (2, 3, 14)]
    finally:
        if not env.is_closed:
            env.close()


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
def test_a_strategy_respects_the_mask_that_stays_in_the_workers(
    kind: type, pool: QueryPool
) -> None:
    options = {"mp_start_method": "fork"} if kind is ParallelEnv else {}
    env = kind(2, functools.partial(few, pool), **options)
    try:
        asked = env.rollout(5, RandomQuery())["next", "session", "history", "index"][..., -1, :]
        assert all(len(row.unique()) == 5 for row in asked.flatten(0, 1))
    finally:
        env.close()


def test_the_same_answers_with_and_without_buffers() -> None:
    found = []
    for use_buffers in (True, False):
        env = SerialEnv(2, _feed, use_buffers=use_buffers)
        env.set_seed(7)
        torch.manual_seed(0)
        found.append([env.rollout(25, break_when_any_done=False)["next", "samples"] for _ in "ab"])
        env.close()
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


def test_sessions_without_their_humans_are_refused(pool: QueryPool) -> None:
    env = make(QueryEnv, pool)
    after = env.step(env.rand_action(env.reset()))["next"]
    env.step(env.rand_action(after.clone()))  # remembered
    env.reset()
    with pytest.raises(InputError, match="sessions without their humans"):
        env.step(env.rand_action(after))


# Learners


def test_policies_respect_the_mask_on_a_transformed_environment(pool: QueryPool) -> None:
    for maker in (scorer_policy, attention_policy, paper_policy):
        env = TransformedEnv(few(pool), StepCounter())
        asked = env.rollout(5, maker(env).strategy)["next", "session", "history", "index"][:, -1]
        assert all(len(row.unique()) == 5 for row in asked)


def q_network(pool_size: int = 60) -> MLP:
    return MLP(4, pool_size, num_cells=[16])


def test_dqn_takes_the_spec_of_one_session(pool: QueryPool) -> None:
    env = few(pool)
    spec = env.action_spec_unbatched
    masked = {"action_space": "categorical", "action_mask_key": "action_mask"}
    network = QValueActor(q_network(6), in_keys=["mean"], spec=spec, **masked)
    explore = EGreedyModule(spec, eps_init=0.5, action_mask_key="action_mask")
    data = env.rollout(15, TensorDictSequential(network, explore), break_when_any_done=False)
    asked = data["next", "session", "history", "index"][data["next", "done"].squeeze(-1)]
    assert all(len(row.unique()) == 5 for row in asked)
    criterion = DQNLoss(network, action_space=spec)
    SoftUpdate(criterion, eps=0.99)
    loss = criterion(data.reshape(-1))["loss"]
    loss.backward()
    assert loss.isfinite()


def test_discrete_sac_needs_a_finite_number_for_what_is_masked(pool: QueryPool) -> None:
    env = few(pool)
    logits = TensorDictModule(q_network(6), in_keys=["mean"], out_keys=["logits"])

    def losses(**options: Any) -> TensorDictBase:
        actor = ProbabilisticActor(
            logits,
            in_keys={"logits": "logits", "mask": "action_mask"},
            distribution_class=MaskedCategorical,
            distribution_kwargs=options,
        )
        value = TensorDictModule(q_network(6), in_keys=["mean"], out_keys=["action_value"])
        loss = DiscreteSACLoss(
            actor, value, num_actions=6, action_space="categorical", target_entropy=0.5
        )
        loss.make_value_estimator(gamma=0.9)
        SoftUpdate(loss, eps=0.99)
        with torch.no_grad():
            data = env.rollout(15, actor, break_when_any_done=False)
        return loss(data.reshape(-1))

    found = losses(neg_inf=-1e9)
    assert all(value.isfinite().all() for value in found.values())
    (found["loss_actor"] + found["loss_qvalue"]).backward()
    assert all(weight.grad.isfinite().all() for weight in logits.parameters())
    assert losses()["loss_actor"].isnan()  # TorchRL's own limit: 0 times minus infinity


@pytest.mark.parametrize("batch", [1, 2])
def test_no_transform_can_write_into_the_pool(batch: int, pool: QueryPool) -> None:
    env, before = make(QueryEnv, pool, batch=batch), pool.features.clone()
    queries = env.reset()["queries"]
    with contextlib.suppress(RuntimeError):  # where torch sees that it is one pool for all
        queries.mul_(3)
    assert torch.equal(pool.features, before)
    assert torch.equal(env.features, before)
