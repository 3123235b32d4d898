"""Tables, figures and files of an evaluation."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import torch
from tabulate import tabulate
from torch import Tensor

from torchrl_pref.evaluation.run import CURVES, Evaluation
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.storage.writing import replacing, write_text

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Results = Mapping[str, Evaluation]

STYLE = {
    "random": ("#7f7f7f", "--"),
    "greedy": ("#1f1f1f", "-"),
    "greedy alignment": ("#009e73", "-"),
    "ask all": ("#000000", ":"),
    "quantile": ("#cc79a7", "-."),
    "RL": ("#0072b2", "-"),
    "RL-feed": ("#d55e00", "-"),
}
"""Colour (Okabe and Ito's, told apart by colour-blind readers) and line of each strategy."""

NAMES = {
    "greedy": "greedy information gain",
    "ask all": "ask all (feed)",
    "quantile": "quantile of alignment (feed)",
}


def milestones(budget: int) -> list[int]:
    """The numbers of queries that tables report: 5, 10 and 20 of 20, in proportion otherwise."""
    return sorted({max(1, round(budget * share)) for share in (0.25, 0.5, 1.0)})


def alignment_table(results: Results, style: str = "simple") -> str:
    """The headline table: alignment, its interval and paired differences, one strategy a row."""
    budget = next(iter(results.values())).alignment.shape[1] - 1
    columns = milestones(budget)
    rows = []
    for name, result in results.items():
        final = result.alignment[:, -1]
        rows.append(
            [
                NAMES.get(name, name),
                *(f"{result.alignment[:, j].mean():.3f}" for j in columns),
                "[{:.3f}, {:.3f}]".format(*bootstrap_interval(final)),
                *(
                    "" if name == other else _difference(final - results[other].alignment[:, -1])
                    for other in ("greedy", "random")
                ),
            ]
        )
    headers = [
        "strategy",
        *(f"after {j}" for j in columns),
        f"after {budget} [95%]",
        "minus greedy [95%]",
        "minus random [95%]",
    ]
    return tabulate(rows, headers, tablefmt=style, disable_numparse=True)


def detail_table(results: Results, style: str = "simple") -> str:
    """What else was measured after the last query, one strategy a row."""
    rows = []
    for name, result in results.items():
        rows.append(
            [
                NAMES.get(name, name),
                f"{result.alignment[:, -1].mean():.3f}",
                f"{result.alignment_of_mean[:, -1].mean():.3f}",
                f"{result.information[:, -1].mean():.2f}",
                f"{result.ess[:, 1:].mean():.0f}",
                f"{result.asked.float().mean():.1f}",
                f"{result.offered.float().mean():.1f}",
                f"{result.repeated.float().mean():.1f}",
                f"{1000 * result.seconds_per_query:.2f}",
            ]
        )
    headers = ["strategy", "mean of cosines", "cosine of mean", "bits", "ESS"]
    headers += ["asked", "offered", "repeated", "ms an ask"]
    return tabulate(rows, headers, tablefmt=style, disable_numparse=True)


def few_samples(results: Results) -> list[str]:
    """A line for each strategy whose belief has at times been worth under half of its samples."""
    lines = []
    for name, result in results.items():
        shares = result.ess / result.ess[:, :1]  # of the prior's, which are independent
        least = shares.amin(1)
        if (least < 0.5).any():
            count, worst = int((least < 0.5).sum()), result.ess[int(least.argmin())]
            lines.append(
                f"! {NAMES.get(name, name)}: in {count} of {len(least)} sessions the belief was "
                f"worth under half of its samples (least: {worst.min():.0f} of {worst[0]:.0f}); "
                "raise belief.samples, or trust these rows less"
            )
    return [*lines, ""] if lines else []


def _difference(paired: Tensor) -> str:
    """Mean and interval of a paired difference."""
    return signed(float(paired.mean()), bootstrap_interval(paired))


def signed(mean: float, interval: tuple[float, float]) -> str:
    """A difference and its interval, as tables show them."""
    return "{:+.3f} [{:+.3f}, {:+.3f}]".format(mean, *interval)


def write_curves(panels: Mapping[str, Results], path: Path) -> None:
    """Write every curve as CSV: panel, strategy, queries asked, metric, mean and 95% interval."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["panel", "strategy", "queries", "metric", "mean", "low", "high"])
        for panel, results in panels.items():
            for name, result in results.items():
                for metric in CURVES:
                    for j, values in enumerate(getattr(result, metric).unbind(1)):
                        numbers = [float(values.mean()), *bootstrap_interval(values)]
                        writer.writerow(
                            [panel, name, j, metric, *(f"{number:.5f}" for number in numbers)]
                        )


def figure_1(panels: Mapping[str, Results], path: Path) -> None:
    """The paper's Figure 1: alignment against the number of queries, one panel a kind of human."""
    columns = min(2, len(panels))
    rows = math.ceil(len(panels) / columns)
    size = (1 + 4.6 * columns, 4 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, sharey=True, squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (title, results) in zip(axes.flat, panels.items(), strict=False):
        for name, result in results.items():
            _draw_curve(axis, name, result.alignment)
        axis.set(title=title, xlabel="queries asked", xlim=(0, None), ylim=(None, 1.02))
        axis.xaxis.get_major_locator().set_params(integer=True)
        axis.grid(alpha=0.25)
        axis.legend(frameon=False, loc="lower right")
    for row in axes:
        row[0].set_ylabel("alignment (mean of cosines)")
    n_humans = len(next(iter(next(iter(panels.values())).values())).asked)
    figure.supxlabel(
        f"{n_humans} humans, bands are 95% intervals", fontsize="small", color="#555555"
    )
    save_figure(figure, path)


def _draw_curve(axis: Axes, name: str, values: Tensor) -> None:
    """Mean over humans and its 95% interval."""
    color, line = STYLE.get(name.removesuffix(" (pretrained)"), (None, "-"))
    means = values.mean(0)
    intervals = torch.tensor([bootstrap_interval(column) for column in values.unbind(1)])
    # Dots go on top: a feed policy that asks everything lies exactly under "ask all".
    label, order = NAMES.get(name, name), 3 if line == ":" else 2
    draw_band(axis, means, intervals, linestyle=line, color=color, label=label, zorder=order)


def draw_band(axis: Axes, means: Tensor, intervals: Tensor, **line: Any) -> None:
    """A curve by number of queries (H+1) and its intervals (H+1 2); ``line`` is its style."""
    queries = range(len(means))
    (drawn,) = axis.plot(queries, means, **line)
    axis.fill_between(
        queries, intervals[:, 0], intervals[:, 1], color=drawn.get_color(), alpha=0.15, lw=0
    )


def write_report(folder: Path, panels: Mapping[str, Results]) -> None:
    """Write tables, curves and figures to a folder; print the tables of each panel and say where.

    Args:
        folder: an existing folder.
        panels: evaluations by strategy, by the title of the panel.
    """
    tables = []
    for title, results in panels.items():
        n_humans = len(next(iter(results.values())).asked)
        heading = f"{title}, {n_humans} humans: alignment after so many queries"
        tables += [heading, "", alignment_table(results), ""]
        tables += ["after the last query", "", detail_table(results), "", *few_samples(results)]
    text = "\n".join(tables)
    write_text(folder / "tables.txt", text)
    write_curves(panels, folder / "curves.csv")
    figure_1(panels, folder / "figure_1.png")
    print(f"\n{text}\nwritten to {folder}: tables.txt, curves.csv, figure_1.png")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file and close it."""
    figure.tight_layout()
    with replacing(path) as partial:
        figure.savefig(partial, dpi=150)
    plt.close(figure)
