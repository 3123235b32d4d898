from __future__ import annotations

import csv
import gzip
import math
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import make
from torch import Tensor

from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.figures import caption, figure_1
from torchrl_pref.evaluation.records import (
    COLUMNS,
    CSV,
    PARQUET,
    Entry,
    Records,
    entry_of,
    read_records,
    write_records,
)
from torchrl_pref.evaluation.reports import write_report
from torchrl_pref.evaluation.run import CURVES, draw_humans, evaluate
from torchrl_pref.evaluation.style import KINDS, SPARE, baseline_of, name_of, styles_of
from torchrl_pref.evaluation.tables import alignment_table, few_samples, many_repeats, tables
from torchrl_pref.evaluation.views import comparisons, milestones, write_curves
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


def test_a_caption_has_room_in_its_figure() -> None:
    for width in (5.6, 10.2):
        figure = plt.figure(figsize=(width, 3))
        caption(figure, "how likely people give the answers that beliefs held so likely " * 4)
        (text,) = figure.texts
        extent = text.get_window_extent(figure.canvas.get_renderer())  # type: ignore[attr-defined]
        assert extent.x0 >= 0
        assert extent.x1 <= figure.bbox.width
        plt.close(figure)


def test_milestones_keep_their_proportion() -> None:
    assert milestones(20) == [5, 10, 20]
    assert milestones(8) == [2, 4, 8]
    assert milestones(1) == [1]


@pytest.fixture(scope="module")
def records(pool: QueryPool) -> Records:
    """Random and greedy questions, on one pool."""
    env = make(QueryEnv, pool, batch=12)
    humans = draw_humans(env)
    strategies = {"random": RandomQuery(), "greedy_information": Greedy(RESPONSE_MODELS[0])}
    found = Records()
    for key, module in strategies.items():
        of = {"protocol": "comparison", "task": "somebody", "pool": "held-out", "seed": 0}
        result = evaluate(env, module, humans)
        found.entries.append(entry_of(result, CURVES, "seconds_per_query", **of, strategy=key))
    return found


def entry(key: str, pool: str = "0", seed: int = 0, **values: Tensor) -> Entry:
    return Entry("heldout", "query/noisy/corners", pool, seed, key, values)


