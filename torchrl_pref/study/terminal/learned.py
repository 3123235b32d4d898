"""What has been learned of a person, as text for a terminal.

Letters: D features.
"""

from __future__ import annotations

from typing import Any

from torchrl_pref.study.terminal.options import WIDEST_NAME, printable

HALF = 15
"""Cells of a weight's bar to either side of zero."""


def learned_as_text(state: dict[str, Any]) -> tuple[list[str], list[str]]:
    """What a state (:func:`state.state_of`) says of what has been learned.

    Returns:
        The rows of a table of the weights, and sentences.
    """
    learned, answered = state["learned"], state["answered"]
    rows = [
        f"Learned from {answered} {'answer' if answered == 1 else 'answers'}. "
        f"How well you are known: {100 * learned['sureness']:.0f} of 100."
    ]
    if learned["expected_gain"] is not None:
        rows.append(f"Your next answer is expected to add {100 * learned['expected_gain']:.2g}.")
    care = learned["rationality"]
    if care is not None:
        rows.append(
            f"Your care is put at {care['median']:.2g} ({care['low']:.2g} to {care['high']:.2g}): "
            "the larger, the less chance is in your answers."
        )
    for one in learned["doubtful"]:
        rows.append(
            f"Answer {one['number']} fits badly with the others (probability "
            f"{one['probability']:.2g}). If it was a slip, u {one['number']} takes it back."
        )
    return weights_as_text(learned), rows


def weights_as_text(learned: dict[str, Any]) -> list[str]:
    """A row for each of D weights: its name, mean, interval and bar."""
    names = [printable(name) for name in learned["names"]]
    width = min(WIDEST_NAME, max(len("weight"), *map(len, names)))
    ruler = f"{'-1':<{HALF}}0{'1':>{HALF}}"
    rows = [f"  {'weight':<{width}}   mean   5% … 95%        {ruler}"]
    columns = (names, learned["mean"], learned["low"], learned["high"])
    for name, mean, low, high in zip(*columns, strict=True):
        name = name if len(name) <= width else f"{name[: width - 1]}…"
        interval = f"{low:+.2f} … {high:+.2f}"
        rows.append(f"  {name:<{width}}  {mean:+.2f}   {interval}  {weight_bar(mean, low, high)}")
    return rows


def weight_bar(mean: float, low: float, high: float) -> str:
    """A mean in its interval, from -1 to 1."""
    bar = [" "] * (2 * HALF + 1)
    first, last = _cell(low), _cell(high)
    bar[first : last + 1] = "─" * (last + 1 - first)
    bar[HALF] = "┼" if first <= HALF <= last else "│"
    bar[_cell(mean)] = "●"
    return "".join(bar)


def _cell(value: float) -> int:
    return round((max(-1.0, min(1.0, value)) + 1) * HALF)
