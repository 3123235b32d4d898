"""How far a training has come: kept in its checkpoint, and told by its ``training.csv``.

Shapes: B held-out humans.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from torch import Tensor

from torchrl_pref.checkpoints.contents import CURVES
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.storage.writing import replacing

HELD_OUT = ("held_out_alignment", "held_out_low", "held_out_high", "held_out_baseline")


@dataclass
class Progress:
    """How far a training run has come.

    Attributes:
        update: updates done.
        history: one value an update for each of ``CURVES``, NaN where there was nothing to measure.
        held_out: by update, 0 being the start, the alignment of the policy with each held-out human
            after the last query (B).
        baseline: the name of a strong strategy that learns nothing, and the same (B) of it.
    """

    update: int = 0
    history: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in CURVES})
    held_out: dict[int, Tensor] = field(default_factory=dict)
    baseline: tuple[str, Tensor] | None = None

    @classmethod
    def of(cls, training: dict[str, Any]) -> Progress:
        """What a checkpoint's ``training`` tells."""
        # In our order, whatever the order in the file.
        history = {name: training["history"][name] for name in CURVES}
        return cls(training["update"], history, training["held_out"], training["baseline"])

    def state_dict(self) -> dict[str, Any]:
        """Plain data and tensors that :meth:`of` reads."""
        return dict(vars(self))

    def row(self, update: int, frames: int) -> dict[str, float | str]:
        """A row of the table; empty where nothing was measured.

        Args:
            update: of the row; 0 is the start of the training.
            frames: steps of all sessions in one update.
        """
        row: dict[str, float | str] = {"update": update, "frames": update * frames}
        known = self.history.items() if update else ()
        row |= {_column(name): _number(values[update - 1]) for name, values in known}
        if update in self.held_out:
            values = self.held_out[update]
            numbers = [float(values.mean()), *bootstrap_interval(values)]
            if self.baseline is not None:
                numbers.append(float(self.baseline[1].mean()))
            row |= dict(zip(HELD_OUT, map(_number, numbers), strict=False))
        return row


def start_table(path: Path, progress: Progress, frames: int) -> None:
    """Write the table of a training so far, one row an update.

    It comes from the progress alone, whatever an earlier process left there: rows that it wrote
    after its last checkpoint, or half of one, are gone, and the others come out the same.

    Args:
        path: of the table; its folder is made where there is none.
        progress: of the run.
        frames: steps of all sessions in one update.

    Raises:
        InputError: the table cannot be written.
    """
    first = 0 if 0 in progress.held_out else 1
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial, partial.open("w", newline="") as file:
            writer = _writer(file, progress)
            writer.writeheader()
            for update in range(first, progress.update + 1):
                writer.writerow(progress.row(update, frames))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); expected a file, or nothing, in a "
            "folder that can be written"
        ) from None


def add_row(path: Path, progress: Progress, frames: int) -> None:
    """Add the row of the last update to a table that :func:`start_table` began."""
    with path.open("a", newline="") as file:
        _writer(file, progress).writerow(progress.row(progress.update, frames))


def _writer(file: TextIO, progress: Progress) -> csv.DictWriter[str]:
    columns = ["update", "frames", *map(_column, progress.history), *HELD_OUT]
    return csv.DictWriter(file, columns, restval="")


def _column(metric: str) -> str:
    """The name of a metric in the table."""
    return metric.split("/")[-1]


def _number(value: float) -> str:
    """As the table shows it; nothing for NaN."""
    return "" if math.isnan(value) else f"{value:.6g}"
