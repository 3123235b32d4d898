"""What a run leaves for the sweep that it may be a job of, and the sweep's one table.

A job that has finished leaves ``summary.json`` in its folder, one that was refused or failed leaves
``failed.json``, one that is at work or was interrupted neither.
"""

from __future__ import annotations

import csv
import json
import math
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_pref.errors import InputError, one_line
from torchrl_pref.storage.writing import replacing, write_text

if TYPE_CHECKING:
    from torchrl_pref.evaluation.records import Records

SUMMARY, FAILED, TABLE = "summary.json", "failed.json", "summary.csv"

Row = dict[str, Any]


def write_summary(folder: Path, overrides: Sequence[str], records: Records, key: str) -> float:
    """Write the keys typed and the policy's final numbers: the last file of a run.

    Args:
        folder: of the run.
        overrides: the keys=values that were typed.
        records: of its evaluation; the first task is what counts.
        key: of the policy.

    Returns:
        :func:`final_alignment`.
    """
    from torchrl_pref.evaluation.views import milestones

    own = records.of_task(records.tasks[0])
    curve = own.values(key, "alignment").mean((0, 1, 2))
    numbers = {
        f"alignment after {j}": round(float(curve[j]), 4) for j in milestones(len(curve) - 1)
    }
    numbers["bits"] = round(float(own.values(key, "information")[..., -1].mean()), 3)
    numbers["asked"] = round(float(own.values(key, "asked").mean()), 2)
    content = {"overrides": list(overrides), **numbers}
    write_text(folder / SUMMARY, json.dumps(content, indent=1) + "\n")
    return final_alignment(folder)


def final_alignment(folder: Path) -> float:
    """Alignment after the last query in a folder's summary."""
    content = json.loads((folder / SUMMARY).read_text())
    return [value for name, value in content.items() if name.startswith("alignment after")][-1]


def attempt(
    sweep: Path, folder: Path, overrides: Sequence[str], work: Callable[[], float]
) -> float:
    """Do a job of a sweep; what fails is recorded and said, and is no reason for others to stop.

    Args:
        sweep, folder: of the sweep and of the job.
        overrides: the job's keys=values.
        work: does it.

    Returns:
        What the work returns, or NaN where it failed.
    """
    try:
        value = work()
        (folder / FAILED).unlink(missing_ok=True)
    except Exception as error:
        reason = one_line(error)
        if not isinstance(error, (InputError, OSError)):  # a defect of ours
            traceback.print_exc()
            reason = f"{type(error).__name__}: {reason}"
        content = {"overrides": list(overrides), "failed": reason}
        write_text(folder / FAILED, json.dumps(content, indent=1) + "\n")
        print(f"error: job {folder.relative_to(sweep)}: {reason}", file=sys.stderr)
        value = math.nan
    write_table(sweep)
    return value


def write_table(sweep: Path) -> list[Row]:
    """Write ``summary.csv``, a row for each job that has finished or failed; returns the rows."""
    folders = {path.parent for name in (SUMMARY, FAILED) for path in sweep.rglob(name)}
    found = [_row(sweep, folder) for folder in sorted(folders, key=_in_order)]
    names = list(dict.fromkeys(["job", *(name for row in found for name in row)]))
    names.sort(key=lambda name: name == "failed")  # the reasons last
    rows = [{name: row.get(name, "") for name in names} for row in found]
    with replacing(sweep / TABLE) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return rows


def show_table(sweep: Path, rows: Sequence[Row]) -> None:
    """Print the rows of a sweep."""
    from tabulate import tabulate

    widths = [60 if name == "failed" else None for name in rows[0]] if rows else None
    table = tabulate(rows, headers="keys", maxcolwidths=widths)
    print(f"\nsweep, {sweep / TABLE}\n{table}")


def _row(sweep: Path, folder: Path) -> Row:
    """What a job's folder says of it. A failure is of the last attempt, and counts."""
    try:
        text = (folder / FAILED).read_text()
    except FileNotFoundError:
        text = (folder / SUMMARY).read_text()
    content = json.loads(text)
    pairs = (override.partition("=") for override in content.pop("overrides"))
    return {"job": str(folder.relative_to(sweep)), **{k: v for k, _, v in pairs}, **content}


def _in_order(folder: Path) -> list[str]:
    """A sorting key by which job 10 comes after job 9."""
    return [part.zfill(9) if part.isdigit() else part for part in re.split(r"(\d+)", str(folder))]
