"""Strategies that ask several questions at once, beside each other."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
from helpers import settings_of
from tensordict.nn import TensorDictModule

from torchrl_pref.build import make_pools, make_task
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.comparison import evaluate_task, try_strategies
from torchrl_pref.evaluation.records import Records
from torchrl_pref.evaluation.style import KINDS
from torchrl_pref.evaluation.tables import tables
from torchrl_pref.evaluation.views import write_curves
from torchrl_pref.strategies import BATCH_STRATEGIES, RandomQuery


def evaluated(batch: int, options: int = 2, own: dict[str, Any] | None = None) -> Records:
    settings: Any = settings_of("query")
    settings["setup"]["batch"], settings["pool"]["options"] = batch, options
    task = make_task(*make_pools(settings), settings["tau"], settings)
    try_strategies(own or {}, settings, task)
    return evaluate_task(settings, task, {}, own=own)


def test_batches_take_the_place_of_what_asks_one_at_a_time(tmp_path: Path) -> None:
    assert evaluated(1).strategies == ["random", "greedy_information", "greedy_alignment"]
    records = evaluated(2, own={"mine:rule": BATCH_STRATEGIES["top"]})
    batches = [f"batch_{name}" for name in BATCH_STRATEGIES if name != "random"]
    assert records.strategies == ["random", *batches, "own:mine:rule"]
    assert {key for key in KINDS if KINDS[key].batch} == set(batches)
    curves = records.values("batch_top", "alignment")
    assert curves.shape[-1] == 5
    assert (curves[..., 1] == curves[..., 0]).all()
    assert (curves[..., 3] == curves[..., 2]).all()
    # A strategy of the user that is ours does as ours does, on the same humans with their luck.
    assert (records.values("own:mine:rule", "alignment") == curves).all()
    text, alone = tables(records), tables(evaluated(1))
    assert "queries are asked in batches of 2" in text
    assert "queries are asked in batches" not in alone
    # What is held between two batches is no measurement: after 2 and 4, and the mean of these.
    assert "after 2    after 4    mean of 2 to 4" in text
    assert "after 1    after 2    after 4    mean of 1 to 4" in alone
    top = next(line for line in text.splitlines() if line.startswith("top"))
    assert f"{curves[..., [2, 4]].mean():.3f}" in top
    write_curves(tmp_path / "curves.csv", records)
    with (tmp_path / "curves.csv").open() as file:
        assert {row["query"] for row in csv.DictReader(file)} == {"0", "2", "4"}


def test_questions_about_three_options_have_the_batches_that_need_no_pairs() -> None:
    assert evaluated(2, 3).strategies == ["random", "batch_top", "batch_joint"]


def test_a_strategy_that_chooses_one_is_refused_before_anything_is_run() -> None:
    def one(env: Any) -> TensorDictModule:
        return RandomQuery()

    with pytest.raises(InputError, match="writes action, 2 whole numbers for each session"):
        evaluated(2, own={"mine:one": one})
