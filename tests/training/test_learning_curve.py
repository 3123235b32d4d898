"""What is measured of a training on held-out humans, and what is written of it."""

from __future__ import annotations

import copy
import csv
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import same, settings_of, trainer_of

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.build import load_policy, load_weights, make_feed_env, make_query_env
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import check_evaluation
from torchrl_pref.evaluation.run import Evaluation, draw_humans, evaluate
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.pretrained import pretrained_checkpoint
from torchrl_pref.strategies import Greedy, QuantileAsk
from torchrl_pref.training.figure import Training, learned, write_training
from torchrl_pref.training.learning_curve import LearningCurve
from torchrl_pref.training.progress import Progress
from torchrl_pref.training.start import make_checkpoint
from torchrl_pref.training.trainer import Trainer


def watched(
    during: int, setup: str = "feed", policy: str = "scorer", **training: Any
) -> tuple[Trainer, LearningCurve, dict[str, Any], Any]:
    """A training with so many evaluations after the start, of which nothing is done yet."""
    settings = settings_of(setup, policy, **training)
    settings["evaluation"]["during"] = during
    settings["policy"]["sample"] = policy != "scorer"
    trainer, task = trainer_of(settings)
    return trainer, LearningCurve(settings, task, trainer), settings, task


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "training.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("policy", ["scorer", "attention", "paper"])
def test_training_does_not_notice_that_it_is_watched(
    setup: str, policy: str, tmp_path: Path
) -> None:
    states = []
    for during in (0, 3):
        trainer, curve, _, _ = watched(during, setup, policy)
        trainer.run(tmp_path, lambda: None, curve.measure)
        states.append(trainer.state_dict())
        assert sorted(trainer.progress.held_out) == ([0, 2, 4, 6] if during else [])
    alone, seen = states
    for name in ("weights", "optimizer", "sessions", "env_generator", "global_generator"):
        assert same(alone[name], seen[name]), name
    for name, values in alone["history"].items():
        assert name.startswith("time/") or same(values, seen["history"][name])


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_killed_and_resumed_training_tells_the_same(setup: str, tmp_path: Path) -> None:
    trainer, curve, settings, task = watched(3, setup)
    saved: list[Checkpoint] = []

    def save() -> None:
        saved.append(copy.deepcopy(make_checkpoint(settings, task, trainer)))

    trainer.run(tmp_path, save, curve.measure)
    whole = rows_of(tmp_path)
    # It was killed after its first checkpoint, in the middle of a row.
    table = tmp_path / "training.csv"
    table.write_text(table.read_text()[:-20])
    again, curve, _, _ = watched(3, setup)
    load_weights(again.policy, saved[0])
    again.load_state_dict(saved[0].training)
    again.run(tmp_path, lambda: None, curve.measure)
    assert same(again.progress.held_out, trainer.progress.held_out)
    assert same(again.progress.baseline, trainer.progress.baseline)
    resumed = rows_of(tmp_path)
    done = Progress.of(saved[0].training).update + 1
    assert resumed[:done] == whole[:done]
    for row in (*whole, *resumed):
        del row["frames_per_second"]
    assert resumed == whole


def test_table_has_a_row_for_each_update(tmp_path: Path) -> None:
    trainer, curve, _, _ = watched(2)
    trainer.run(tmp_path, lambda: None, curve.measure)
    rows, progress = rows_of(tmp_path), trainer.progress
    assert [int(row["update"]) for row in rows] == list(range(7))
    assert [int(row["frames"]) for row in rows] == [12 * update for update in range(7)]
    for name, values in progress.history.items():
        shown = [row[name.split("/")[1]] for row in rows]
        assert shown[0] == ""
        for text, value in zip(shown[1:], values, strict=True):
            assert text == "" if value != value else float(text) == pytest.approx(value, rel=1e-5)
    assert {row["update"] for row in rows if row["held_out_alignment"]} == {"0", "3", "6"}
    assert progress.baseline is not None
    for update, values in progress.held_out.items():
        numbers = [float(values.mean()), *bootstrap_interval(values)]
        numbers.append(float(progress.baseline[1].mean()))
        columns = ("alignment", "low", "high", "baseline")
        shown = [rows[update][f"held_out_{column}"] for column in columns]
        assert [float(text) for text in shown] == pytest.approx(numbers, rel=1e-5)


