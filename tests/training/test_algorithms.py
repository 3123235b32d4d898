"""PPO beside A2C: what they share, where they part, and that PPO learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import LEARNS_TO_ASK, settings_of, trainer_of
from tensordict import TensorDictBase

from torchrl_pref.checkpoints.contents import CURVES
from torchrl_pref.errors import InputError
from torchrl_pref.training.ppo import PPO
from torchrl_pref.training.trainer import Trainer


def ppo_settings(setup: str = "feed", policy: str = "scorer", **keys: Any) -> dict[str, Any]:
    own = {key: keys.pop(key) for key in ("clip_epsilon", "epochs", "minibatches") if key in keys}
    own = {"name": "ppo", "clip_epsilon": 0.2, "epochs": 3, "minibatches": 2, **own}
    return {**settings_of(setup, policy, **keys), "algorithm": own}


def actor_of(trainer: Trainer) -> torch.Tensor:
    weights = trainer.policy.actor.parameters()
    return torch.cat([weight.detach().flatten().clone() for weight in weights])


def log_probs(trainer: Trainer, batch: TensorDictBase) -> torch.Tensor:
    """Of the actions (F) that were taken, by the policy as it is now."""
    seen = batch.reshape(-1).select(*trainer.policy.actor.in_keys)
    with torch.no_grad():
        return trainer.policy.actor.get_dist(seen).log_prob(batch["action"].flatten())


@pytest.mark.parametrize("entropy", [0.0, 0.1])
@pytest.mark.parametrize("setup", ["query", "feed"])
def test_one_ppo_step_on_a_whole_batch_is_that_of_a2c(setup: str, entropy: float) -> None:
    """As long as the policy is the one that acted, both follow the same gradient."""
    constants = {"entropy": entropy, "warm_up": 0, "critic_steps": 0, "grad_norm": 1e6}
    results = []
    for settings in (
        settings_of(setup, **constants),
        ppo_settings(setup, epochs=1, minibatches=1, **constants),
    ):
        trainer, _ = trainer_of(settings)
        before = actor_of(trainer)
        told = trainer.update(trainer.sessions.collect())
        moved = actor_of(trainer) - before
        results.append((moved, told["gradient_norm"], told["critic_loss"], told["entropy"]))
    (moved, *numbers), (ppo_moved, *ppo_numbers) = results
    assert moved.abs().max() > 1e-4
    assert torch.allclose(moved, ppo_moved, rtol=1e-2, atol=1e-4)
    assert ppo_numbers == pytest.approx(numbers, rel=1e-3)


def test_ppo_stays_near_the_policy_that_acted() -> None:
    moved = []
    constants = {"optimizer": "adam", "learning_rate": 0.001, "warm_up": 0, "steps": 20}
    for clip in (0.02, 1.0):
        settings = ppo_settings(policy="paper", clip_epsilon=clip, epochs=40, **constants)
        trainer, _ = trainer_of(settings)
        batch = trainer.sessions.collect()
        before = log_probs(trainer, batch)
        trainer.update(batch)
        moved.append((log_probs(trainer, batch) - before).exp().sub(1).abs().mean())
    assert moved[0] < 0.5 * moved[1]


def test_each_pass_takes_a_step_on_each_part(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, _ = trainer_of(ppo_settings(epochs=3, minibatches=4, critic_steps=0, steps=5))
    seen: list[TensorDictBase] = []
    step = trainer.algorithm.step

    def note(flat: TensorDictBase, only_critic: bool) -> dict[str, float]:
        seen.append(flat)
        return step(flat, only_critic)

    monkeypatch.setattr(trainer.algorithm, "step", note)
    batch = trainer.sessions.collect()
    trainer.update(batch)
    assert [len(part) for part in seen] == [5] * 12
    for epoch in range(3):
        parts = torch.cat([part["value_target"] for part in seen[4 * epoch : 4 * epoch + 4]])
        whole = batch["value_target"].flatten()
        assert torch.equal(parts.flatten().sort().values, whole.sort().values)
    assert not torch.equal(seen[0]["value_target"], seen[4]["value_target"])


def test_ppo_learns_what_the_feed_rewards(tmp_path: Path) -> None:
    """As A2C does, in a third of the updates: asking pays, and the episodes get shorter."""
    settings = ppo_settings(policy="paper", updates=20, epochs=4, **LEARNS_TO_ASK)
    settings |= {"objective": "information_gain", "skip": "regret"}
    trainer, _ = trainer_of(settings)
    trainer.run(tmp_path, lambda: None, logger=[])
    lengths = trainer.progress.history["train/episode_length"]
    shares = trainer.progress.history["train/share_asked"]
    assert sum(lengths[-5:]) / 5 < sum(lengths[1:6]) / 5 - 1
    assert sum(shares[-5:]) / 5 > sum(shares[1:6]) / 5 + 0.1


@pytest.mark.parametrize("algorithm", ["a2c", "ppo"])
@pytest.mark.parametrize("setup", ["query", "feed"])
def test_what_is_told_of_an_update(setup: str, algorithm: str, tmp_path: Path) -> None:
    make = settings_of if algorithm == "a2c" else ppo_settings
    trainer, _ = trainer_of(make(setup, updates=2, learning_rate=0.003, entropy=0.0))
    batches: list[TensorDictBase] = []
    collect = trainer.sessions.collect

    def note(before: int) -> Any:
        batches.append(collect(before))
        return batches[-1]

    trainer.sessions.collect = note  # type: ignore[method-assign]
    trainer.run(tmp_path, lambda: None, logger=[])
    history = trainer.progress.history
    assert tuple(history) == CURVES
    assert history["train/learning_rate"] == [0.003, 0.003]
    for name in ("actor_loss", "critic_loss", "entropy", "gradient_norm"):
        assert all(value == value for value in history[f"train/{name}"]), name
    for batch, share in zip(batches, history["train/share_asked"], strict=True):
        asked = (batch["next", "n_asked"] - batch["n_asked"]).float().mean().item()
        if setup == "feed":
            assert share == pytest.approx(asked)
        else:
            assert share != share  # nothing is offered


def test_losses_are_those_of_the_batch() -> None:
    trainer, _ = trainer_of(settings_of(critic=0.25, entropy=0.1, warm_up=0))
    batch = trainer.sessions.collect()
    logs = log_probs(trainer, batch)
    with torch.no_grad():
        seen = batch.reshape(-1).select(*trainer.policy.actor.in_keys)
        entropy = trainer.policy.actor.get_dist(seen).entropy().mean().item()
    told = trainer.update(batch)
    errors = (batch["value_target"] - batch["state_value"]).square().mean()
    assert told["critic_loss"] == pytest.approx(errors.item(), rel=1e-4)
    actor = -(logs * batch["advantage"].flatten()).mean()
    assert told["actor_loss"] == pytest.approx(actor.item(), rel=1e-3, abs=1e-6)
    assert told["entropy"] == pytest.approx(entropy, rel=1e-4)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("clip_epsilon", 0),
        ("clip_epsilon", 1.5),
        ("clip_epsilon", "far"),
        ("epochs", 0),
        ("minibatches", 2.5),
    ],
)
def test_bad_constants_of_ppo_are_refused(key: str, value: Any) -> None:
    with pytest.raises(InputError, match=rf"algorithm\.{key}="):
        trainer_of(ppo_settings(**{key: value}))


def test_unknown_algorithms_are_refused() -> None:
    with pytest.raises(InputError, match=r"algorithm='dqn': expected one of a2c, ppo"):
        trainer_of({**settings_of(), "algorithm": {"name": "dqn"}})


def test_more_parts_than_steps_are_steps() -> None:
    trainer, _ = trainer_of(ppo_settings(minibatches=10**6, epochs=1))
    assert isinstance(trainer.algorithm, PPO)
    told = trainer.update(trainer.sessions.collect())
    assert all(value == value for value in told.values())
