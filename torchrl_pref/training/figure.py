"""The figures of trainings: what was learned, and how it went.

Shapes: B held-out humans.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter
from torch import Tensor

from torchrl_pref.evaluation.figures import caption, save_figure
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.evaluation.style import Style, kind_of, name_of, styles_of
from torchrl_pref.evaluation.tables import signed
from torchrl_pref.training.progress import Progress

LABEL = 60
"""Letters of a legend's line in Figure 2."""

PANELS = {
    "train/alignment": "alignment in training",
    "train/reward": "reward of an episode",
    "train/episode_length": "offers seen in an episode",
    "train/explained_variance": "share of the returns\nthat the critic foresees",
}
"""What is drawn of the training episodes, and what it is called."""


class Training(NamedTuple):
    """A training, as figures and lines tell of it."""

    key: str
    """Of the learned policy, see ``evaluation/style.py``."""
    human: str
    """Whom it was trained with, for readers."""
    progress: Progress


def write_training(folder: Path, trained: Sequence[Training]) -> None:
    """Say what each training brought its held-out humans, draw the trainings' figures into a folder
    and say where.

    Args:
        folder: an existing folder.
        trained: the trainings; may be empty.
    """
    for training in trained:
        if len(training.progress.held_out) > 1:
            human = f", {training.human}" if len(trained) > 1 else ""
            print(f"{name_of(training.key)}{human}: {learned(training.progress)}")
    written = []
    feeds = [training for training in trained if kind_of(training.key) == "policy_feed"]
    if feeds:
        figure_2(feeds, folder / "figure_2.png")
        written.append("figure_2.png")
    if len(trained) == 1:
        training_figure(trained[0], folder / "training.png")
        written.append("training.png")
    if written:
        print(f"written to {folder}: {', '.join(written)}")


def learned(progress: Progress) -> str:
    """In a line, what held-out humans had of a training: where at least two points are known."""
    first, last = min(progress.held_out), max(progress.held_out)
    start, end = progress.held_out[first], progress.held_out[last]
    line = (
        f"alignment with {len(end)} held-out humans {start.mean():.3f} after {first} updates, "
        f"{end.mean():.3f} after {last}: {_difference(end - start)}"
    )
    if progress.baseline is not None:
        name, values = progress.baseline
        line += f"; minus {name_of(name)} {_difference(end - values)}"
    return line


def training_figure(training: Training, path: Path) -> None:
    """What was learned, by held-out humans; below it how the training went.

    Args:
        training: whose progress to draw; without held-out humans only the lower half is drawn.
        path: of the figure.
    """
    progress = training.progress
    history, style = progress.history, styles_of([training.key])[training.key]
    below = [key for key in PANELS if key != "train/episode_length" or _varies(history[key])]
    rows = [below]
    if progress.held_out:
        below = [key for key in below if key != "train/alignment"]
        # As wide above as below: each panel takes its share of the columns.
        rows = [
            ["level"] * len(below) + ["gain"] * len(below),
            [key for key in below for _ in "ab"],
        ]
    size = (4.2 * max(2, len(below)), 3.4 * len(rows))
    figure, axes = plt.subplot_mosaic(rows, figsize=size, layout="constrained")  # type: ignore[arg-type]
    if progress.held_out:
        _draw_level(axes["level"], style, progress)
        _draw_gain(axes["gain"], style, progress)
        count = len(next(iter(progress.held_out.values())))
        caption(
            figure,
            f"above: alignment after the last query, mean of {count} humans that no training met, "
            "on the held-out pool with as many candidates or offers as in training, the same "
            "humans with the same luck each time; band and bars are 95% intervals; "
            "below: means over the episodes of the training",
        )
    for key in below:
        points = smoothed(history[key], even_edges(len(history[key])))
        axes[key].plot(*points, color=style.color, marker=".", markersize=3)
        axes[key].set_ylabel(PANELS[key])
    for axis in axes.values():
        axis.set_xlabel("policy updates")
        axis.grid(alpha=0.25)
    save_figure(figure, path)