@pytest.mark.parametrize(
    ("setup", "policy"), [("query", "scorer"), ("feed", "scorer"), ("feed", "attention")]
)
def test_what_is_measured_is_what_is_saved(setup: str, policy: str, tmp_path: Path) -> None:
    """The moving average of the weights, on the test pool, beside the strongest baseline."""
    rate = 0.05 if policy == "scorer" else 0.002  # so that one moves and the other stays unsure
    trainer, curve, settings, task = watched(1, setup, policy, learning_rate=rate, average=0.5)
    trainer.run(tmp_path, lambda: None, curve.measure)
    checkpoint = make_checkpoint(settings, task, trainer)
    seed = 2**32 - 1 - settings["evaluation"]["seed"]
    if setup == "feed":
        env: Any = make_feed_env(settings, task, task.test, 5, seed)
        name, baseline = "quantile", QuantileAsk(env, alignment_gain)
    else:
        env = make_query_env(settings, task, task.test, 5, seed, 8)
        name, baseline = "greedy alignment", Greedy(task.response_model, alignment_gain)
    humans = draw_humans(env)

    def alone(strategy: Any, sample: bool = False) -> Evaluation:
        env.set_seed(seed)
        torch.manual_seed(seed)
        return evaluate(env, strategy, humans, sample)

    progress = trainer.progress
    sample = settings["policy"]["sample"]
    end = alone(load_policy(checkpoint, env).strategy, sample).alignment[:, -1]
    assert torch.equal(progress.held_out[6], end)
    assert not torch.equal(progress.held_out[0], end)
    assert progress.baseline is not None
    assert progress.baseline[0] == name
    assert torch.equal(progress.baseline[1], alone(baseline).alignment[:, -1])


def test_held_out_humans_are_met_nowhere_else() -> None:
    trainer, curve, settings, task = watched(1)
    _, _, watching = curve._made
    n_humans, seed = check_evaluation(settings)
    judged = draw_humans(make_feed_env(settings, task, task.test, n_humans, seed))
    trained = trainer.state_dict()["sessions"]["human"]["omega"]
    for others in (judged["human", "omega"], trained):
        assert torch.cdist(watching["human", "omega"], others).amin() > 1e-3


def test_an_index_is_judged_on_the_pool_that_it_belongs_to() -> None:
    for policy, pool_of in (("paper", "train"), ("scorer", "test")):
        _, curve, _, task = watched(1, "query", policy)
        env, _, _ = curve._made
        assert torch.equal(env.features, getattr(task, pool_of).features)


@pytest.mark.parametrize(
    ("during", "updates", "points"),
    [
        (0, 6, []),
        (1, 6, [0, 6]),
        (2, 7, [0, 4, 7]),
        (4, 100, [0, 25, 50, 75, 100]),
        (4, 2, [0, 1, 2]),
        (10**12, 3, [0, 1, 2, 3]),
    ],
)
def test_evaluations_are_spread_to_the_last_update(
    during: int, updates: int, points: list[int]
) -> None:
    _, curve, _, _ = watched(during, updates=updates)
    assert [update for update in range(updates + 1) if curve._due(update)] == points


@pytest.mark.parametrize("during", [-1, 1.5, "often"])
def test_bad_numbers_of_evaluations_are_refused(during: Any) -> None:
    with pytest.raises(InputError, match=r"evaluation\.during="):
        watched(during)


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_report_says_what_was_learned(
    setup: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = torch.linspace(0.5, 0.9, 40)
    gain = torch.linspace(-0.1, 0.3, 40)
    name = "quantile" if setup == "feed" else "greedy alignment"
    progress = Progress.of(pretrained_checkpoint(setup, "noisy").training)
    assert (progress.held_out, progress.baseline) == ({}, None)  # of version 0.1.0
    write_training(tmp_path, [Training("policy_query", "noisy human", progress)])
    plain = (tmp_path / "training.png").read_bytes()
    progress = Progress(
        progress.update, progress.history, {0: start, 50: start, 100: start + gain}, (name, start)
    )
    low, high = bootstrap_interval(gain)
    line = learned(progress)
    assert line.startswith(
        "alignment with 40 held-out humans 0.700 after 0 updates, 0.800 after 10"
    )
    assert f": +0.100 [{low:+.3f}, {high:+.3f}]; minus" in line
    capsys.readouterr()
    write_training(tmp_path, [Training("policy_query", "noisy human", progress)])
    assert f"RL: {line}" in capsys.readouterr().out
    assert (tmp_path / "training.png").read_bytes() != plain


@pytest.mark.parametrize("during", [0, 1])
@pytest.mark.parametrize("setup", ["query", "feed"])
def test_the_shortest_training_has_a_figure(setup: str, during: int, tmp_path: Path) -> None:
    """One update, in which no episode ended."""
    trainer, curve, _, _ = watched(during, setup, updates=1)
    trainer.run(tmp_path, lambda: None, curve.measure)
    write_training(tmp_path, [Training("policy_query", "noisy human", trainer.progress)])
    assert (tmp_path / "training.png").stat().st_size > 5000