def test_tables_and_curves_say_what_was_measured(records: Records, tmp_path: Path) -> None:
    random, greedy = (records.values(key, "alignment")[0, 0] for key in records.strategies)
    first, *rows = alignment_table(records, style="tsv").splitlines()
    head, row = ([cell.strip() for cell in line.split("\t")] for line in (first, rows[1]))
    cells = dict(zip(head, row, strict=True))
    assert cells["strategy"] == "information_gain"
    assert cells["after 5"] == f"{greedy[:, 5].mean():.3f}"
    assert cells["held against"] == "random"
    assert cells["minus that [95%]"].startswith(f"{(greedy - random)[:, 5].mean():+.3f} [")
    write_curves(tmp_path / "curves.csv", records)
    with (tmp_path / "curves.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * 4 * 6
    for row in table:
        assert float(row["low"]) <= float(row["mean"]) <= float(row["high"])
    (row,) = [
        row
        for row in table
        if (row["strategy"], row["query"], row["metric"]) == ("random", "3", "alignment")
    ]
    assert float(row["mean"]) == pytest.approx(float(random[:, 3].mean()), abs=1e-5)


def test_all_that_is_shown_comes_out_of_the_written_table(
    records: Records, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_report(tmp_path, records)
    again = read_records(tmp_path / CSV)
    assert tables(again) == tables(records) == (tmp_path / "tables.txt").read_text()
    assert tables(records) in capsys.readouterr().out
    for name, write in (
        ("curves.csv", write_curves),
        ("figure_1.png", lambda path, found: figure_1(found, path)),
    ):
        write(tmp_path / f"again_{name}", again)
        assert (tmp_path / f"again_{name}").read_bytes() == (tmp_path / name).read_bytes()


def test_records_are_one_long_table(records: Records, tmp_path: Path) -> None:
    write_records(tmp_path, records)
    with gzip.open(tmp_path / CSV, "rt") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    # 12 humans: 4 curves of 6 points, 3 numbers of a session; and the seconds of all.
    assert len(rows) == 2 * (12 * (4 * 6 + 3) + 1)
    (row,) = [
        row
        for row in rows
        if (row["strategy"], row["human"], row["query"], row["metric"])
        == ("random", "7", "4", "ess")
    ]
    assert torch.tensor(float(row["value"])) == records.values("random", "ess")[0, 0, 7, 4]
    assert {row["query"] for row in rows if row["metric"] == "asked"} == {""}
    (tmp_path / "other").mkdir()
    write_records(tmp_path / "other", records)
    assert (tmp_path / CSV).read_bytes() == (tmp_path / "other" / CSV).read_bytes()


def test_parquet_holds_the_same_table(records: Records, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    assert write_records(tmp_path, records) == [CSV, PARQUET]
    table = parquet.read_table(tmp_path / PARQUET)
    assert tuple(table.column_names) == COLUMNS
    assert [tuple(row.values()) for row in table.to_pylist()] == list(records.rows())


def test_a_file_that_is_no_table_of_records_is_refused(tmp_path: Path) -> None:
    for content in (b"text", gzip.compress(b"a,b\n1,2\n"), gzip.compress(b"")):
        (tmp_path / CSV).write_bytes(content)
        with pytest.raises(InputError, match="cannot be read as a table of records"):
            read_records(tmp_path / CSV)


def test_a_strategy_looks_alike_wherever_it_is_shown() -> None:
    alone = styles_of(["greedy_alignment", "policy_query"])
    among = styles_of(["own:mine:a", "policy_query", "policy_query:attention", *KINDS])
    assert all(among[key] == style for key, style in alone.items())
    looks = [style[1:] for key, style in among.items() if KINDS[key.partition(":")[0]].drawn]
    assert len(set(looks)) == len(looks)
    names = [style.name for style in among.values()]
    assert names.count("information_gain") == 2  # once with more samples, as its key says
    assert len(set(SPARE)) == len(SPARE)
    assert name_of("quantile") == name_of("quantile_alignment")  # of an older checkpoint


def test_each_row_is_held_against_what_matters_for_it() -> None:
    query = ["random", "greedy_information", "greedy_alignment", "policy_query:a"]
    feed = ["ask_all", "quantile_alignment", "policy_feed"]
    both = [*query, *feed]
    assert [baseline_of(key, both) for key in both] == [
        None,
        "random",
        "greedy_information",
        "greedy_alignment",
        None,
        "ask_all",
        "quantile_alignment",
    ]
    assert baseline_of("own:mine:a", query) == "greedy_alignment"
    assert baseline_of("own:mine:a", both) == "quantile_alignment"
    table = Records([entry(key) for key in [*both, "own:m:a"]])
    assert list(comparisons(table)) == [
        ("policy_query:a", "greedy_alignment"),
        ("policy_query:a", "random"),
        ("policy_query:a", "greedy_information"),
        ("policy_feed", "quantile_alignment"),
        ("policy_feed", "ask_all"),
        ("own:m:a", "quantile_alignment"),
        ("own:m:a", "ask_all"),
        ("own:m:a", "policy_feed"),
    ]


def test_a_belief_worth_few_samples_is_told() -> None:
    def ess(key: str, *least: float) -> Entry:
        values = torch.full((3, 5), 100.0)
        values[0, 2 : 2 + len(least)] = torch.tensor(least)
        return entry(key, ess=values)

    assert few_samples(Records([ess("greedy_information", 51.0), ess("random")])) == []
    told = Records([ess("greedy_information", 60.0, 21.0), ess("random")])
    line, blank = few_samples(told)
    assert line.startswith("! information_gain: in 1 of 3 sessions")
    assert "least: 21 of 100" in line
    assert blank == ""


def test_a_policy_that_repeats_itself_is_told() -> None:
    def asked(key: str, repeated: float) -> Entry:
        return entry(key, asked=torch.full((3,), 20.0), repeated=torch.full((3,), repeated))

    few = [asked("policy_query", 10.0), asked("random", 19.0), asked("own:m:a", 3.0)]
    assert many_repeats(Records(few)) == []
    line, blank = many_repeats(Records([*few, asked("policy_query:paper", 11.0)]))
    assert line.startswith("! RL (paper): 11.0 of 20.0 questions had been asked before")
    assert blank == ""
