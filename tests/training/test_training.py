from __future__ import annotations

import copy
import csv
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import LEARNS_TO_ASK, same, settings_of, trained_in_parts, trainer_of
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.build import load_weights, reload_task
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks.gridworld import gridworld_pool
from torchrl_pref.training.start import make_checkpoint
from torchrl_pref.training.trainer import _explained_variance

PPO = {"name": "ppo", "clip_epsilon": 0.2, "epochs": 2, "minibatches": 3}


@pytest.mark.parametrize("algorithm", [{"name": "a2c"}, PPO], ids=["a2c", "ppo"])
@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("policy", ["scorer", "attention", "paper"])
def test_resumed_run_equals_an_uninterrupted_one_bit_for_bit(
    setup: str, policy: str, algorithm: dict[str, Any], tmp_path: Path
) -> None:
    results = []
    for stops in ([], [2, 5]):
        settings = {**settings_of(setup, policy), "algorithm": algorithm}
        if policy == "scorer":  # sessions that are left half-way keep what they were given
            settings["demonstrations"] = {"count": 2, "alternatives": 3, "tau": 2.0}
        folder = tmp_path / f"run{len(stops)}"
        results.append(trained_in_parts(settings, [*stops, 6], folder))
    whole, resumed = results
    assert same(whole.weights, resumed.weights)
    for name in ("update", "optimizer", "sessions", "env_generator", "global_generator"):
        assert same(whole.training[name], resumed.training[name]), name
    for name, values in whole.training["history"].items():
        if name.startswith("train/"):
            assert same(values, resumed.training["history"][name])
    tables = []
    for stops in (0, 2):
        with (tmp_path / f"run{stops}" / "training.csv").open(newline="") as file:
            tables.append([{**row, "frames_per_second": ""} for row in csv.DictReader(file)])
    assert tables[0] == tables[1]


def test_a2c_learns_what_the_feed_rewards(tmp_path: Path) -> None:
    """With the paper's ±r reward, asking pays: the episodes get shorter (the paper's Figure 2)."""
    settings = settings_of(policy="paper", updates=60, **LEARNS_TO_ASK)
    settings |= {"objective": "information_gain", "skip": "regret"}
    trainer, _ = trainer_of(settings)
    trainer.run(tmp_path, lambda: None)
    lengths = trainer.progress.history["train/episode_length"]
    assert sum(lengths[-5:]) / 5 < sum(lengths[1:6]) / 5 - 1
    assert sum(trainer.progress.history["train/reward"][-5:]) > 0


@pytest.mark.parametrize("skip", ["free", "regret"])
def test_gamma_counts_questions_where_skips_are_free(skip: str) -> None:
    trainer, _ = trainer_of({**settings_of(gamma=0.5, lmbda=0.0, steps=20), "skip": skip})
    batch = trainer.sessions.collect()
    later = batch["next", "state_value"]
    trainer.update(batch)
    asked = batch["action"].unsqueeze(-1) == 1
    assert asked.any()
    assert not asked.all()
    discount = torch.where(asked | (skip == "regret"), 0.5, 1.0)
    target = batch["next", "reward"] + discount * later * ~batch["next", "terminated"]
    assert torch.allclose(batch["value_target"], target, atol=1e-3)


def skip_often(trainer: Any, share: float) -> None:
    """Let 4 sessions skip this share of the offers, whatever the policy says."""
    acted = trainer.sessions._acted

    def skip(seen: Any) -> Any:
        return acted(seen).set("action", (torch.rand(4) >= share).long())

    trainer.sessions._acted = skip


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("policy", ["scorer", "attention", "paper"])
def test_sessions_go_as_torchrl_steps_them(setup: str, policy: str) -> None:
    settings = {**settings_of(setup, policy, steps=30), "skip": "regret"}
    (trainer, _), (other, _) = trainer_of(settings), trainer_of(settings)
    env, strategy = other.env, other.policy.strategy
    env.set_seed(settings["seed"])
    now, states = env.reset(), []
    torch.manual_seed(5)
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(30):
            step, now = env.step_and_maybe_reset(strategy(now))
            states.append(step)
    torch.manual_seed(5)
    batch, whole = trainer.sessions.collect(), torch.stack(states, 1)
    for key in (*trainer.policy.actor.in_keys, "logits", "action", "n_asked"):
        assert torch.equal(batch[key], whole[key]), key
    for key in ("reward", "done", "terminated", "n_asked"):
        assert torch.equal(batch["next", key], whole["next", key]), key
    assert whole["next", "done"].sum() > 4


