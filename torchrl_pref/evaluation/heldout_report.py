"""Tables and the figure of the held-out protocol.

Shapes: P test pools, S training seeds (of a baseline: runs), B humans, H query budget.
"""

from __future__ import annotations

import csv
from pathlib import Path

import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from tabulate import tabulate
from torch import Tensor

from torchrl_pref.evaluation.heldout import Outcome, Results
from torchrl_pref.evaluation.reports import draw_band, save_figure, signed
from torchrl_pref.evaluation.statistics import two_way_interval
from torchrl_pref.storage.writing import replacing, write_text

COLORS = {
    "RL": "#0072b2",
    "greedy information": "#1f1f1f",
    "greedy alignment": "#d55e00",
    "random": "#8f8f8f",
    "ask all": "#8f8f8f",
    "quantile of information": "#1f1f1f",
    "quantile of alignment": "#d55e00",
    "threshold": "#cc79a7",
}
"""Strategies that are drawn, whatever the threshold; the others are in the tables only."""


def curve(outcome: Outcome) -> Tensor:
    """Alignment by number of answers (P S H+1), averaged over humans."""
    return outcome.alignment.mean(2)


def paired(outcome: Outcome, other: Outcome) -> Tensor:
    """Difference of the curves on the same humans, to the mean of the other's runs (P S H+1)."""
    # Where one of them met fewer humans, these are the first of the other's.
    count = min(outcome.alignment.shape[2], other.alignment.shape[2])
    runs = other.alignment[:, :, :count].mean(1, keepdim=True)
    return (outcome.alignment[:, :, :count] - runs).mean(2)


def reaches(outcome: Outcome, level: float) -> str:
    """The fewest answers after which the mean alignment is at least a level."""
    enough = (curve(outcome).mean((0, 1)) >= level).nonzero()
    return str(int(enough[0])) if len(enough) else "never"


def cell_table(outcomes: dict[str, Outcome]) -> str:
    """One strategy a row, and the paired differences of the policies to it."""
    budget = next(iter(outcomes.values())).alignment.shape[-1] - 1
    half = max(1, budget // 2)
    reference = outcomes.get("greedy information", outcomes.get("quantile of information"))
    assert reference is not None
    at_half, at_end = (float(curve(reference)[..., j].mean()) for j in (half, budget))
    rows = []
    for name, outcome in outcomes.items():
        values = curve(outcome)
        row = {
            "strategy": name,
            f"after {half}": f"{values[..., half].mean():.3f}",
            f"after {budget}": f"{values[..., -1].mean():.3f}",
            f"mean of 1 to {budget}": f"{values[..., 1:].mean():.3f}",
        }
        if name == "RL":
            row["RL minus it, last"] = row["RL minus it, mean"] = ""
        else:
            gap = paired(outcomes["RL"], outcome)
            row["RL minus it, last"] = _interval(gap[..., -1])
            row["RL minus it, mean"] = _interval(gap[..., 1:].mean(-1))
        row[f"reaches {at_half:.3f}"] = reaches(outcome, at_half)
        row[f"reaches {at_end:.3f}"] = reaches(outcome, at_end)
        row["bits"] = f"{outcome.bits.mean():.2f}"
        row["repeats"] = f"{outcome.repeated.mean():.1f}"
        row["ms to choose"] = f"{1000 * outcome.seconds.mean():.2f}"
        rows.append(row)
    return tabulate(rows, headers="keys", disable_numparse=True)


def write_heldout(folder: Path, results: Results) -> None:
    """Write every table, the curves and the figure to a folder; print the tables and say where."""
    parts = []
    for cell, outcomes in results.items():
        n_pools, _, n_humans = next(iter(outcomes.values())).alignment.shape[:3]
        n_seeds = outcomes["RL"].alignment.shape[1]
        parts.append(
            f"{cell.title}: alignment, {n_pools} pools of {n_humans} humans, {n_seeds} training "
            "seeds, [95% interval over pools and seeds]"
        )
        parts += ["", cell_table(outcomes), ""]
    text = "\n".join(parts)
    write_text(folder / "heldout.txt", text)
    _write_curves(results, folder / "heldout.csv")
    figure(results, folder / "heldout.png")
    print(f"\n{text}\nwritten to {folder}: heldout.txt, heldout.csv, heldout.png")


def figure(results: Results, path: Path) -> None:
    """Alignment against the number of answers, and RL's difference to each strategy below it."""
    cells = [cell for cell in results if cell.features == "corners"]
    size = (1 + 3.6 * len(cells), 6.4)
    fig, axes = plt.subplots(
        2, len(cells), figsize=size, squeeze=False, sharex=True, height_ratios=[3, 2]
    )
    for (above, below), cell in zip(axes.T, cells, strict=True):
        outcomes = results[cell]
        for name, outcome in outcomes.items():
            if _color(name) is None:
                continue
            _draw(above, name, curve(outcome))
            if name not in ("RL", "random", "ask all"):
                _draw(below, name, paired(outcomes["RL"], outcome))
        above.set(title=cell.title, ylim=(0, 1.02))
        above.legend(frameon=False, loc="lower right", fontsize="small")
        below.axhline(0, color="#555555", lw=0.8)
        below.set(xlabel="queries asked")
        for axis in (above, below):
            axis.grid(alpha=0.25)
            axis.xaxis.get_major_locator().set_params(integer=True)
    axes[0, 0].set_ylabel("alignment")
    axes[1, 0].set_ylabel("RL minus the strategy\nof that color")
    save_figure(fig, path)


def _draw(axis: Axes, name: str, values: Tensor) -> None:
    """Mean and interval of curves (P S H+1)."""
    means = values.mean((0, 1))
    bounds = torch.tensor([two_way_interval(column) for column in values.unbind(-1)])
    draw_band(axis, means, bounds, color=_color(name), label=name)


def _color(name: str) -> str | None:
    """Of a strategy that is drawn."""
    return COLORS.get("threshold" if name.startswith("threshold") else name)


def _interval(values: Tensor) -> str:
    """Mean and interval of values (P S)."""
    return signed(float(values.mean()), two_way_interval(values))


def _write_curves(results: Results, path: Path) -> None:
    """Write every mean curve as CSV."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["setup", "tau", "features", "strategy", "queries", "mean", "low", "high"])
        for cell, outcomes in results.items():
            for name, outcome in outcomes.items():
                for j, values in enumerate(curve(outcome).unbind(-1)):
                    numbers = [float(values.mean()), *two_way_interval(values)]
                    writer.writerow([*cell, name, j, *(f"{number:.5f}" for number in numbers)])
