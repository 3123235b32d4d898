"""Strategies of the user, and loading what was trained, from Python."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import make, settings_of, trainer_of

import torchrl_pref
from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.acquisition.per_second import Cost, PerSecond
from torchrl_pref.config.checks import PER_SECOND
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation import heldout, heldout_pool
from torchrl_pref.evaluation.comparison import compare, try_strategies
from torchrl_pref.evaluation.heldout import kinds_of, run_protocol
from torchrl_pref.evaluation.heldout_pool import Cell, Job, run_pool, task_and_pool, try_job
from torchrl_pref.evaluation.own import find_makers, make_own, try_own
from torchrl_pref.evaluation.records import Records
from torchrl_pref.evaluation.tables import tables
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.pretrained import FOLDER
from torchrl_pref.training.start import make_checkpoint

MINE = """
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl_pref.strategies import RandomAsk, RandomQuery

number = 5

def rule(env):
    return RandomAsk() if "offer" in env.observation_spec.keys() else RandomQuery(7)

def first(env):
    return TensorDictModule(lambda mask: mask.long().argmax(-1), ["action_mask"], ["action"])

def silent(env):
    return TensorDictModule(lambda mask: mask, ["action_mask"], ["choice"])

def far(env):
    return TensorDictModule(lambda mask: mask.sum(-1) + 7, ["action_mask"], ["action"])

def half(env):
    return TensorDictModule(lambda mask: mask.long().argmax(-1)[:1], ["action_mask"], ["action"])

def breaks(env):
    raise ZeroDivisionError("of mine")

