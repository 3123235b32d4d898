from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import settings_of, trainer_of
from torch import Generator, Tensor

from torchrl_pref.build import make_pools, make_task
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation import heldout
from torchrl_pref.evaluation.heldout import Cell, Job, Outcome, run_protocol, run_side_by_side
from torchrl_pref.evaluation.heldout_report import paired, reaches, write_heldout
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.statistics import two_way_interval
from torchrl_pref.pool import Normalizer, balance
from torchrl_pref.strategies import RandomAsk
from torchrl_pref.tasks.gridworld import GridworldTask, gridworld_pool
from torchrl_pref.training.start import make_checkpoint


def checkpoint_of(settings: dict[str, Any]) -> Checkpoint:
    trainer, task = trainer_of(settings)
    return make_checkpoint(settings, task, trainer)


def outcome(alignment: torch.Tensor) -> Outcome:
    table = alignment[..., 0, 0]
    return Outcome(alignment, table, table, table)


def test_interval_covers_pools_and_seeds(generator: Generator) -> None:
    """Values are a pool effect plus a seed effect: the mean has the variance of both means."""
    pools = torch.randn(400, 10, 1, generator=generator)
    seeds = 0.5 * torch.randn(400, 1, 5, generator=generator)
    covered = widths = 0.0
    for table in pools + seeds:
        low, high = two_way_interval(table, 500)
        covered += low <= 0 <= high
        widths += (high - low) / 400
    # Percentile intervals of so few clusters are somewhat too narrow.
    assert 0.85 < covered / 400 < 0.97
    assert widths == pytest.approx(2 * 1.96 * (1 / 10 + 0.25 / 5) ** 0.5, rel=0.15)
    assert two_way_interval(torch.full((3, 2), 0.7)) == (pytest.approx(0.7), pytest.approx(0.7))


def test_interval_is_widened_by_what_few_pools_hide() -> None:
    """Two pools at 0 and 1: a bootstrap's mean is 0, 1/2 or 1, and its interval all of it. Of the
    variance between two pools it shows half."""
    low, high = two_way_interval(torch.tensor([[0.0], [1.0]]))
    assert low == pytest.approx(0.5 - 0.5 * 2**0.5)
    assert high == pytest.approx(0.5 + 0.5 * 2**0.5)


def test_differences_are_paired_and_levels_are_reached() -> None:
    rising = torch.linspace(0, 1, 11).expand(2, 3, 4, 11)
    one, other = outcome(rising), outcome(rising[:, :1] - 0.25)
    assert torch.allclose(paired(one, other), torch.tensor(0.25))
    assert torch.allclose(paired(one, outcome(rising[:, :1, :2])), torch.tensor(0.0))
    two_runs = outcome(torch.cat([rising[:, :1] - 0.25, rising[:, :1] - 0.75], 1))
    assert torch.allclose(paired(one, two_runs), torch.tensor(0.5))
    assert reaches(one, 0.55) == "6"
    assert reaches(other, 0.9) == "never"


