"""Trainings in which each update asks about another problem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import same, settings_of, trained_in_parts, trainer_of
from torch import Generator

from torchrl_pref.build import load_policy, make_pools, make_task, make_training_env
from torchrl_pref.config.settings import check_run
from torchrl_pref.errors import InputError
from torchrl_pref.training import drawn
from torchrl_pref.training.drawn import draw_problem
from torchrl_pref.training.start import make_checkpoint


def settings_over_many(setup: str, **training: Any) -> dict[str, Any]:
    return settings_of(setup, problems="drawn", steps=None, **training)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawn, "SIZES", (10, 30))
    monkeypatch.setattr(drawn, "BUDGETS", (2, 5))


def test_problems_differ_in_all_that_a_policy_may_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    luck = Generator().manual_seed(0)
    problems = [draw_problem(settings_of("feed"), luck) for _ in range(600)]  # type: ignore[arg-type]

    def drawn_of(section: str, key: str) -> set[Any]:
        return {problem[section][key] for problem in problems}  # type: ignore[literal-required]

    assert drawn_of("task", "dimension") == set(range(2, 17))
    assert drawn_of("pool", "options") == {2, 3, 4, 5}
    assert drawn_of("question", "name") == {"choice", "weak", "ranking"}
    assert drawn_of("belief", "name") == {"sampled", "rationality"}
    assert {problem["tau"] == "optimal" for problem in problems} == {True, False}
    for section, key, low, high in (
        ("setup", "budget", 5, 60),
        ("pool", "size", 50, 20_000),
        ("task", "skew", 1, 1000),
    ):
        found = drawn_of(section, key)
        assert low <= min(found) < 1.2 * low
        assert 0.8 * high < max(found) <= high
    shares = [problem["setup"]["offers"] / problem["setup"]["budget"] for problem in problems]
    assert 1.3 < min(shares) < 1.7
    assert 9 < max(shares) <= 10.1


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_each_batch_is_of_another_problem_and_of_whole_sessions(setup: str) -> None:
    trainer, _ = trainer_of(settings_over_many(setup))
    seen = set()
    for _ in range(4):
        batch = trainer.sessions.collect()
        env = trainer.env
        seen.add((tuple(env.features.shape), env.budget))
        steps = env.n_offers if setup == "feed" else env.budget
        assert batch.shape[1] == steps
        assert trainer.sessions.frames / 2 < batch.numel() < 2 * trainer.sessions.frames
        trainer.update(batch)
    assert len(seen) == 4


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_a_resumed_one_goes_on_with_the_problems_that_were_to_come(
    setup: str, tmp_path: Path
) -> None:
    whole = trained_in_parts(settings_over_many(setup), [4], tmp_path / "whole")
    resumed = trained_in_parts(settings_over_many(setup), [2, 4], tmp_path / "resumed")
    start = trainer_of(settings_over_many(setup))[0].policy.weights.state_dict()
    assert not same(whole.weights, start)  # something was learned
    for name in ("weights", "optimizer", "sessions", "env_generator", "global_generator"):
        assert same(whole.training[name], resumed.training[name]), name


def test_what_comes_out_asks_in_any_problem() -> None:
    settings = settings_over_many("query")
    trainer, task = trainer_of(settings)
    checkpoint = make_checkpoint(settings, task, trainer)  # type: ignore[arg-type]
    assert checkpoint.of_every_task
    problem = draw_problem(settings, Generator().manual_seed(3))  # type: ignore[arg-type]
    other = make_task(*make_pools(problem), problem["tau"], problem)
    env = make_training_env(problem, other, other.test, 3, seed=0)
    done = env.rollout(env.budget, load_policy(checkpoint, env).strategy)
    assert torch.equal(done["next", "n_asked"][:, -1], torch.full((3, 1), env.budget))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy": {"name": "paper", "sample": False}}, "type policy=scorer"),
        ({"training": {"steps": 5}}, "leave training.steps out"),
        ({"pool": {"train": __file__, "test": __file__}}, "remove the pools"),
    ],
)
def test_what_makes_no_sense_there_is_refused(changes: dict[str, Any], message: str) -> None:
    settings = settings_over_many("feed")
    del settings["setup"]["candidates"], settings["setup"]["repeats"], settings["setup"]["batch"]
    check_run(settings)
    for section, values in changes.items():
        settings[section] = {**settings[section], **values} if section != "policy" else values
    with pytest.raises(InputError, match=message):
        check_run(settings)
