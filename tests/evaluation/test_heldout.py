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
from torchrl_pref.evaluation import heldout, heldout_pool
from torchrl_pref.evaluation.heldout import kinds_of, run_protocol
from torchrl_pref.evaluation.heldout_pool import Cell, Job, fit_threshold, run_pool, task_and_pool
from torchrl_pref.evaluation.records import Entry, Records
from torchrl_pref.evaluation.reports import write_report
from torchrl_pref.evaluation.run import draw_humans
from torchrl_pref.evaluation.side_by_side import Entrant, run_side_by_side
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.evaluation.views import answers_to_reach, difference
from torchrl_pref.pool import Normalizer, balance
from torchrl_pref.strategies import RandomAsk
from torchrl_pref.tasks.gridworld import GridworldTask, gridworld_pool
from torchrl_pref.training.start import make_checkpoint


def checkpoint_of(settings: dict[str, Any]) -> Checkpoint:
    trainer, task = trainer_of(settings)
    return make_checkpoint(settings, task, trainer)


def records_of(**alignment: torch.Tensor) -> Records:
    """From (P S B H+1) of each strategy."""
    return Records(
        [
            Entry("heldout", "query/noisy/corners", str(p), s, key, {"alignment": values})
            for key, table in alignment.items()
            for p, row in enumerate(table)
            for s, values in enumerate(row)
        ]
    )


def test_interval_covers_pools_and_seeds(generator: Generator) -> None:
    """Values are a pool effect plus a seed effect: the mean has the variance of both means."""
    pools = torch.randn(400, 10, 1, generator=generator)
    seeds = 0.5 * torch.randn(400, 1, 5, generator=generator)
    covered = widths = 0.0
    for table in pools + seeds:
        low, high = bootstrap_interval(table)
        covered += low <= 0 <= high
        widths += (high - low) / 400
    # Percentile intervals of so few clusters are somewhat too narrow.
    assert 0.85 < covered / 400 < 0.97
    assert widths == pytest.approx(2 * 1.96 * (1 / 10 + 0.25 / 5) ** 0.5, rel=0.15)
    assert bootstrap_interval(torch.full((3, 2), 0.7)) == (pytest.approx(0.7), pytest.approx(0.7))


def test_interval_is_widened_by_what_few_pools_hide() -> None:
    """Two pools at 0 and 1: a bootstrap's mean is 0, 1/2 or 1, and its interval all of it. Of the
    variance between two pools it shows half."""
    low, high = bootstrap_interval(torch.tensor([[0.0], [1.0]]))
    assert low == pytest.approx(0.5 - 0.5 * 2**0.5)
    assert high == pytest.approx(0.5 + 0.5 * 2**0.5)