def nothing(env):
    return 5
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module in the current directory, named anew each time."""
    name = f"mine_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MINE)
    (tmp_path / f"{name}_broken.py").write_text("import torch\nraise KeyError('spoiled')")
    (tmp_path / f"{name}_lacks.py").write_text("import nowhere_to_be_found")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


def test_names_that_mean_nothing_are_refused_in_one_line(mine: str) -> None:
    for typed, message in (
        ("absent:rule", "no module absent in"),
        (f"{mine}.inner:rule", f"no module {mine}.inner in"),
        (f"{mine}:absent", "has no absent; expected the name"),
        (f"{mine}:number", "number is of type int"),
        (f"{mine}_broken:rule", f"fails (KeyError: 'spoiled', {mine}_broken.py line 2)"),
        (f"{mine}_lacks:rule", "(ModuleNotFoundError: No module named 'nowhere_to_be_found'"),
    ):
        with pytest.raises(InputError) as refused:
            find_makers([typed])
        assert message in str(refused.value)
        assert str(refused.value).startswith(f"strategy={typed}: ")
        assert "\n" not in str(refused.value)


def test_what_cannot_decide_is_refused_before_anything_is_run(mine: str, pool: QueryPool) -> None:
    env = make(QueryEnv, pool, batch=2)
    try_own(find_makers([f"{mine}:rule", f"{mine}:first"]), env)
    for name, message in (
        ("nothing", "made something of type int"),
        ("breaks", f"fails (ZeroDivisionError: of mine, {mine}.py line "),
        ("silent", "(it writes no action)"),
        ("far", "expected a TensorDictModule that writes action"),
        ("half", "expected a TensorDictModule that writes action"),
    ):
        with pytest.raises(InputError) as refused:
            try_own(find_makers([f"{mine}:{name}"]), env)
        assert message in str(refused.value), name
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match="it reads action_mask, which setup=query alone shows"):
        try_own(find_makers([f"{mine}:first"]), make(FeedEnv, pool, batch=2))


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_a_strategy_of_the_user_is_a_row_beside_ours(mine: str, setup: str) -> None:
    settings = settings_of(setup)
    _, task = trainer_of(settings)
    # One that is a baseline already, under the same name, has no second row.
    makers = find_makers([f"{mine}:rule", "alignment_gain"])
    try_strategies(makers, settings, task)
    with_it = compare(settings, task, task.test, {}, makers)
    without = compare(settings, task, task.test, {})
    key = f"own:{mine}:rule"
    assert list(with_it) == [*without, key]
    for name, result in without.items():  # ours are as they were
        assert torch.equal(result.alignment, with_it[name].alignment)
    assert torch.equal(with_it[key].alignment[:, 0], without["random"].alignment[:, 0])
    if setup == "feed":  # it asks everything, on the same offers with the same luck
        assert torch.equal(with_it[key].alignment, without["ask_all"].alignment)


def test_seconds_that_were_typed_are_those_that_count(pool: QueryPool) -> None:
    counting = {name for name, each in ACQUISITIONS.items() if isinstance(each, PerSecond)}
    assert counting == set(PER_SECOND)
    settings: Any = {"cost": {"watch": 7.0, "decide": 3.0}}
    env, cost = make(QueryEnv, pool, batch=2), Cost(7.0, 3.0)
    for name, maker in find_makers(PER_SECOND, settings).items():
        assert maker(env).acquisition == replace(ACQUISITIONS[name], cost=cost)
    for name, maker in find_makers(PER_SECOND).items():
        assert maker(env).acquisition == ACQUISITIONS[name]


def test_the_protocol_pairs_several_kinds_and_the_user_s_own(
    mine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heldout_pool, "HUMANS", 5)
    monkeypatch.setattr(heldout_pool, "FINE_HUMANS", 2)
    monkeypatch.setattr(heldout_pool, "FINE_SAMPLES", 40)
    checkpoints = []
    for policy, seed in (("scorer", 0), ("scorer", 1), ("attention", 0)):
        settings = {**settings_of("query", policy), "seed": seed}
        trainer, task = trainer_of(settings)
        checkpoints.append(make_checkpoint(settings, task, trainer))
    kinds = kinds_of(checkpoints)
    own = (f"{mine}:rule",)
    job = Job(settings_of("query"), Cell("query", "noisy"), 0, kinds, own=own)
    try_job(job)
    records = Records(run_pool(job))
    judged = ["policy_query:scorer", "policy_query:attention", f"own:{mine}:rule"]
    assert records.strategies[-3:] == judged
    found = {key: records.values(key, "alignment") for key in judged}
    assert [values.shape[1] for values in found.values()] == [2, 1, 1]
    assert all(torch.equal(v[0, 0, :, 0], found[judged[0]][0, 0, :, 0]) for v in found.values())
    alone = Records(run_pool(Job(settings_of("query"), job.cell, 0, kinds)))
    assert records.has("random", "calibration")
    assert not records.has("greedy_many_samples:M=40", "calibration")  # of a few humans
    for key in alone.strategies:  # the baselines' numbers depend on who is beside them in nothing
        assert alone.values(key, "alignment").shape == records.values(key, "alignment").shape
    text = tables(records)
    for pair in (("RL (attention)", "RL (scorer)"), (f"{mine}:rule", "RL (attention)")):
        assert any(line.startswith(pair[0]) and pair[1] in line for line in text.splitlines())
    with pytest.raises(InputError, match="made something of type int"):
        try_job(Job(settings_of("query"), job.cell, 0, kinds, own=(f"{mine}:nothing",)))


def test_the_protocol_draws_the_actions_of_a_policy_that_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(heldout_pool, "HUMANS", 5)
    found = []
    for sample in (False, True, True):
        settings = settings_of("feed")
        settings["policy"]["sample"] = sample
        trainer, task = trainer_of(settings)
        with torch.no_grad():  # all but indifferent
            trainer.policy.weights["actor"].module[0].module.log_scale.fill_(-9)
            for number, weight in enumerate(trainer.average.values()):
                weight.copy_(list(trainer.policy.weights.state_dict().values())[number])
        kinds = kinds_of([make_checkpoint(settings, task, trainer)])
        records = Records(run_pool(Job(settings, Cell("feed", "noisy"), 0, kinds, (0.2,))))
        found.append(records.values("policy_feed", "offered"))
    assert not torch.equal(found[0], found[1])
    assert torch.equal(found[1], found[2])


def test_the_protocol_runs_on_pools_of_the_user(tmp_path: Path) -> None:
    for name in ("train", "test"):
        QueryPool(torch.randn(25, 3, 6)).save(tmp_path / f"{name}.pt")
    settings = settings_of("query")
    settings["pool"] |= {name: str(tmp_path / f"{name}.pt") for name in ("train", "test")}
    trainer, task = trainer_of(settings)
    learned = {Cell("query", "noisy"): [make_checkpoint(settings, task, trainer)]}
    jobs = heldout._jobs(settings, learned, ())
    assert [(job.cell.features, job.pool) for job in jobs] == [("own", n) for n in range(10)]
    for job in jobs[:2]:
        _, pool = task_and_pool(job)
        assert torch.equal(pool.features, task.test.features)
    small = {**settings, "pool": settings["pool"] | {"test": str(tmp_path / "five.pt")}}
    QueryPool(torch.randn(25, 3, 5)).save(tmp_path / "five.pt")
    with pytest.raises(InputError, match="D=5"):
        run_protocol([small], learned, 1)


@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
def test_a_trained_policy_is_loaded_by_one_call(kind: type, pool: QueryPool) -> None:
    setup = "query" if kind is QueryEnv else "feed"
    options = {"skip": "free"} if kind is FeedEnv else {}
    env = make(kind, pool, objective="alignment", **options)
    policy = torchrl_pref.load_policy(FOLDER / f"{setup}-noisy-0.pt", env)
    data = env.rollout(3, policy.strategy)
    assert not any(value.requires_grad for value in data.values(True, True))
    other = {"query": "feed", "feed": "query"}[setup]
    with pytest.raises(InputError, match=f"a policy of setup={other} cannot decide in one"):
        torchrl_pref.load_policy(FOLDER / f"{other}-noisy-0.pt", env)
    with pytest.raises(InputError, match="no such file"):
        torchrl_pref.load_policy("nowhere.pt", env)
    if kind is FeedEnv:
        with pytest.raises(InputError, match="skip='regret': the policy was trained with"):
            torchrl_pref.load_policy(FOLDER / "feed-noisy-0.pt", make(FeedEnv, pool))


def test_normalisers_save_and_load(tmp_path: Path, pool: QueryPool) -> None:
    normalizer = Normalizer.fit(torch.randn(50, 4) * 3 + 1)
    normalizer.save(tmp_path / "n.pt")
    again = Normalizer.load(tmp_path / "n.pt")
    assert torch.equal(again(pool.features), normalizer(pool.features))
    pool.save(tmp_path / "pool.pt")
    with pytest.raises(InputError, match="holds query pool; expected a normalizer"):
        Normalizer.load(tmp_path / "pool.pt")
    for mean, std in (
        (torch.zeros(3), torch.ones(4)),
        (torch.zeros(3), torch.tensor([1.0, 0.0, 1.0])),
        (torch.tensor([0.0, torch.nan]), torch.ones(2)),
        (torch.zeros(3, 1), torch.ones(3, 1)),
        (torch.zeros(3).double(), torch.ones(3)),
    ):
        Normalizer(mean, std).save(tmp_path / "bad.pt")
        with pytest.raises(InputError, match=r"bad\.pt: a normaliser w"):
            Normalizer.load(tmp_path / "bad.pt")


def test_one_is_made_for_each_environment_with_the_same_seed(mine: str, pool: QueryPool) -> None:
    env = make(QueryEnv, pool)
    makers = find_makers([f"{mine}:first", f"{mine}:rule"])
    drawn = []
    for _ in range(2):
        entrants = make_own(makers, env, 3)
        drawn.append(torch.rand(1))
        assert [entrant.key for entrant in entrants] == [f"own:{name}" for name in makers]
    assert torch.equal(*drawn)