@pytest.mark.parametrize("policy", ["scorer", "attention", "paper"])
@pytest.mark.parametrize(
    ("setup", "skip"), [("query", "free"), ("feed", "free"), ("feed", "regret")]
)
def test_a_batch_has_the_values_of_each_state_and_the_next(
    setup: str, skip: str, policy: str
) -> None:
    """In mid-session, at its end, and where it was cut off; whatever is remembered of a belief."""
    trainer, _ = trainer_of({**settings_of(setup, policy, steps=11), "skip": skip})
    env, states = trainer.env, []
    advance = env.advance

    def spy(hidden: Any, session: Any, action: Any) -> Any:
        after = advance(hidden, session, action)
        state, ahead = env.show(session, hidden), env.show(after.session, hidden)
        for key in ("reward", "terminated", "truncated"):
            ahead[key] = getattr(after, key)
        state["next"] = ahead.set("done", after.terminated | after.truncated)
        states.append(state.clone())
        return after

    skip_often(trainer, 0.7)
    env.advance = spy  # type: ignore[method-assign]
    trainer.sessions.collect()  # sessions are in mid-course then
    states.clear()
    batch = trainer.sessions.collect()
    whole = torch.stack(states, 1)
    with torch.no_grad():
        now = trainer.policy.critic(whole.clone())["state_value"]
        later = trainer.policy.critic(whole["next"].clone())["state_value"]
    assert torch.allclose(batch["state_value"], now, atol=1e-5)
    counts = ~whole["next", "terminated"]
    assert torch.allclose(batch["next", "state_value"][counts], later[counts], atol=1e-5)
    assert whole["next", "done"].any()
    assert skip != "regret" or whole["next", "truncated"].any()
    for key in ("reward", "done", "terminated", "n_asked"):
        assert torch.equal(batch["next", key], whole["next", key])
    ended = batch["next", "done"]
    length = "n_offered" if setup == "feed" else "n_asked"
    assert torch.equal(batch["next", "step_count"][ended], whole["next", length][ended])
    assert not {"samples", "human", "session"} & set(batch.keys()) or policy == "attention"


def test_critic_steps_bring_the_critic_to_the_returns() -> None:
    """Without them it still forecasts far too little when the policy begins to learn from it."""
    errors = []
    for critic_steps in (0, 20):
        constants = {
            "sessions": 32,
            "steps": None,
            "stages": 1,
            "optimizer": "adam",
            "learning_rate": 0.001,
        }
        settings = settings_of("query", critic_steps=critic_steps, warm_up=20, **constants)
        trainer, _ = trainer_of(settings)
        for _ in range(12):
            trainer.update(trainer.sessions.collect())
        batch = trainer.sessions.collect()  # whole sessions, from the first question to the last
        returns = batch["next", "episode_reward"][:, -1]
        with torch.no_grad():
            forecast = trainer.policy.value(batch.clone())["state_value"][:, 0]
        errors.append(float((returns - forecast).mean().abs()))
    plain, fitted = errors
    assert fitted < 0.1
    assert fitted < plain / 2


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_a_batch_has_the_steps_a_session_may_take(setup: str) -> None:
    trainer, _ = trainer_of(settings_of(setup, steps=None, stages=1))
    batch = trainer.sessions.collect()
    assert batch.shape == (4, 4 if setup == "query" else 20)
    assert batch["next", "done"].any(1).all()


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_sessions_are_at_as_many_stages_as_a_batch_is_short(setup: str) -> None:
    trainer, _ = trainer_of(settings_of(setup, steps=None, stages=4))
    skip_often(trainer, 1.0)  # a session of a feed then takes as many steps as it has offers
    whole = 4 if setup == "query" else 20
    batches = [trainer.sessions.collect(number) for number in range(8)]
    assert all(batch.shape == (4, whole // 4) for batch in batches)
    later = {key: torch.cat([b["next", key] for b in batches], 1) for key in ("step_count", "done")}
    steps = torch.arange(2 * whole)
    for row, counts in enumerate(later["step_count"].squeeze(-1)):
        begun = steps - row * whole // 4  # since its session began again
        assert torch.equal(counts, torch.where(begun < 0, steps, begun % whole) + 1)
        assert torch.equal(later["done"][row].squeeze(-1), (begun >= 0) & (counts == whole))
    rewards = torch.cat([batch["next", "reward"] for batch in batches], 1)
    totals = torch.cat([batch["next", "episode_reward"] for batch in batches], 1)
    for count in range(1, whole + 1):  # what a session has had, from its first step on
        for row, end in (later["step_count"].squeeze(-1) == count).nonzero():
            own = rewards[row, end + 1 - count : end + 1].sum()
            assert torch.allclose(totals[row, end].squeeze(), own, atol=1e-5)


def test_explained_variance_is_the_critics_share_of_the_returns() -> None:
    target = torch.tensor([0.0, 1.0, 2.0, 3.0])
    shares = []
    for value in (target, torch.ones(4), target.mean() + (target - target.mean()) / 2, -9 * target):
        batch = TensorDict({"value_target": target, "state_value": value}, [4])
        shares.append(_explained_variance(batch))
    assert shares == pytest.approx([1, 0, 0.75, -1])


@pytest.mark.parametrize("algorithm", [{"name": "a2c"}, PPO], ids=["a2c", "ppo"])
def test_warm_up_spares_the_actor_and_the_average_follows(algorithm: dict[str, Any]) -> None:
    settings = settings_of(warm_up=2, average=0.9, learning_rate=0.01)
    trainer, _ = trainer_of({**settings, "algorithm": algorithm})
    weights = trainer.policy.weights

    def part(name: str) -> torch.Tensor:
        return torch.cat([p.detach().flatten().clone() for p in weights[name].parameters()])

    def averaged() -> torch.Tensor:
        names = [name for name, _ in weights.named_parameters()]
        return torch.cat([trainer.average[name].flatten() for name in names])

    def raw() -> torch.Tensor:
        return torch.cat([p.detach().flatten().clone() for _, p in weights.named_parameters()])

    actor, expected = part("actor"), raw()
    for update in range(4):
        critic = part("critic")
        trainer.update(trainer.sessions.collect())
        trainer.progress.update += 1
        assert torch.equal(part("actor"), actor) == (update < 2)
        assert not torch.equal(part("critic"), critic)
        expected = 0.9 * expected + 0.1 * raw()
        assert torch.allclose(averaged(), expected, atol=1e-6)


def test_ctrl_c_stops_after_the_update_and_saves(tmp_path: Path) -> None:
    trainer, _ = trainer_of(settings_of(updates=1000, save_every=1000))
    # The tests may run in the background, where Ctrl-C is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    learn, saved = trainer.update, []

    def interrupt(batch: Any) -> dict[str, float]:
        if trainer.progress.update == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return learn(batch)

    trainer.update = interrupt  # type: ignore[method-assign]
    try:
        with pytest.raises(KeyboardInterrupt):
            trainer.run(tmp_path, lambda: saved.append(trainer.progress.update))
        assert saved == [3]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("updates", 0),
        ("sessions", 2.5),
        ("steps", 0),
        ("critic_steps", -1),
        ("learning_rate", -1),
        ("gamma", 1.5),
        ("optimizer", "sgd"),
    ],
)
def test_bad_constants_are_refused(key: str, value: object) -> None:
    with pytest.raises(InputError, match=f"training.{key}="):
        trainer_of(settings_of(**{key: value}))