def _draw_level(axis: Axes, style: Style, progress: Progress) -> None:
    """Alignment by update, beside the start's and the baseline's."""
    updates = sorted(progress.held_out)
    alignments = [progress.held_out[update] for update in updates]
    means = [float(values.mean()) for values in alignments]
    low, high = zip(*map(bootstrap_interval, alignments), strict=True)
    name, color, _ = style
    axis.plot(updates, means, color=color, marker="o", zorder=3, label=f"{name}, as it learns")
    axis.fill_between(updates, low, high, color=color, alpha=0.15, lw=0)
    for (label, other, line), values in _others(progress):
        axis.axhline(float(values.mean()), color=other, linestyle=line, label=label)
    axis.set_ylabel("alignment with held-out humans")
    _legend_above(axis)


def _draw_gain(axis: Axes, style: Style, progress: Progress) -> None:
    """Paired differences of the policy to its start and to the baseline, by update."""
    updates = sorted(progress.held_out)
    apart = 0.006 * (updates[-1] - updates[0])  # side by side, or bars would hide each other
    for side, ((label, color, _), other) in zip((apart, -apart), _others(progress), strict=False):
        gains = [progress.held_out[update] - other for update in updates]
        means = torch.stack([gain.mean() for gain in gains])
        bounds = torch.tensor([bootstrap_interval(gain) for gain in gains]).T
        bars = (bounds - means).abs()
        places = [update + side for update in updates]
        label = f"{style.name} minus {label}"
        axis.errorbar(places, means, bars, color=color, marker="o", capsize=3, label=label)
    axis.axhline(0, color="#555555", lw=0.8)
    axis.set_ylabel("difference in alignment,\nhuman by human")
    _legend_above(axis)


def _others(progress: Progress) -> Iterator[tuple[Style, Tensor]]:
    """What the policy is held against: its style and its alignments (B)."""
    if progress.baseline is not None:
        key, values = progress.baseline
        yield styles_of([key])[key], values
    yield styles_of(["start"])["start"], progress.held_out[min(progress.held_out)]


def _legend_above(axis: Axes) -> None:
    """Where it covers nothing."""
    axis.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2)


def _varies(values: Sequence[float]) -> bool:
    """Whether there is anything to see."""
    return len({value for value in values if not math.isnan(value)}) > 1


def _difference(paired: Tensor) -> str:
    """Mean and interval of paired differences (B)."""
    return signed(float(paired.mean()), bootstrap_interval(paired))


def figure_2(trained: Sequence[Training], path: Path) -> None:
    """The paper's Figure 2: mean length of the training episodes against the number of updates."""
    figure, axis = plt.subplots(figsize=(5.6, 4.6), layout="constrained")
    styles = styles_of(training.key for training in trained)
    # The trainings of one strategy have its colour, and markers to tell them apart.
    for training, marker in zip(trained, cycle("os^Dvx"), strict=False):
        lengths = training.progress.history["train/episode_length"]
        name, color, line = styles[training.key]
        points = smoothed(lengths, geometric_edges(len(lengths)))
        (drawn,) = axis.plot(*points, color=color, linestyle=line, marker=marker, markersize=4)
        drawn.set_label(fill(f"{name}, {training.human}", LABEL))
    # Most of it happens in the first hundredth of the updates.
    axis.set(xlabel="policy updates", ylabel="training episode length (offers)", xscale="log")
    for each in (axis.xaxis.set_major_formatter, axis.xaxis.set_minor_formatter):
        each(LogFormatter())  # 2 and not 2·10⁰
    axis.grid(alpha=0.25)
    _legend_above(axis)
    caption(
        figure,
        "mean of the episodes that ended in an update: of those that begin together short ones "
        "end first, so that the curve may rise until every session has ended once",
    )
    save_figure(figure, path)


def smoothed(values: Sequence[float], edges: Sequence[int]) -> tuple[list[float], list[float]]:
    """Means of the known values between edges (1-based updates), and the updates' middles."""
    middles, means = [], []
    for start, end in pairwise(edges):
        known = [value for value in values[start - 1 : end - 1] if not math.isnan(value)]
        if known:
            middles.append((start + end - 1) / 2)
            means.append(sum(known) / len(known))
    return middles, means


def even_edges(count: int) -> list[int]:
    """Edges of at most 100 stretches of equal length that cover updates 1 to ``count``."""
    return [*range(1, count + 1, math.ceil(count / 100)), count + 1]


def geometric_edges(count: int) -> list[int]:
    """Edges of stretches each about a tenth longer than the one before."""
    edges = [1]
    while edges[-1] <= count:
        edges.append(min(count + 1, math.ceil(edges[-1] * 1.1 + 1e-9)))
    return edges
