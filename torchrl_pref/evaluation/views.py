"""Numbers that tables and figures show, as views of the records of one task.

Shapes: P pools, S training seeds (of a baseline: runs), B humans of a pool, J batches of answers,
which are H answers where queries are asked one at a time.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from torchrl_pref.evaluation.metrics import BINS, PARTS
from torchrl_pref.evaluation.records import RELIABILITY, Records
from torchrl_pref.evaluation.statistics import bootstrap_interval
from torchrl_pref.evaluation.style import baseline_of, is_feed, is_judged, name_of
from torchrl_pref.storage.writing import replacing

FEWEST = 100
"""Answers in a bin, for its mean to be shown: of fewer it says more of these humans than of the
belief."""


def milestones(last: int) -> list[int]:
    """The columns of a curve that tables report: 5, 10 and 20 of 20, in proportion otherwise."""
    return sorted({max(1, round(last * share)) for share in (0.25, 0.5, 1.0)})


def measured(records: Records, key: str, metric: str) -> Tensor:
    """A metric of a strategy after each batch of answers (P S B J+1), most often of one each; or
    of sessions (P S B), or of all together (P S)."""
    values = records.values(key, metric)
    return values[..., :: records.batch] if values.ndim == 4 else values


def alignment(records: Records, key: str) -> Tensor:
    """Of a strategy, after each batch of answers (P S B J+1)."""
    return measured(records, key, "alignment")


def reliability(records: Records, key: str) -> tuple[Tensor, Tensor]:
    """Of a strategy's beliefs after the last answer, over all pools and seeds: the mean probability
    that was predicted of the answers in each bin, and how likely the humans give them; of bins
    with ``FEWEST`` answers at least (G' each)."""
    parts = torch.stack([records.values(key, name).sum() for name in RELIABILITY])
    answers, predicted, given = parts.unflatten(0, (len(PARTS), BINS))
    enough = answers >= FEWEST
    return predicted[enough] / answers[enough], given[enough] / answers[enough]


def difference(records: Records, key: str, other: str) -> Tensor:
    """Alignment less another's on the same humans, less the mean of its runs (P S B J+1)."""
    own, others = alignment(records, key), alignment(records, other)
    # Where one of them met fewer humans, these are the first of the other's.
    count = min(own.shape[2], others.shape[2])
    return own[:, :, :count] - others[:, :, :count].mean(1, keepdim=True)


def units(values: Tensor) -> Tensor:
    """What intervals are over, from values (P S B): humans (B) where one strategy met them once on
    one pool, else pools and seeds (P S), whose humans are not independent. What is told of all
    humans together (P S 1) varies between pools and seeds alone."""
    return values[0, 0] if values.shape[:2] == (1, 1) else values.mean(2)


def mean_and_interval(values: Tensor) -> tuple[float, float, float]:
    """Of values (P S B): the mean, and the ends of its 95% interval, NaN of one thing alone."""
    over = units(values)
    ends = bootstrap_interval(over) if over.numel() > 1 else (math.nan, math.nan)
    return float(values.mean()), *ends


def curve(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (J+1) and interval (J+1 2) of values (P S B J+1)."""
    points = torch.tensor([mean_and_interval(column) for column in values.unbind(-1)])
    return points[:, 0], points[:, 1:]


def comparisons(records: Records) -> Iterator[tuple[str, str]]:
    """Each strategy that is to be judged, beside every other of its setup: its own baseline first,
    and of two that are judged the later beside the earlier."""
    keys = records.strategies
    for place, key in enumerate(keys):
        if not is_judged(key):
            continue
        baseline, feed = baseline_of(key, keys), is_feed(key, keys)
        same = [other for other in keys if is_feed(other, keys) == feed]
        after = [other for other in keys[place:] if is_judged(other)]
        others = [other for other in same if other not in (baseline, *after)]
        yield from ((key, other) for other in (baseline, *others) if other is not None)


def answers_to_reach(records: Records, key: str, level: float) -> str:
    """The fewest answers after which a strategy's mean alignment is at least a level."""
    enough = (alignment(records, key).mean((0, 1, 2)) >= level).nonzero()
    return str(int(enough[0]) * records.batch) if len(enough) else "never"


def write_curves(path: Path, records: Records) -> None:
    """Write every curve as CSV: task, strategy as tables name it, query, metric, mean and 95%
    interval."""
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "strategy", "query", "metric", "mean", "low", "high"])
        for task in records.tasks:
            own = records.of_task(task)
            for key in own.strategies:
                for metric in (name for name in own.metrics if own.has(key, name)):
                    values = measured(own, key, metric)
                    if values.ndim < 4:
                        continue
                    for place, column in enumerate(values.unbind(-1)):
                        found = mean_and_interval(column)
                        numbers = ("" if math.isnan(one) else f"{one:.5f}" for one in found)
                        writer.writerow([task, name_of(key), place * own.batch, metric, *numbers])
