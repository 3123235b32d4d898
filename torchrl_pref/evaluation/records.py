"""The one table of an evaluation: what every table, figure and summary is a view of.

Its columns are protocol, task, pool, human, seed, strategy, query, metric and value. In memory the
rows that differ in human, query and metric alone are kept together, as an :class:`Entry`.

Shapes: P pools, S training seeds (of a baseline: runs), B humans of a pool, H query budget.
"""

from __future__ import annotations

import csv
import gzip
import importlib.util
import io
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.metrics import BINS, PARTS
from torchrl_pref.evaluation.run import Evaluation
from torchrl_pref.storage.writing import replacing

COLUMNS = (
    "protocol",
    "task",
    "pool",
    "human",
    "seed",
    "strategy",
    "query",
    "metric",
    "value",
)

CSV, PARQUET = "records.csv.gz", "records.parquet"
"""Compressed, as each number comes with all that says of what it is: the held-out protocol has two
million rows, 130 MB as plain text and some 15 MB like this, and nearly as many again for each
metric beside alignment. pandas, polars and R read it as it is."""


RELIABILITY = tuple(f"{part}_in_bin_{place}" for part in PARTS for place in range(BINS))
"""Sums over all humans after the last answer, see ``metrics.reliability``."""


COMPARISON, MISJUDGED, REFERENCE = "comparison", "misjudged", "reference"
"""Protocols, see :class:`Entry`."""

AT_ONCE = "asked_at_once"
"""How many queries a strategy asked at once, where it was more than one."""


@dataclass(frozen=True)
class Entry:
    """What one strategy did on one pool, once.

    Attributes:
        protocol: ``comparison`` or ``heldout``; ``misjudged`` is a comparison with a human whom the
            belief takes for another, and ``reference`` what that is held against.
        task: which kind of human, and where there are several, of setup and features.
        pool: which queries.
        seed: of the policy's training, or the number of the run of a baseline.
        strategy: its key, see ``style.py``.
        values: by metric (B H+1) where there is one after each number of answers, (B) of a
            session; of all humans together, who are at least two, (1 H+1) or ().
    """

    protocol: str
    task: str
    pool: str
    seed: int
    strategy: str
    values: Mapping[str, Tensor]

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """Its rows of the table; human or query is None where the value is not of one."""
        for metric, values in self.values.items():
            table = values.reshape(len(values) if values.ndim else 1, -1).tolist()
            for human, row in enumerate(table):
                who = human if len(table) > 1 else None
                for query, value in enumerate(row):
                    of = (self.protocol, self.task, self.pool, who, self.seed, self.strategy)
                    yield (*of, query if values.ndim == 2 else None, metric, value)


@dataclass
class Records:
    """All entries of an evaluation, in the order in which tables show them."""

    entries: list[Entry] = field(default_factory=list)

    @property
    def tasks(self) -> list[str]:
        """The tasks, in order."""
        return list(dict.fromkeys(entry.task for entry in self.entries))

    def reference_of(self, task: str) -> str | None:
        """The task on the same pool in which the belief is right about the human, the next such
        one; None where none follows that is for this task."""
        own = self.of_task(task).entries[0]
        if own.protocol != MISJUDGED:
            return None
        place = self.tasks.index(task)
        for other in self.tasks[place + 1 :]:
            entry = self.of_task(other).entries[0]
            if entry.protocol == REFERENCE and entry.pool == own.pool:
                return other
        return None

    @property
    def strategies(self) -> list[str]:
        """The keys of the strategies, in order."""
        return list(dict.fromkeys(entry.strategy for entry in self.entries))

    @property
    def metrics(self) -> list[str]:
        """What was measured, in order."""
        return list(dict.fromkeys(name for entry in self.entries for name in entry.values))

    @property
    def batch(self) -> int:
        """How many queries were asked at once. Between two multiples of it nothing is learned, and
        values after so many answers are those of before: no table or figure counts them."""
        return max((int(one.values.get(AT_ONCE, 1)) for one in self.entries), default=1)

    def has(self, strategy: str, metric: str) -> bool:
        """Whether a metric was measured of a strategy in the one task that is there."""
        return any(metric in one.values for one in self.entries if one.strategy == strategy)

    def of_task(self, task: str) -> Records:
        """What belongs to one task."""
        return Records([entry for entry in self.entries if entry.task == task])

    def values(self, strategy: str, metric: str) -> Tensor:
        """A metric of a strategy in the one task that is there (P S …)."""
        pools: dict[str, list[Tensor]] = {}
        for entry in self.entries:
            if entry.strategy == strategy:
                pools.setdefault(entry.pool, []).append(entry.values[metric])
        return torch.stack([torch.stack(runs) for runs in pools.values()])

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """The rows of the table, see ``COLUMNS``."""
        for entry in self.entries:
            yield from entry.rows()


