"""Figures of an evaluation.

Shapes: P pools, S training seeds (of a baseline: runs), B humans of a pool, H query budget.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
from torch import Tensor

from torchrl_pref.evaluation.metrics import METRICS
from torchrl_pref.evaluation.records import Records
from torchrl_pref.evaluation.style import (
    Style,
    baseline_of,
    is_drawn,
    is_judged,
    kind_of,
    legend_above,
    name_of,
    styles_of,
)
from torchrl_pref.evaluation.tables import counts, title_of
from torchrl_pref.evaluation.views import (
    FEWEST,
    alignment,
    curve,
    difference,
    measured,
    reliability,
    units,
)
from torchrl_pref.storage.writing import replacing

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

TITLE = 46
"""Letters of a panel's title in a line."""

LETTERS = 16
"""Of a caption in an inch."""


def figure_1(records: Records, path: Path, metric: str = "alignment") -> None:
    """The paper's Figure 1: alignment, or another metric, against the number of queries, a panel
    for each task."""
    styles = styles_of(records.strategies)
    figure, axes = _panels(records)
    for axis, task in zip(axes.flat, records.tasks, strict=False):
        own = records.of_task(task)
        for key in filter(is_drawn, own.strategies):
            _draw(axis, key, measured(own, key, metric), styles, own.batch)
        axis.set(xlabel="queries asked", xlim=(0, None))
        _finish(axis)
    for row in axes:
        row[0].set_ylabel(METRICS[metric].axis)
    if metric == "alignment":
        axes[0, 0].set_ylim(top=1.02)
    first = records.of_task(records.tasks[0])
    together = units(first.values(first.strategies[0], metric)[..., -1]).numel() == 1
    bands = "all together: no intervals" if together else "bands are 95% intervals"
    caption(figure, f"{counts(first)}, {bands}")
    legend_above(figure, styles)
    save_figure(figure, path)


def reliability_figure(records: Records, path: Path) -> None:
    """How likely humans give the answers that beliefs held so likely, a panel for each task."""
    styles = styles_of(records.strategies)
    figure, axes = _panels(records)
    for axis, task in zip(axes.flat, records.tasks, strict=False):
        axis.plot((0, 1), (0, 1), color="#bbbbbb", lw=1)
        own = records.of_task(task)
        for key in filter(is_drawn, own.strategies):
            predicted, given = reliability(own, key)
            _, color, line = styles[key]
            axis.plot(predicted, given, color=color, linestyle=line, marker=".", label=key)
        axis.set(xlabel="predicted probability of an answer", xlim=(0, 1), ylim=(0, 1))
        axis.grid(alpha=0.25)
    for row in axes:
        row[0].set_ylabel("how likely humans give it")
    caption(
        figure,
        "after the last query, on questions that nobody asked; all humans together; "
        f"bins of fewer than {FEWEST} answers are left out",
    )
    legend_above(figure, styles)
    save_figure(figure, path)


def _panels(records: Records) -> tuple[Figure, Any]:
    """A figure with a panel for each task, two in a row, and its axes."""
    tasks = records.tasks
    columns = min(2, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    size = (1 + 4.6 * columns, 4 * rows + 0.8)
    figure, axes = plt.subplots(
        rows, columns, figsize=size, sharey=True, squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(tasks) :]:
        axis.set_visible(False)
    for axis, task in zip(axes.flat, tasks, strict=False):
        axis.set_title(fill(title_of(task), TITLE))
    return figure, axes


def heldout_figure(records: Records, path: Path) -> None:
    """Alignment against the number of answers, and below it the difference of each strategy to the
    one that policies have to be better than."""
    tasks = [task for task in records.tasks if not task.endswith("/balanced")]
    styles = styles_of(records.strategies)
    size = (max(6.4, 1 + 3.6 * len(tasks)), 7.2)
    figure, axes = plt.subplots(
        *(2, len(tasks)),
        figsize=size,
        squeeze=False,
        sharex=True,
        height_ratios=[3, 2],
        layout="constrained",
    )
    for (above, below), task in zip(axes.T, tasks, strict=True):
        own = records.of_task(task)
        _draw_cell(above, below, own, styles)
        above.set(title=fill(title_of(task), TITLE), ylim=(0, 1.02))
        below.set(xlabel="queries asked")
        for axis in (above, below):
            _finish(axis)
    axes[0, 0].set_ylabel("alignment")
    caption(figure, "bands are 95% intervals; below: paired, on the same humans")
    legend_above(figure, styles)
    save_figure(figure, path)


def _draw_cell(above: Axes, below: Axes, records: Records, styles: Mapping[str, Style]) -> None:
    """Curves of the strategies of one task, and their differences to the policies' baseline."""
    keys = [key for key in records.strategies if is_drawn(key)]
    judged = next(key for key in keys if is_judged(key))
    baseline = baseline_of(judged, keys)
    for key in keys:
        _draw(above, key, alignment(records, key), styles)
        # What asks at random is far below, and would hide what is close.
        if baseline is not None and key != baseline and kind_of(key) not in ("random", "ask_all"):
            _draw(below, key, difference(records, key, baseline), styles)
    below.axhline(0, color="#555555", lw=0.8)
    if baseline is not None:
        below.set_ylabel(f"minus {name_of(baseline)}", fontsize="small")


def _draw(
    axis: Axes, key: str, values: Tensor, styles: Mapping[str, Style], batch: int = 1
) -> None:
    """Mean of curves (P S B J+1) by number of queries, so many at once, and its 95% interval."""
    means, bounds = curve(values)
    _, color, line = styles[key]
    # Dots go on top: a feed policy that asks everything lies exactly under "ask all".
    order = 3 if line == ":" else 2
    queries = range(0, batch * len(means), batch)
    axis.plot(queries, means, color=color, linestyle=line, label=key, zorder=order)
    axis.fill_between(queries, bounds[:, 0], bounds[:, 1], color=color, alpha=0.15, lw=0)


def _finish(axis: Axes) -> None:
    """Whole numbers of queries, and a grid."""
    axis.xaxis.set_major_locator(MaxNLocator("auto", integer=True, steps=[1, 2, 5, 10]))
    axis.grid(alpha=0.25)


def caption(figure: Figure, text: str) -> None:
    """What a figure shows, in small letters below it, in lines that it has room for."""
    lines = fill(text, int(LETTERS * figure.get_figwidth()))
    figure.supxlabel(lines, fontsize="small", color="#555555")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file and close it."""
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150)
    plt.close(figure)
