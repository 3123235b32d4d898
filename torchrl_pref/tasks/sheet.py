"""A sheet that shows what the questions of a pool look like.

Shapes: N queries, K options per query, D features. Sizes on paper are in inches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from matplotlib.figure import Figure

from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks.base import Task
from torchrl_pref.tasks.drawing import (
    DPI,
    HEADING,
    LETTERS,
    MARGIN,
    Box,
    aspect_of,
    axes_at,
    checked,
    draw_end,
    panel,
    panel_size,
    save_figure,
)
from torchrl_pref.tasks.images import Images, shaped
from torchrl_pref.tasks.scene import Scene, corners

COLOURS = ("#332288", "#44aa99", "#cc6677", "#ddaa33", "#aa4499", "#88ccee", "#117733", "#661100")
"""Of the options; by Paul Tol, told apart by colour-blind readers."""

MOST_QUERIES = 60
MOST_FEATURES = 12
"""That there is room for."""

AREA = 2.6
"""Square inches of one trajectory."""
BARS, BAR_ROW = 1.45, 0.29
"""Width of the panel of features, and height of each of its rows."""
SHAPE = 1.5
"""Width over height that a sheet should have."""

SPREAD = 3.0
"""Standard deviations that a bar can show."""


def contact_sheet(task: Task, pool: QueryPool, path: str | Path) -> None:
    """Write a picture of the questions of a pool: their options side by side, and their features.

    Args:
        task: draws the trajectories.
        pool: N queries with their trajectories, 60 at most, of 8 options at most.
        path: ends in ``.png`` or ``.svg``.

    Raises:
        InputError: the pool has no trajectories or is too large, or the file has another ending or
            cannot be written.
    """
    path = checked(path, ".png", ".svg")
    if pool.trajectories is None:
        raise InputError("a pool without trajectories: expected one with something to show")
    if len(pool) > MOST_QUERIES or pool.n_options > len(LETTERS):
        raise InputError(
            f"{len(pool)} queries of {pool.n_options} options: expected at most {MOST_QUERIES} of "
            f"at most {len(LETTERS)}; show fewer"
        )
    queries = [[task.scene(option) for option in query] for query in pool.trajectories]
    flat = pool.features.flatten(0, 1)
    scores = (pool.features - flat.mean(0)) / flat.std(0, correction=0).clamp(min=1e-9)
    save_figure(sheet(queries, scores.tolist(), task.feature_names), path)


def sheet(
    queries: list[list[Scene]], scores: list[list[list[float]]], names: Sequence[str]
) -> Figure:
    """A figure of queries in a grid.

    Args:
        queries: N of K scenes.
        scores: (N K D), features in standard deviations.
        names: D.
    """
    queries = [shaped(options, Images()) for options in queries]
    boxes, equal = [corners(options) for options in queries], queries[0][0].equal
    aspect = median(aspect_of(box, equal) for box in boxes)
    width, height = panel_size(aspect, AREA)
    n_options = len(queries[0])
    across = n_options * (width + MARGIN) + BARS + 3 * MARGIN
    rows_high = BAR_ROW * min(len(names), MOST_FEATURES)
    up = max(height, rows_high) + HEADING + MARGIN
    columns = columns_of(len(queries), across / up)
    whole = math.ceil(len(queries) / columns) * up + HEADING
    figure = Figure((columns * across + MARGIN, whole), DPI)
    for number, (options, box) in enumerate(zip(queries, boxes, strict=True)):
        left = number % columns * across + 2 * MARGIN
        top = whole - number // columns * up - HEADING
        seen = widened(box, aspect) if equal else box
        images = Images()  # which keeps those that move: of one query at a time
        for option, scene in enumerate(options):
            place = (left + option * (width + MARGIN), top - height, width, height)
            axes = panel(figure, place, scene, seen, images)
            draw_end(axes, scene, images)
            title = axes.set_title(LETTERS[option], fontsize=9, fontweight="bold", pad=3)
            title.set_color(COLOURS[option])
        _text(figure, left, top + 0.05, f"{number + 1}", 9)
        bars_left = left + n_options * (width + MARGIN)
        feature_bars(figure, (bars_left, top - rows_high, BARS, rows_high), scores[number], names)
    note = f"Bars: the options' features, ±{SPREAD:g} standard deviations over this sheet"
    _text(figure, 2 * MARGIN, 0.1, note, 7.5)
    return figure


def columns_of(count: int, shape: float) -> int:
    """Columns of a grid of cells of some shape (width over height) that come near ``SHAPE``."""

    def off(columns: int) -> float:
        rows = math.ceil(count / columns)
        return abs(math.log(columns * shape / rows / SHAPE)) + (rows * columns - count) / count

    return min(range(1, count + 1), key=off)


def widened(box: Box, aspect: float) -> Box:
    """A box around another, of some height over width."""
    (left, low), (right, high) = box
    width, height = right - left, high - low
    more_width = max(0.0, height / aspect - width) / 2
    more_height = max(0.0, width * aspect - height) / 2
    return (left - more_width, low - more_height), (right + more_width, high + more_height)


def feature_bars(
    figure: Figure,
    place: tuple[float, float, float, float],
    scores: list[list[float]],
    names: Sequence[str],
) -> None:
    """The features of a query's options (K D), a row of bars under the name of each."""
    axes = axes_at(figure, place)
    shown = min(len(names), MOST_FEATURES)
    axes.set(xlim=(-SPREAD, SPREAD), ylim=(shown, 0))
    axes.axis("off")
    thick = 0.5 / len(scores)
    for row, name in enumerate(names[:shown]):
        axes.text(-SPREAD, row + 0.24, name, fontsize=7, va="center", color="#333333")
        axes.plot([0, 0], [row + 0.42, row + 0.98], color="#999999", linewidth=0.8)
        for option, own in enumerate(scores):
            length = max(-SPREAD, min(SPREAD, own[row]))
            middle = row + 0.45 + (option + 0.5) * thick
            axes.barh(middle, length, thick * 0.9, color=COLOURS[option])


def _text(figure: Figure, left: float, low: float, words: str, size: float) -> None:
    """Words at a place in inches."""
    across, up = figure.get_size_inches()
    figure.text(left / across, low / up, words, fontsize=size, color="#666666")