def test_differences_are_paired_and_levels_are_reached() -> None:
    rising = torch.linspace(0, 1, 11).expand(2, 3, 4, 11)
    two_runs = torch.cat([rising[:, :1] - 0.25, rising[:, :1] - 0.75], 1)
    found = records_of(
        policy_query=rising,
        random=rising[:, :1] - 0.25,
        greedy_many_samples=rising[:, :1, :2],
        greedy_alignment=two_runs,
    )
    assert found.values("greedy_alignment", "alignment").shape == (2, 2, 4, 11)
    for key, gap in (("random", 0.25), ("greedy_many_samples", 0.0), ("greedy_alignment", 0.5)):
        assert torch.allclose(difference(found, "policy_query", key), torch.tensor(gap))
    assert answers_to_reach(found, "policy_query", 0.55) == "6"
    assert answers_to_reach(found, "random", 0.9) == "never"


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
    monkeypatch.setattr(heldout_pool, "HUMANS", 6)
    monkeypatch.setattr(heldout_pool, "FINE_HUMANS", 2)
    monkeypatch.setattr(heldout_pool, "FINE_SAMPLES", 40)
    settings = settings_of(setup)
    cell = Cell(setup, "noisy")
    policy = f"policy_{setup}"
    learned = kinds_of([checkpoint_of({**settings, "seed": seed}) for seed in (0, 7)])
    assert list(learned) == [policy]
    jobs = [Job(settings, cell, pool, learned, (0.2,)) for pool in (0, 1)]
    records = Records([entry for job in jobs for entry in run_pool(job)])
    strong, once = (
        ("greedy_alignment", "random") if setup == "query" else ("quantile_alignment", "ask_all")
    )
    assert records.strategies[-1] == policy
    assert {entry.seed for entry in records.entries if entry.strategy == policy} == {0, 7}
    counts = [records.values(key, "alignment").shape[1] for key in (strong, once, policy)]
    assert counts == [heldout_pool.RUNS, 1, 2]
    if setup == "feed":  # one alone takes every offer
        asked, offered = (records.values(once, name) for name in ("asked", "offered"))
        assert torch.equal(asked, offered)
        assert (records.values(strong, "offered") > records.values(strong, "asked")).any()
    if setup == "query":
        assert (records.values("greedy_no_repeats", "repeated") == 0).all()
        assert records.values("greedy_many_samples:M=40", "alignment").shape == (2, 1, 2, 5)
    # All start from the same prior samples of the same humans.
    start = records.values(policy, "alignment")[:, 0, :, 0]
    for key in records.strategies:
        if not key.startswith("greedy_many_samples"):
            assert torch.equal(records.values(key, "alignment")[:, 0, :, 0], start)
    # Another pool, other humans.
    assert not torch.isclose(*start).any()
    trained = make_pools(settings)
    for pool in (0, 1):
        _, own = task_and_pool(Job(settings, cell, pool))
        task = make_task(*trained, "noisy")
        assert own.digest not in (task.train.digest, task.test.digest)
    write_report(tmp_path, records)
    assert (tmp_path / "heldout.png").stat().st_size > 10_000
    text = (tmp_path / "tables.txt").read_text()
    assert f"{setup}, noisy human: alignment, 2 pools of 6 humans, 2 training seeds" in text
    assert "differences on the same humans" in text