def test_balanced_options_differ_equally_in_every_direction() -> None:
    raw = gridworld_pool(400).features
    features = balance(raw)(raw)
    gaps = features[:, 0] - features[:, 1]
    covariance = gaps.mT @ gaps / len(gaps)
    assert torch.allclose(covariance, covariance[0, 0] * torch.eye(4), atol=0.02)
    with pytest.raises(InputError, match="cannot be balanced"):
        balance(raw[..., [0, 1, 0]])


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_protocol_pairs_all_strategies_on_pools_of_its_own(
    setup: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(heldout, "HUMANS", 6)
    monkeypatch.setattr(heldout, "FINE_HUMANS", 2)
    monkeypatch.setattr(heldout, "FINE_SAMPLES", 40)
    settings = settings_of(setup)
    cell = Cell(setup, "noisy")
    learned = [checkpoint_of({**settings, "seed": seed}) for seed in (0, 1)]
    rows = [heldout._run_pool(Job(settings, cell, pool, learned, (0.2,))) for pool in (0, 1)]
    rival, once = (
        ("greedy alignment", "random") if setup == "query" else ("quantile of alignment", "ask all")
    )
    for row in rows:
        assert list(row)[-1] == "RL"
        assert [len(row[name]) for name in (rival, once, "RL")] == [heldout.RUNS, 1, 2]
        if setup == "feed":  # one name alone takes every offer
            assert (row[once][0].offered == row[once][0].asked).all()
            assert (row[rival][0].offered > row[rival][0].asked).any()
        if setup == "query":
            assert (row["greedy information, no repeats"][0].repeated == 0).all()
            (fine,) = row["greedy information, M=40 (2 humans a pool)"]
            assert fine.ess[:, 0].tolist() == [40.0, 40.0]
        # All start from the same prior samples of the same humans.
        start = row["RL"][0].alignment[:, 0]
        for name, results in row.items():
            if "M=40" not in name:
                assert torch.equal(results[0].alignment[:, 0], start)
    # Another pool, other humans.
    first, second = (row["RL"][0].alignment[:, 0] for row in rows)
    assert not torch.isclose(first, second).any()
    trained = make_pools(settings)
    for pool in (0, 1):
        _, own = heldout._task_and_pool(Job(settings, cell, pool))
        task = make_task(*trained, "noisy")
        assert own.digest not in (task.train.digest, task.test.digest)
    write_heldout(tmp_path, {cell: heldout._gather(rows)})
    assert (tmp_path / "heldout.png").stat().st_size > 10_000
    assert "RL minus it" in (tmp_path / "heldout.txt").read_text()


def test_no_two_pools_share_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pool takes its seed for the starts and the next one for the moves."""
    seeds: list[int] = []

    trajectories = GridworldTask.trajectories

    def watched(task: GridworldTask, count: int, seed: int) -> Tensor:
        seeds.extend((seed, seed + 1))
        return trajectories(task, count, seed)

    monkeypatch.setattr(GridworldTask, "trajectories", watched)
    for pool in range(heldout.POOLS):
        heldout._task_and_pool(Job(settings_of("feed"), Cell("feed", "noisy"), pool))
    per_call = 2 * 3  # training, test, and the pool itself
    assert len(seeds) == per_call * heldout.POOLS
    assert len(set(seeds)) == 4 + 2 * heldout.POOLS


def test_the_threshold_is_fitted_without_a_look_at_the_test_pools() -> None:
    fits = []
    for pool in (0, 1):
        job = Job(settings_of("feed"), Cell("feed", "noisy"), pool, thresholds=(0.1, 0.4))
        fits.append(heldout._fit_threshold(job))
    assert torch.equal(*fits)
    assert fits[0][0] != fits[0][1]


def test_policies_of_other_tasks_are_refused() -> None:
    settings = settings_of("query")
    paper = checkpoint_of(settings_of("query", policy="paper"))
    with pytest.raises(InputError, match="indices of its training pool"):
        run_protocol(settings, {Cell("query", "noisy"): [paper]}, 1)
    other = checkpoint_of(settings)
    other.settings["setup"]["budget"] = 9
    with pytest.raises(InputError, match=r"setup\.budget=9"):
        run_protocol(settings_of("query"), {Cell("query", "noisy"): [other]}, 1)


def test_normaliser_is_that_of_the_training_pool() -> None:
    settings = settings_of("query")
    train, _ = make_pools(settings)
    task, own = heldout._task_and_pool(Job(settings, Cell("query", "noisy"), 3))
    assert torch.equal(task.normalizer.mean, Normalizer.fit(train.features).mean)
    assert own.features.mean().abs() > 1e-6


def test_features_are_balanced_by_the_training_pool() -> None:
    task, own = heldout._task_and_pool(
        Job(settings_of("query"), Cell("query", "noisy", "balanced"), 0)
    )
    largest = []
    for pool in (task.train, own):
        gaps = pool.features[:, 0] - pool.features[:, 1]
        covariance = gaps.mT @ gaps / len(gaps)
        largest.append(float((covariance - covariance.diagonal().diag()).abs().amax()))
    assert largest[0] < 1e-3
    assert largest[1] > 0.05


def test_strategies_side_by_side_meet_the_same_offers_and_humans() -> None:
    """A strategy beside others does what it does alone where nothing is drawn anew."""
    settings = settings_of("feed")
    task, pool = heldout._task_and_pool(Job(settings, Cell("feed", "noisy"), 0))

    def make_env(sessions: int) -> FeedEnv:
        return heldout.make_feed_env(settings, task, pool, sessions, 5)

    humans = draw_humans(make_env(7))
    twice = [("rule", RandomAsk()), ("rule", RandomAsk())]
    one, two = run_side_by_side(make_env, humans, twice)["rule"]
    # The first question is asked of the same belief, so it is worth the same.
    assert torch.allclose(one.information[:, 1], two.information[:, 1], atol=1e-6)
    assert torch.equal(one.alignment[:, 0], two.alignment[:, 0])
    other = draw_humans(make_env(7))
    other["offers"] = humans["offers"].flip(1)
    (third,) = run_side_by_side(make_env, other, [("rule", RandomAsk())])["rule"]
    assert not torch.allclose(one.information[:, 1], third.information[:, 1], atol=1e-3)


def test_whole_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through worker processes, which see the constants of the module and not the test's."""
    monkeypatch.setattr(heldout, "POOLS", 1)
    monkeypatch.setattr(heldout, "BALANCED_POOLS", 1)
    monkeypatch.setattr(heldout, "THRESHOLDS", (0.1, 9.0))
    learned = {}
    for setup in ("query", "feed"):
        learned[Cell(setup, "noisy")] = [checkpoint_of({**settings_of(setup), "seed": 3})]
    results = run_protocol(settings_of("feed"), learned, 1)
    assert set(results) == {
        Cell("query", "noisy"),
        Cell("query", "noisy", "balanced"),
        Cell("feed", "noisy"),
    }
    fit = Job(settings_of("feed"), Cell("feed", "noisy"), 0, thresholds=(0.1, 9.0))
    best = (0.1, 9.0)[int(heldout._fit_threshold(fit).argmax())]
    assert f"threshold {best:g} bits" in results[Cell("feed", "noisy")]
    assert results[Cell("query", "noisy")]["RL"].alignment.shape == (1, 1, heldout.HUMANS, 5)
    assert "two-step lookahead" in results[Cell("query", "noisy")]
    rival = results[Cell("query", "noisy")]["greedy alignment"].alignment
    assert rival.shape == (1, heldout.RUNS, heldout.HUMANS, 5)
    assert not torch.equal(rival[0, 0], rival[0, 1])  # another luck of the belief


def test_only_training_seeds_are_averaged() -> None:
    settings = settings_of("query")
    cell = Cell("query", "noisy")
    one, other = (
        checkpoint_of({**settings, "objective": name}) for name in ("alignment", "entropy")
    )
    with pytest.raises(InputError, match="differ in objective"):
        run_protocol(settings, {cell: [one, other]}, 1)