def test_checkpoint_says_what_does_not_fit(tmp_path: Path) -> None:
    settings = settings_of("query", "paper")
    trainer, task = trainer_of(settings)
    make_checkpoint(settings, task, trainer).save(tmp_path / "checkpoint.pt")
    checkpoint = Checkpoint.load(tmp_path)
    checkpoint.check_fits(task.test)
    with pytest.raises(InputError, match=r"N=31 \(trained on 30\), K=3 \(trained on 2\)"):
        checkpoint.check_fits(gridworld_pool(31, 3))
    with pytest.raises(InputError, match=r"D=5 \(trained on 4\)"):
        checkpoint.check_fits(QueryPool(torch.rand(30, 2, 5)))
    assert torch.equal(checkpoint.normalizer.std, task.normalizer.std)
    other = trainer_of(settings_of("feed", "paper"))[0]
    with pytest.raises(InputError, match="weights do not fit"):
        load_weights(other.policy, checkpoint)

    scorer, _ = trainer_of(settings_of("query"))
    make_checkpoint(settings_of("query"), task, scorer).save(tmp_path / "checkpoint.pt")
    Checkpoint.load(tmp_path).check_fits(gridworld_pool(31), own_indices=True)
    with pytest.raises(InputError, match="picks indices of a training pool"):
        checkpoint.check_fits(task.test, own_indices=True)

    gridworld_pool(30, seed=9).save(tmp_path / "train_pool.pt")
    gridworld_pool(30, seed=9).save(tmp_path / "test_pool.pt")
    pools = tmp_path / "train_pool.pt", tmp_path / "test_pool.pt"
    with pytest.raises(InputError, match="does not fit the train pool: digest"):
        reload_task(checkpoint, *pools)


def test_foreign_and_old_checkpoints_are_refused(tmp_path: Path) -> None:
    gridworld_pool(30).save(tmp_path / "pool.pt")
    with pytest.raises(InputError, match="holds query pool; expected a torchrl_pref checkpoint"):
        Checkpoint.load(tmp_path / "pool.pt")
    torch.save({"kind": "torchrl_pref checkpoint", "format": 0}, tmp_path / "old.pt")
    with pytest.raises(InputError, match="written by another version"):
        Checkpoint.load(tmp_path / "old.pt")
    with pytest.raises(InputError, match="no such file"):
        Checkpoint.load(tmp_path)


def test_rows_after_the_last_checkpoint_are_written_once(tmp_path: Path) -> None:
    """A run that was killed has logged more than it saved."""
    settings = settings_of(updates=5, save_every=2)
    trainer, _ = trainer_of(settings)
    states: list[dict[str, Any]] = []
    trainer.run(tmp_path, lambda: states.append(copy.deepcopy(trainer.state_dict())))
    again, _ = trainer_of(settings)
    again.load_state_dict(states[0])
    again.run(tmp_path, lambda: None)
    rows = (tmp_path / "training.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == [1, 2, 3, 4, 5]