def test_no_two_pools_share_a_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pool takes its seed for the starts and the next one for the moves."""
    seeds: list[int] = []

    trajectories = GridworldTask.trajectories

    def watched(task: GridworldTask, count: int, seed: int) -> Tensor:
        seeds.extend((seed, seed + 1))
        return trajectories(task, count, seed)

    monkeypatch.setattr(GridworldTask, "trajectories", watched)
    make_pools(settings_of("feed"))
    assert len(set(seeds)) == 4
    for pool in range(heldout.POOLS):
        task_and_pool(Job(settings_of("feed"), Cell("feed", "noisy"), pool))
    per_call = 2 * 2  # the training pool, and the job's own
    assert len(seeds) == 4 + per_call * heldout.POOLS
    assert len(set(seeds)) == 4 + 2 * heldout.POOLS


def test_the_threshold_is_fitted_without_a_look_at_the_test_pools() -> None:
    fits = []
    for pool in (0, 1):
        job = Job(settings_of("feed"), Cell("feed", "noisy"), pool, thresholds=(0.1, 0.4))
        fits.append(fit_threshold(job))
    assert torch.equal(*fits)
    assert fits[0][0] != fits[0][1]


def test_policies_of_other_tasks_are_refused() -> None:
    settings = settings_of("query")
    paper = checkpoint_of(settings_of("query", policy="paper"))
    with pytest.raises(InputError, match="indices of its training pool"):
        run_protocol([settings], {Cell("query", "noisy"): [paper]}, 1)
    other = checkpoint_of(settings)
    other.settings["setup"]["budget"] = 9
    with pytest.raises(InputError, match=r"setup\.budget=9"):
        run_protocol([settings_of("query")], {Cell("query", "noisy"): [other]}, 1)


def test_normaliser_is_that_of_the_training_pool() -> None:
    settings = settings_of("query")
    train, _ = make_pools(settings)
    task, own = task_and_pool(Job(settings, Cell("query", "noisy"), 3))
    assert torch.equal(task.normalizer.mean, Normalizer.fit(train.features).mean)
    assert own.features.mean().abs() > 1e-6


def test_features_are_balanced_by_the_training_pool() -> None:
    task, own = task_and_pool(Job(settings_of("query"), Cell("query", "noisy", "balanced"), 0))
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
    task, pool = task_and_pool(Job(settings, Cell("feed", "noisy"), 0))

    def make_env(sessions: int) -> FeedEnv:
        return heldout_pool.make_feed_env(settings, task, pool, sessions, 5)

    humans = draw_humans(make_env(7))
    twice = [Entrant("rule", RandomAsk()), Entrant("rule", RandomAsk())]
    one, two = run_side_by_side(make_env, humans, twice)["rule"]
    # The first question is asked of the same belief, so it is worth the same.
    assert torch.allclose(one.information[:, 1], two.information[:, 1], atol=1e-6)
    assert torch.equal(one.alignment[:, 0], two.alignment[:, 0])
    other = draw_humans(make_env(7))
    other["offers"] = humans["offers"].flip(1)
    (third,) = run_side_by_side(make_env, other, [Entrant("rule", RandomAsk())])["rule"]
    assert not torch.allclose(one.information[:, 1], third.information[:, 1], atol=1e-3)


def test_whole_protocol(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through worker processes, which see the constants of the module and not the test's."""
    monkeypatch.setattr(heldout, "POOLS", 1)
    monkeypatch.setattr(heldout, "BALANCED_POOLS", 1)
    monkeypatch.setattr(heldout, "THRESHOLDS", (0.1, 9.0))
    learned = {}
    for setup in ("query", "feed"):
        learned[Cell(setup, "noisy")] = [checkpoint_of({**settings_of(setup), "seed": 3})]
    records = run_protocol([settings_of("feed")], learned, 1, ["lookahead"])
    assert records.tasks == ["query/noisy/corners", "query/noisy/balanced", "feed/noisy/corners"]
    fit = Job(settings_of("feed"), Cell("feed", "noisy"), 0, thresholds=(0.1, 9.0))
    best = (0.1, 9.0)[int(fit_threshold(fit).argmax())]
    query, _, feed = map(records.of_task, records.tasks)
    assert f"threshold:{best:g}" in feed.strategies
    humans = heldout_pool.HUMANS
    assert query.values("policy_query", "alignment").shape == (1, 1, humans, 5)
    assert "lookahead" in query.strategies  # and left out of the feed
    with pytest.raises(InputError, match="it is for a setup that no policy here is for"):
        run_protocol([settings_of("feed")], dict([learned.popitem()]), 1, ["lookahead"])
    strong = query.values("greedy_alignment", "alignment")
    assert strong.shape == (1, heldout_pool.RUNS, humans, 5)
    assert not torch.equal(strong[0, 0], strong[0, 1])  # another luck of the belief


def test_policies_that_differ_in_their_seed_alone_are_one_kind() -> None:
    settings = settings_of("query")
    twice = [checkpoint_of({**settings, "seed": seed}) for seed in (0, 1)]
    other = checkpoint_of({**settings, "objective": "entropy"})
    attention = checkpoint_of(settings_of("query", "attention"))
    kinds = kinds_of([twice[0], attention, other, twice[1]])
    assert {key: len(members) for key, members in kinds.items()} == {
        "policy_query:scorer, objective=alignment": 2,
        "policy_query:attention": 1,
        "policy_query:scorer, objective=entropy": 1,
    }
    assert list(kinds_of(twice)) == ["policy_query"]


def test_policies_of_two_trainings_are_two_kinds() -> None:
    both = [checkpoint_of(settings_of("query", updates=updates)) for updates in (6, 7)]
    names = [f"policy_query:scorer, training.updates={updates}" for updates in (6, 7)]
    assert list(kinds_of(both)) == names
