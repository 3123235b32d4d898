import csv
import math
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import make

from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.reports import alignment_table, few_samples, milestones, write_curves
from torchrl_pref.evaluation.run import Evaluation, draw_humans, evaluate
from torchrl_pref.pool import QueryPool
from torchrl_pref.strategies import Greedy, RandomQuery
from torchrl_pref.training.figure import even_edges, geometric_edges, smoothed


@pytest.mark.parametrize("edges_of", [even_edges, geometric_edges])
@pytest.mark.parametrize("count", [1, 2, 7, 100, 101, 2500])
def test_stretches_cover_every_update_once(edges_of: object, count: int) -> None:
    edges = edges_of(count)  # type: ignore[operator]
    assert edges[0] == 1
    assert edges[-1] == count + 1
    assert all(a < b for a, b in pairwise(edges))
    assert len(edges) <= 102


def test_smoothing_skips_what_is_not_known() -> None:
    values = [math.nan, 1.0, 3.0, math.nan, math.nan, 8.0]
    assert smoothed(values, [1, 4, 6, 7]) == ([2.0, 6.0], [2.0, 8.0])


def test_milestones_keep_their_proportion() -> None:
    assert milestones(20) == [5, 10, 20]
    assert milestones(8) == [2, 4, 8]
    assert milestones(1) == [1]


def test_tables_and_curves_say_what_was_measured(pool: QueryPool, tmp_path: Path) -> None:
    env = make(QueryEnv, pool, batch=12)
    humans = draw_humans(env)
    strategies = {"random": RandomQuery(), "greedy": Greedy(RESPONSE_MODELS[0])}
    results = {name: evaluate(env, module, humans) for name, module in strategies.items()}
    random, greedy = (results[name].alignment for name in strategies)
    rows = alignment_table(results, style="tsv").splitlines()[1:]
    cells = [cell.strip() for cell in rows[1].split("\t")]
    assert cells[0] == "greedy information gain"
    assert cells[3] == f"{greedy[:, 5].mean():.3f}"
    assert cells[-1].startswith(f"{(greedy - random)[:, 5].mean():+.3f} [")
    write_curves({"panel": results}, tmp_path / "curves.csv")
    with (tmp_path / "curves.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * 4 * 6
    for row in table:
        assert float(row["low"]) <= float(row["mean"]) <= float(row["high"])
    (row,) = [
        row
        for row in table
        if (row["strategy"], row["queries"], row["metric"]) == ("random", "3", "alignment")
    ]
    assert float(row["mean"]) == pytest.approx(float(random[:, 3].mean()), abs=1e-5)


def test_a_belief_worth_few_samples_is_told() -> None:
    def ess(*least: float) -> Evaluation:
        values = torch.full((3, 5), 100.0)
        values[0, 2 : 2 + len(least)] = torch.tensor(least)
        nothing = torch.zeros(3)
        return Evaluation(values, values, values, values, *[nothing] * 3, 0.0)

    assert few_samples({"greedy": ess(51.0), "random": ess()}) == []
    line, blank = few_samples({"greedy": ess(60.0, 21.0), "random": ess()})
    assert line.startswith("! greedy information gain: in 1 of 3 sessions")
    assert "least: 21 of 100" in line
    assert blank == ""
