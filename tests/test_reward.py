"""A reward: as a session scores, as a file, and as a transform of an environment."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.custom.pendulum import PendulumEnv
from torchrl.envs.utils import check_env_specs

from torchrl_pref import Boltzmann, Normalizer, QueryPool, Reward, Session
from torchrl_pref.errors import InputError
from torchrl_pref.reward import LARGEST

NAMES = ("speed", "closeness", "jerk")


@pytest.fixture
def raw() -> torch.Tensor:
    return 5 + 3 * torch.randn(40, 2, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def session(raw: torch.Tensor) -> Session:
    normalizer = Normalizer.fit(raw)
    pool = QueryPool(normalizer(raw), feature_names=NAMES)
    made = Session(pool, Boltzmann(2.0), normalizer=normalizer)
    for answer in (0, 1, 1):
        made.ask()
        made.tell(answer)
    return made


@pytest.fixture
def saved(session: Session, tmp_path: Path) -> Path:
    Reward.of(session, origin={"participant": "P1"}).save(tmp_path / "reward.json")
    return tmp_path / "reward.json"


def test_it_scores_as_the_session_before_and_after_a_file(
    session: Session, saved: Path, raw: torch.Tensor
) -> None:
    features = raw[:, 0]
    for reward in (Reward.of(session), Reward.load(saved)):
        for found, wanted in zip(reward.score(features), session.score(features), strict=True):
            assert torch.equal(found, wanted)
        for name in ("mean", "sd", "low", "high"):
            known = getattr(reward.weights, name)
            assert torch.equal(known, getattr(session.weights, name))
        assert reward.weights.names == NAMES
    assert Reward.load(saved).origin == {
        "answers": 3,
        "pool": session.pool.digest,
        "participant": "P1",
    }


def test_scores_of_any_shape_and_their_gradient(session: Session, raw: torch.Tensor) -> None:
    reward = Reward.of(session)
    mean, deviation = reward.score(raw)
    assert mean.shape == deviation.shape == (40, 2)
    assert torch.allclose(reward.score(raw[3, 1])[0], mean[3, 1])
    features = raw[0, 0].clone().requires_grad_()
    reward.score(features)[0].backward()
    slope = session.weights.mean / Normalizer.fit(raw).std
    assert torch.allclose(features.grad, slope)


def test_without_a_normaliser_features_are_as_the_session_had_them(raw: torch.Tensor) -> None:
    session = Session(raw, Boltzmann(2.0))
    for found, wanted in zip(
        Reward.of(session).score(raw[:, 0]), session.score(raw[:, 0]), strict=True
    ):
        assert torch.allclose(found, wanted)


def test_the_file_is_plain_and_the_same_for_the_same_session(session: Session, saved: Path) -> None:
    content = json.loads(saved.read_text())
    assert content["feature_names"] == list(NAMES)
    assert content["weights"]["mean"] == session.weights.mean.tolist()
    before = saved.read_bytes()
    Reward.load(saved).save(saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def changed(path: Path, **parts: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **parts}))


SPOILED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "missing": (lambda path: path.unlink(), "no such file"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "is a folder"),
    "pipe": (lambda path: (path.unlink(), os.mkfifo(path)), "is a device or a pipe"),
    "large": (lambda path: os.truncate(path, LARGEST + 1), "larger than any reward"),
    "cut": (lambda path: path.write_text(path.read_text()[:90]), "cannot be read as a reward"),
    "binary": (lambda path: path.write_bytes(b"\xff\xfe\x00"), "cannot be read as a reward"),
    "deep": (lambda path: path.write_text("[" * 200_000), "cannot be read as a reward"),
    "other": (lambda path: path.write_text("[1]"), "holds no reward"),
    "kind": (lambda path: changed(path, kind="pool"), "holds no reward"),
    "format": (lambda path: changed(path, format=9), "a reward in the format 9"),
    "samples": (lambda path: changed(path, samples=[[1, 2]]), "samples of shape (1, 2)"),
    "ragged": (lambda path: changed(path, samples=[[1, 2, 3], [1]]), "samples: expected lists"),
    "text": (lambda path: changed(path, samples="x"), "samples: expected lists of numbers"),
    "nan": (lambda path: changed(path, samples=[[math.nan] * 3] * 9), "samples: expected finite"),
    "huge": (lambda path: changed(path, samples=[[1e300] * 3] * 9), "samples: expected finite"),
    "zero": (lambda path: changed(path, samples=[[0.0] * 3] * 9), "not all 0 in any of them"),
    "names": (lambda path: changed(path, feature_names=["a", "a", "b"]), "names one twice"),
    "fewer names": (lambda path: changed(path, feature_names=["a"]), "1 for 3 features"),
    "normaliser": (lambda path: changed(path, normalizer={"mean": [0, 0, 0]}), "normalizer.std"),
    "scale": (
        lambda path: changed(path, normalizer={"mean": [0, 0, 0], "std": [1, 0, 1]}),
        "deviations above 0",
    ),
    "weights": (
        lambda path: changed(path, weights={"mean": [1, 0, 0]}),
        "weights.mean: not those of the samples",
    ),
    "origin": (lambda path: changed(path, origin={"a": [1]}), "origin.a: expected a short text"),
    "origins": (lambda path: changed(path, origin=3), "origin: expected at most"),
}


@pytest.mark.parametrize("how", SPOILED)
def test_a_spoiled_file_is_refused_in_one_line(saved: Path, how: str) -> None:
    spoil, message = SPOILED[how]
    spoil(saved)
    with pytest.raises(InputError, match=r"reward\.json: ") as refused:
        Reward.load(saved)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_no_reward_or_no_features_is_refused(
    session: Session, raw: torch.Tensor, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="people=2: expected one person"):
        Reward.of(Session(raw, Boltzmann(2.0), people=2))
    with pytest.raises(
        InputError, match=r"features of \(4,\): expected a tensor \(…, 3\) of speed"
    ):
        Reward.of(session).score(torch.zeros(4))
    with pytest.raises(InputError, match="features: NaN"):
        Reward.of(session).score(torch.tensor([[1.0, math.nan, 3.0]]))
    with pytest.raises(InputError, match="features: NaN"):
        Reward.of(session)(TensorDict({"next": {"features": torch.full((2, 3), math.nan)}}, [2]))
    with pytest.raises(InputError, match="features of <class 'list'>"):
        Reward.of(session).score([1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="cannot be written"):
        Reward.of(session).save(tmp_path / "nowhere" / "reward.json")


def of_step(before: TensorDictBase, after: TensorDictBase) -> torch.Tensor:
    """Features of a step of a pendulum: where it is, how fast, and by which push."""
    return torch.stack([after["th"].cos(), after["thdot"], before["action"].squeeze(-1)], -1)


@pytest.fixture
def pushed(saved: Path) -> Reward:
    return Reward.load(saved, features=of_step)


def test_it_writes_the_reward_of_an_environment(pushed: Reward) -> None:
    env = TransformedEnv(PendulumEnv(), pushed)
    check_env_specs(env)
    frames = env.rollout(7)
    wanted, _ = pushed.score(of_step(frames, frames["next"]))
    assert torch.allclose(frames["next", "reward"].squeeze(-1), wanted, atol=1e-5)
    assert frames["next", "reward"].shape == (7, 1)


def test_it_works_in_batches_and_in_a_collector(pushed: Reward) -> None:
    env = TransformedEnv(SerialEnv(3, PendulumEnv), pushed)
    check_env_specs(env)
    assert env.reward_spec.shape == (3, 1)
    collector = Collector(env, frames_per_batch=12, total_frames=12)
    (frames,) = list(collector)
    wanted, _ = pushed.score(of_step(frames, frames["next"]))
    assert torch.allclose(frames["next", "reward"].squeeze(-1), wanted, atol=1e-5)
    collector.shutdown()


def test_the_rewards_of_steps_sum_to_the_score_of_their_mean(saved: Path) -> None:
    reward = Reward.load(saved)  # which reads the features under their key
    steps = torch.randn(6, 3)
    frames = TensorDict({"next": TensorDict({"features": steps}, [6])}, [6])
    total = reward(frames)["next", "reward"].sum()
    assert torch.allclose(total, 6 * reward.score(steps.mean(0))[0], atol=1e-4)


def test_it_gives_recorded_steps_their_reward(pushed: Reward) -> None:
    frames = PendulumEnv().rollout(9)
    buffer = ReplayBuffer(storage=LazyTensorStorage(9), transform=pushed, batch_size=4)
    buffer.extend(frames)
    sample = buffer.sample()
    wanted, _ = pushed.score(of_step(sample, sample["next"]))
    assert torch.allclose(sample["next", "reward"].squeeze(-1), wanted, atol=1e-5)
