"""Tables of an evaluation, as text.

Shapes: P pools, S training seeds (of a baseline: runs), B humans of a pool, H query budget.
"""

from __future__ import annotations

from collections.abc import Callable

from tabulate import tabulate
from torch import Tensor

from torchrl_pref.evaluation.metrics import ALWAYS, METRICS
from torchrl_pref.evaluation.records import Records
from torchrl_pref.evaluation.style import (
    LEARNED,
    baseline_of,
    is_feed,
    is_judged,
    kind_of,
    name_of,
)
from torchrl_pref.evaluation.views import (
    alignment,
    answers_to_reach,
    comparisons,
    difference,
    mean_and_interval,
    measured,
    milestones,
)


def signed(mean: float, interval: tuple[float, float]) -> str:
    """A difference and its interval, as tables show them."""
    return "{:+.3f} [{:+.3f}, {:+.3f}]".format(mean, *interval)


def with_interval(differences: Tensor) -> str:
    """The mean of differences (P S B) and its 95% interval, as tables show them."""
    mean, low, high = mean_and_interval(differences)
    return signed(mean, (low, high))


def tables(records: Records) -> str:
    """All tables of an evaluation, and what is to be said of them."""
    parts = []
    for task in records.tasks:
        own = records.of_task(task)
        parts += [f"{title_of(task)}: alignment, {counts(own)}", "", alignment_table(own), ""]
        parts += [*feed_note(own), *batch_note(own)]
        if any(map(is_judged, own.strategies)):
            parts += ["differences on the same humans [95%]", "", difference_table(own), ""]
        parts += ["after the last query", "", detail_table(own), ""]
        parts += [*misjudging(records, task), *few_samples(own), *many_repeats(own)]
    return "\n".join(parts)


def title_of(task: str) -> str:
    """Of a task, for readers."""
    setup, _, rest = task.partition("/")
    if not rest:
        return task
    tau, features = rest.split("/")
    human = f"{tau} human" if tau in ("noisy", "optimal") else f"tau={tau} human"
    known = {"corners": "", "balanced": ", balanced features", "own": ", own pool"}
    return f"{setup}, {human}{known.get(features, f', {features}')}"


def counts(records: Records) -> str:
    """How many humans there were, and of which and of how many things the intervals are."""
    shapes = {key: alignment(records, key).shape for key in records.strategies}
    n_pools, _, n_humans, _ = next(iter(shapes.values()))
    if all(shape[:2] == (1, 1) for shape in shapes.values()):
        return f"{n_humans} humans"
    seeds = max((shape[1] for key, shape in shapes.items() if is_judged(key)), default=1)
    own = records.entries[0].task.endswith("/own")
    pools = (
        f"{n_pools} groups of {n_humans} humans" if own else f"{n_pools} pools of {n_humans} humans"
    )
    return (
        f"{pools}, {seeds} training seeds, intervals over {'groups' if own else 'pools'} and seeds"
    )


def alignment_table(records: Records, style: str = "simple") -> str:
    """The headline table: alignment, and the paired difference to what each strategy has to be
    better than, one strategy a row."""
    rows = []
    for key in records.strategies:
        values = alignment(records, key)
        last, each = values.shape[-1] - 1, records.batch
        interval = mean_and_interval(values[..., -1])[1:]
        row = {"strategy": name_of(key)}
        row |= {f"after {each * j}": f"{values[..., j].mean():.3f}" for j in milestones(last)}
        row[f"mean of {each} to {each * last}"] = f"{values[..., 1:].mean():.3f}"
        row[f"after {each * last} [95%]"] = "[{:.3f}, {:.3f}]".format(*interval)
        other = baseline_of(key, records.strategies)
        row["held against"] = "" if other is None else name_of(other)
        row["minus that [95%]"] = "" if other is None else _difference(records, key, other)
        rows.append(row)
    return tabulate(rows, headers="keys", tablefmt=style, disable_numparse=True)


def difference_table(records: Records, style: str = "simple") -> str:
    """Paired differences of policies and strategies of the user to all others, one a row."""
    each = records.batch
    budget = each * (alignment(records, records.strategies[0]).shape[-1] - 1)
    rows = []
    for key, other in comparisons(records):
        rows.append(
            {
                "strategy": name_of(key),
                "minus": name_of(other),
                f"after {budget}": _difference(records, key, other),
                f"mean of {each} to {budget}": _difference(records, key, other, on_the_way=True),
            }
        )
    return tabulate(rows, headers="keys", tablefmt=style, disable_numparse=True)


def detail_table(records: Records, style: str = "simple") -> str:
    """What else was measured, one strategy a row; the last column is a time."""
    keys = records.strategies
    reference = next((k for k in keys if kind_of(k) in REFERENCES), keys[0])
    curve = alignment(records, reference).mean((0, 1, 2))
    levels = [float(curve[j]) for j in milestones(len(curve) - 1)[-2:]]
    humans = {key: str(alignment(records, key)[:, 0, :, 0].numel()) for key in keys}
    rows = []
    for key in keys:
        row = {"strategy": name_of(key)}
        if len(set(humans.values())) > 1:
            row["humans"] = humans[key]
        for level in levels:
            row[f"reaches {level:.3f}"] = answers_to_reach(records, key, level)
        for metric, (header, show) in DETAILS.items():
            if metric in records.metrics:
                there = records.has(key, metric)
                row[header] = show(measured(records, key, metric)) if there else ""
        rows.append(row)
    return tabulate(rows, headers="keys", tablefmt=style, disable_numparse=True)


