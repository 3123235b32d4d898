"""Tables and figures of the docs that evaluations leave, see ``docs_tables.Writer``."""

from __future__ import annotations

import csv
import shutil
from itertools import product
from pathlib import Path

from torch import Tensor

from benchmarks.docs_tables import DOCS, Rows, table
from torchrl_pref.evaluation.figures import figure_1, heldout_figure
from torchrl_pref.evaluation.metrics import METRICS
from torchrl_pref.evaluation.records import CSV, Records, read_records
from torchrl_pref.evaluation.style import is_feed, is_judged, kind_of, name_of
from torchrl_pref.evaluation.tables import title_of, with_interval
from torchrl_pref.evaluation.views import (
    alignment,
    answers_to_reach,
    difference,
    mean_and_interval,
    measured,
    milestones,
)

SETUPS, TAUS = ("query", "feed"), ("noisy", "optimal")

RULES = ("greedy_information", "greedy_alignment")
"""The two that no training is needed for."""


def pretrained(folder: Path) -> dict[str, str]:
    """The first figure of the README."""
    figure_1(read_records(folder / CSV), DOCS / "pretrained.png")
    return {}


def heldout(folder: Path) -> dict[str, str]:
    """A table for each cell of the protocol, its figure, and its curves."""
    records = read_records(folder / CSV)
    heldout_figure(records, DOCS / "heldout.png")
    with (DOCS / "heldout.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "strategy", "queries", "mean", "low", "high"])
        for task in records.tasks:
            own = records.of_task(task)
            for key in own.strategies:
                for query, column in enumerate(alignment(own, key).unbind(-1)):
                    numbers = (f"{number:.5f}" for number in mean_and_interval(column))
                    writer.writerow([task, key, query, *numbers])
    return {
        f"heldout-{task.replace('/', '-')}": table(heldout_rows(records.of_task(task)))
        for task in records.tasks
    }


def heldout_rows(records: Records) -> Rows:
    """A line for each strategy of one cell, with the policy's paired difference to it."""
    policy = next(key for key in records.strategies if is_judged(key))
    information = next(k for k in records.strategies if kind_of(k).endswith("_information"))
    _, half, budget = milestones(alignment(records, policy).shape[-1] - 1)
    level = float(alignment(records, information).mean((0, 1, 2))[half])
    rows = []
    for key in records.strategies:
        values, gap = alignment(records, key), difference(records, policy, key)
        few = values.shape[2] < alignment(records, policy).shape[2]
        name = f"{name_of(key)}, {values.shape[2]} humans a pool" if few else name_of(key)
        row = {
            "strategy": f"**{name}**" if key == policy else name,
            f"after {half}": f"{values[..., half].mean():.3f}",
            f"after {budget}": f"{values[..., -1].mean():.3f}",
            f"mean of 1 to {budget}": f"{values[..., 1:].mean():.3f}",
            f"RL minus it, after {budget}": "" if key == policy else with_interval(gap[..., -1]),
            "RL minus it, mean": "" if key == policy else with_interval(gap[..., 1:].mean(-1)),
            f"reaches {level:.3f} after": answers_to_reach(records, key, level),
            "bits": f"{records.values(key, 'information').mean():.2f}",
        }
        if is_feed(key, records.strategies):
            row["offers seen"] = f"{records.values(key, 'offered').mean():.0f}"
        else:
            row["repeats"] = f"{records.values(key, 'repeated').mean():.1f}"
        row["ms to choose"] = f"{1000 * records.values(key, 'seconds_to_choose').mean():.2f}"
        rows.append(row)
    return rows


def paper(folder: Path) -> dict[str, str]:
    """The paper's two figures, final alignments, and the differences that its claims are about."""
    records = read_records(folder / "evaluation" / CSV)
    figure_1(records, DOCS / "figure_1.png")
    shutil.copy(folder / "evaluation" / "figure_2.png", DOCS)
    final, apart = [], []
    for key in records.strategies:
        row, other_row = {"alignment after 20 queries": name_of(key)}, {"minus": name_of(key)}
        for task in records.tasks:
            own, title = records.of_task(task), title_of(task)
            row[title] = f"{alignment(own, key)[..., -1].mean():.3f}"
            for policy in filter(is_judged, own.strategies):
                gap = difference(own, policy, key)[..., -1]
                other_row[f"{name_of(policy)}, {title}"] = with_interval(gap)
        final.append(row)
        if kind_of(key) in ("random", "greedy_information"):
            apart.append(other_row)
    return {"paper": f"{table(final)}\n\n{table(transposed(apart))}"}


def transposed(rows: Rows) -> Rows:
    """Columns as rows: what has many of them is read better so."""
    head, *names = rows[0]
    return [{"": name, **{f"{head} {row[head]}": row[name] for row in rows}} for name in names]


OBJECTIVES = {
    "control": "rewarded for information",
    "started": "started at information_gain, rewarded for alignment",
    "mean": "learned from nothing, sees the mean of the belief",
    "covariance": "the same, sees mean and covariance",
    "samples": "the same, sees all samples",
}
"""What each training of that part is."""


def objectives(folder: Path) -> dict[str, str]:
    """What an objective is worth, and what is learned from nothing: one training of each."""
    rows = []
    for run, what in OBJECTIVES.items():
        records = read_records(folder / f"{run}-evaluated" / CSV)
        keys = records.strategies if run == "control" else filter(is_judged, records.strategies)
        for key in keys:
            name = f"RL, {what}" if is_judged(key) else name_of(key)
            rows.append(beside_information(name, records, key))
    return {"objectives": table(rows)}


def beside_information(name: str, records: Records, key: str) -> dict[str, str]:
    """A strategy on the way and in the end, with its difference to information gain."""
    less = minus_information(records, key)
    last = "" if less is None else with_interval(less[..., -1])
    return {**on_the_way(name, records, key), "minus information_gain, last": last}


def on_the_way(name: str, records: Records, key: str) -> dict[str, str]:
    """A strategy's alignment after some of 20 questions."""
    values = alignment(records, key)
    after = {f"after {j}": f"{values[..., j].mean():.3f}" for j in milestones(20)}
    return {"strategy": name, **after}


def minus_information(records: Records, key: str) -> Tensor | None:
    """A strategy's paired differences to greedy information gain; None for that itself."""
    return None if key == RULES[0] else difference(records, key, RULES[0])


NOISE_RANGE = {
    "RL (range)": "RL, trained across the range",
    "RL (one)": "RL, trained at one tau (the Gridworld's of the package, seed 0)",
}
"""What each run of that part is."""


def noise_range(folder: Path) -> dict[str, str]:
    """Policies trained at one tau and across the range, where humans differ in theirs."""
    records = read_records(folder / "evaluated" / CSV)
    wanted = [*RULES, *filter(is_judged, records.strategies)]
    rows = [beside_information(name_of(key), records, key) for key in wanted]
    for row in rows:
        row["strategy"] = NOISE_RANGE.get(row["strategy"], row["strategy"])
    return {"noise_range": table(rows)}


def literature(folder: Path) -> dict[str, str]:
    """All strategies on the literature's tasks, a policy that was trained there, and one that was
    made for the Gridworld."""
    tables = {}
    for path in sorted(folder.glob(f"*-heldout/{CSV}")):
        records = read_records(path)
        for cell in records.tasks:
            own = records.of_task(cell)
            rows = [literature_row(own, key) for key in own.strategies]
            tables[f"tasks-{cell.replace('/', '-')}"] = table(rows)
    return tables


def literature_row(records: Records, key: str) -> dict[str, str]:
    """A strategy on one of these tasks, on the way and in the mean over the questions."""
    name = name_of(key)
    if is_judged(key):
        name = "RL, made for the Gridworld" if "gridworld" in key else "RL, trained on it"
    less = minus_information(records, key)
    return {
        **on_the_way(name, records, key),
        "mean of 1 to 20": f"{alignment(records, key)[..., 1:].mean():.3f}",
        "minus information_gain, mean": ""
        if less is None
        else with_interval(less[..., 1:].mean(-1)),
    }


def tasks(folder: Path) -> dict[str, str]:
    """The policy for every task beside the two rules that it has to be as good as, on all tasks
    that no training saw."""
    found = [read_records(path) for path in sorted(folder.glob(f"*/{CSV}"))]
    cells = {cell: records.of_task(cell) for records in found for cell in records.tasks}
    order = sorted(cells, key=lambda cell: (cell.split("/")[0] == "feed", cell.split("/")[2]))
    return {"tasks-every": table([every_row(cell, cells[cell]) for cell in order])}


def every_row(cell: str, records: Records) -> dict[str, str]:
    """One cell of the policy for every task."""
    setup, tau, task = cell.split("/")
    return {"setup, human": f"{setup}, {tau}", "task": task, **beside_rules(setup, records)}


def beside_rules(setup: str, records: Records) -> dict[str, str]:
    """The policy beside both rules of a setup, in the mean over the questions."""
    policy = next(key for key in records.strategies if is_judged(key))
    rule = "quantile" if setup == "feed" else "greedy"
    information, rule_alignment = f"{rule}_information", f"{rule}_alignment"

    def gap(first: str, second: str) -> str:
        return with_interval(difference(records, first, second)[..., 1:].mean(-1))

    return {
        "by information": f"{alignment(records, information)[..., 1:].mean():.3f}",
        "alignment − information": gap(rule_alignment, information),
        "RL − information": gap(policy, information),
        "RL − alignment": gap(policy, rule_alignment),
    }


BEYOND = {
    "2_features": "task=gaussian task.dimension=2 setup.budget=10",
    "8_features": "task=gaussian task.dimension=8 setup.budget=10",
    "24_features": "task=gaussian task.dimension=24 task.skew=3000 belief=laplace",
    "four_options": "task=driver pool.options=4",
    "ranking_of_three": "task=driver question=ranking",
    "weak": "task=driver question=weak",
    "5_questions": "task=driver setup.budget=5",
    "60_questions": "task=driver setup.budget=60",
    "tau_unknown": "task=driver belief=rationality",
}
"""What else than choices between two options is tried, by name; its humans are noisy."""


def beyond(folder: Path) -> dict[str, str]:
    """The policy for every task beside both rules where questions or beliefs are others."""
    rows = []
    for setup, name in product(SETUPS, BEYOND):
        records = read_records(folder / name / CSV)
        cell = next(cell for cell in records.tasks if cell.startswith(setup))
        row = beside_rules(setup, records.of_task(cell))
        rows.append({"setup": setup, "what": name.replace("_", " "), **row})
    return {"tasks-beyond": table(rows)}


BELIEFS = {
    "told": ("tau=4.4", "told tau 4.4"),
    "told_more": ("tau=17.6", "told 17.6, four times too careful"),
    "told_less": ("tau=1.1", "told 1.1"),
    "inferred": ("tau=4.4 belief=rationality", "inferred"),
}
"""Beliefs of people's tau, by the name of their evaluation: what is typed, and what it is."""

SPREADS = {"metrics": 1, "metrics-spread": 4}
"""Within which factor people's tau is, by the mark of the table."""


def metrics(folder: Path) -> dict[str, str]:
    """What every metric says of beliefs that are right or wrong about people's tau."""
    tables = {}
    for mark, spread in SPREADS.items():
        rows = []
        for belief, (_, what) in BELIEFS.items():
            records = read_records(folder / f"{belief}_{spread}" / CSV)
            records = records.of_task(records.tasks[0])  # and not of a belief that is right
            row = {"belief": what}
            for name, metric in METRICS.items():
                row[metric.head] = f"{measured(records, RULES[0], name)[..., -1].mean():.3f}"
            rows.append(row)
        tables[mark] = table(rows)
    return tables


def strategies(folder: Path) -> dict[str, str]:
    """Alignment by every rule, in both setups and with both kinds of human."""
    rows: dict[str, dict[str, str]] = {}
    for setup in SETUPS:
        records = read_records(folder / setup / CSV)
        for task in records.tasks:
            own = records.of_task(task)
            for key in own.strategies:
                if is_feed(key, own.strategies) != (setup == "feed"):
                    continue
                name = "random" if key == "ask_all" else name_of(key).removesuffix(", feed")
                ends = alignment(own, key).mean((0, 1, 2))[milestones(20)].tolist()
                row = rows.setdefault(name, {"strategy": f"`{name}`"})
                row[f"{setup}, {title_of(task)}"] = " / ".join(f"{end:.3f}" for end in ends)
    return {"strategies": table(list(rows.values()))}