def entry_of(evaluation: Evaluation, curves: Iterable[str], seconds: str, **identity: Any) -> Entry:
    """What an evaluation measured, as an entry.

    Args:
        evaluation: of one strategy.
        curves: what is kept after each number of answers, beside the metrics that were asked for;
            of the others the last.
        seconds: the name of the metric that ``seconds_per_query`` is.
        identity: protocol, task, pool, seed and strategy.
    """
    values: dict[str, Tensor] = {}
    for name, value in (vars(evaluation) | evaluation.metrics).items():
        if isinstance(value, Tensor):
            last = value.ndim == 2 and name not in (*curves, *evaluation.examined)
            values[name] = (value[:, -1] if last else value).float().clone()
    if evaluation.batch > 1:
        values[AT_ONCE] = torch.tensor(float(evaluation.batch))
    values[seconds] = torch.tensor(evaluation.seconds_per_query)
    if "calibration" in evaluation.examined:
        bins = evaluation.examined["calibration"][:, -1].sum(0)
        values |= dict(zip(RELIABILITY, bins, strict=True))
    return Entry(values=values, **identity)


def write_records(folder: Path, records: Records) -> list[str]:
    """Write the table into a folder, and once more as Parquet where pyarrow is installed.

    Returns:
        The names of the files.
    """
    with (
        replacing(folder / CSV) as partial,
        partial.open("wb") as raw,
        # Without the time in the file, equal records are equal files.
        gzip.GzipFile("", "wb", 6, raw, mtime=0) as packed,
        io.TextIOWrapper(packed, encoding="utf-8", newline="") as text,
    ):
        writer = csv.writer(text)
        writer.writerow(COLUMNS)
        writer.writerows((*row[:-1], f"{row[-1]:.9g}") for row in records.rows())
    if importlib.util.find_spec("pyarrow") is None:
        return [CSV]
    _write_parquet(folder / PARQUET, records)
    return [CSV, PARQUET]


def _write_parquet(path: Path, records: Records) -> None:
    """The same table, with types."""
    import pyarrow
    import pyarrow.parquet

    types = {"human": "int32", "seed": "int64", "query": "int32", "value": "float32"}
    columns = zip(*records.rows(), strict=True)
    table = {
        name: pyarrow.array(column, types.get(name, "string"))
        for name, column in zip(COLUMNS, columns, strict=True)
    }
    with replacing(path) as partial:
        pyarrow.parquet.write_table(pyarrow.table(table), partial)


def read_records(path: str | Path) -> Records:
    """Read a table that :func:`write_records` wrote as CSV.

    Raises:
        InputError: it is no such table.
    """
    found: dict[tuple[str, ...], dict[str, dict[str, list[float]]]] = {}
    try:
        with gzip.open(path, "rt", newline="") as file:
            reader = csv.reader(file)
            if tuple(next(reader)) != COLUMNS:
                raise ValueError("other columns")
            for protocol, task, pool, human, seed, strategy, _, metric, value in reader:
                metrics = found.setdefault((protocol, task, pool, seed, strategy), {})
                by_human = metrics.setdefault(metric, {})
                by_human.setdefault(human, []).append(float(value))
        entries = [
            Entry(p, t, pool, int(seed), s, {m: _tensor(v) for m, v in metrics.items()})
            for (p, t, pool, seed, s), metrics in found.items()
        ]
    except (OSError, EOFError, ValueError, StopIteration, zlib.error, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read as a table of records ({error}); expected the {CSV} of an "
            "evaluation"
        ) from None
    return Records(entries)


def _tensor(by_human: Mapping[str, list[float]]) -> Tensor:
    """(B H+1), (B), (1 H+1) or (), from the numbers of each human; "" is all together."""
    values = torch.tensor(list(by_human.values()))
    if values.shape[1] > 1:
        return values
    return values[0, 0] if "" in by_human else values.squeeze(-1)