def misjudging(records: Records, task: str) -> list[str]:
    """What it costs that the belief takes the human for another."""
    reference = records.reference_of(task)
    if reference is None:
        return []
    own, right = records.of_task(task), records.of_task(reference)
    rows = []
    for key in own.strategies:
        row = {"strategy": name_of(key)}
        for metric in ALWAYS:
            mine, others = (measured(each, key, metric)[..., -1] for each in (own, right))
            head = METRICS[metric].head
            row[head] = f"{mine.mean():.3f}"
            row[f"{head}, minus rightly [95%]"] = with_interval(mine - others)
        if own.has(key, "calibration") and right.has(key, "calibration"):
            errors = (measured(each, key, "calibration")[..., -1].mean() for each in (own, right))
            row["calibration"], row["calibration, rightly"] = (f"{error:.3f}" for error in errors)
        rows.append(row)
    table = tabulate(rows, headers="keys", tablefmt="simple", disable_numparse=True)
    what = "what misjudging the human costs, after the last query; beside"
    return [f"{what} {title_of(reference)}", "", table, ""]


REFERENCES = ("greedy_information", "quantile_information")
"""Kinds whose alignment, half way and in the end, is the level that others are to reach."""


def _last(digits: int) -> Callable[[Tensor], str]:
    """The mean of the last values, of (P S B H+1) or (P S B)."""
    return lambda v: f"{(v[..., -1] if v.ndim == 4 else v).mean():.{digits}f}"


DETAILS: dict[str, tuple[str, Callable[[Tensor], str]]] = {
    **{name: (metric.head, _last(3)) for name, metric in METRICS.items()},
    "information": ("bits", _last(2)),
    "ess": ("ESS", lambda v: f"{(v[..., 1:] if v.ndim == 4 else v).mean():.0f}"),
    "asked": ("asked", _last(1)),
    "offered": ("offered", _last(1)),
    "repeated": ("repeated", _last(1)),
    "seconds_per_query": ("ms an ask", lambda v: f"{1000 * v.mean():.2f}"),
    "seconds_to_choose": ("ms to choose", lambda v: f"{1000 * v.mean():.2f}"),
}
"""By metric: the head of its column, and the cell, from its values."""


def feed_note(records: Records) -> list[str]:
    """Which strategies decide on offers, where others choose from the whole pool."""
    keys = records.strategies
    feed = [name_of(key) for key in keys if is_feed(key, keys)]
    if not feed or len(feed) == len(keys):
        return []
    verb = "decides" if len(feed) == 1 else "decide"
    return [f"{', '.join(feed)} {verb} on the offers of a feed; the others have the whole pool", ""]


def batch_note(records: Records) -> list[str]:
    """What a number of answers means where queries are asked several at once."""
    if records.batch == 1:
        return []
    return [f"queries are asked in batches of {records.batch}: numbers are of after each", ""]


def few_samples(records: Records) -> list[str]:
    """A line for each strategy whose belief has at times been worth under half of its samples."""
    lines = []
    for key in records.strategies if "ess" in records.metrics else ():
        ess = records.values(key, "ess")
        if ess.ndim < 4:
            continue
        ess = ess.flatten(0, 2)
        least = (ess / ess[:, :1]).amin(1)  # of the prior's, which are independent
        if (least < 0.5).any():
            count, worst = int((least < 0.5).sum()), ess[int(least.argmin())]
            lines.append(
                f"! {name_of(key)}: in {count} of {len(least)} sessions the belief was "
                f"worth under half of its samples (least: {worst.min():.0f} of {worst[0]:.0f}); "
                "raise belief.samples, or trust these rows less"
            )
    return [*lines, ""] if lines else []


def many_repeats(records: Records) -> list[str]:
    """A line for each policy, and strategy of the user, that repeats most of its questions."""
    lines = []
    for key in filter(is_judged, records.strategies):
        asked, repeated = (
            records.values(key, metric).mean((0, 1)) for metric in ("asked", "repeated")
        )
        if repeated.sum() > asked.sum() / 2:
            mend = "; drawn actions repeat less: train it with policy.sample=true"
            lines.append(
                f"! {name_of(key)}: {repeated.mean():.1f} of {asked.mean():.1f} questions had been "
                f"asked before{mend if kind_of(key) in LEARNED else ''}"
            )
    return [*lines, ""] if lines else []


def _difference(records: Records, key: str, other: str, on_the_way: bool = False) -> str:
    """Of alignments after the last query or, on the way, of their means over all queries."""
    gap = difference(records, key, other)
    return with_interval(gap[..., 1:].mean(-1) if on_the_way else gap[..., -1])
