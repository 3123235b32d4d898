"""Tables and figures of the docs that benchmarks leave, and what all tables of the docs share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

from tabulate import tabulate

DOCS = Path(__file__).resolve().parents[1] / "docs"

GALLERY = ("gridworld", "driver", "lds", "gymnasium")
"""Tasks that are shown in motion."""

Rows = list[dict[str, str]]

Writer = Callable[[Path], dict[str, str]]
"""From a part's folder to its tables by the name of their marks; makes its figures."""


def table(rows: Rows) -> str:
    """As Markdown."""
    return tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True)


def measured(choose: Callable[[Any], Any] = list) -> Writer:
    """The tables that benchmarks left as JSON, each by its name, or what ``choose`` makes of their
    rows; their figures as they are."""

    def write(folder: Path) -> dict[str, str]:
        for path in folder.glob("*.png"):
            shutil.copy(path, DOCS)
        tables = {}
        for path in sorted(folder.glob("*.json")):
            found = json.loads(path.read_text())
            rows = [{k: cell(value) for k, value in row.items()} for row in choose(found["rows"])]
            tables[path.stem] = f"{found['title']}; {found['machine']}.\n\n{table(rows)}"
        return tables

    return write


def after_twenty(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What ``belief.py`` measured after 20 answers."""
    return [row for row in rows if row["answers"] == 20]


def ends(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each size that ``scale.py`` varied: from where to where, and how it is there."""
    shown, least = [], {}
    for row in rows:
        varied = row["call"], row["varied"]
        least.setdefault(varied, row[row["varied"]])
        if row["slope"] is not None:  # the last of them
            kept = {key: row[key] for key in ("call", "varied")}
            kept |= {"from": least[varied], "to": row[row["varied"]]}
            kept["slope at the upper end"] = row["slope"]
            shown.append({**kept, **{key: row[key] for key in ("CPU s", "call MiB", "in all MiB")}})
    return shown


def inferred(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What ``rationality.py`` measured, with three decimals each, and some of the intervals."""
    shown = [key for key in rows[0] if "%" not in key or key in ("50%", "80%", "90%", "95%")]
    return [
        {key: _share(row[key]) if key == "factor" else _decimals(row.get(key, "")) for key in shown}
        for row in rows
    ]


def _share(value: Any) -> str:
    return value if isinstance(value, str) else str(Fraction(value))


def _decimals(value: Any) -> Any:
    return f"{value:.3f}" if isinstance(value, float) else value


def harmed(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What became of bad files: all that should not have been in one column."""
    good = ("files", "tried", "refused", "harmless")
    return [
        {
            **{key: row[key] for key in good},
            "anything else": sum(count for key, count in row.items() if key not in good),
        }
        for row in rows
    ]


def cell(value: Any) -> str:
    """Three digits of a number, and all of a whole one."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str("" if value is None else value)


def gallery(folder: Path) -> dict[str, str]:
    """The pictures of the gallery."""
    (DOCS / "gallery").mkdir(exist_ok=True)
    for path in chain(folder.glob("*.png"), folder.glob("*.gif")):
        shutil.copy(path, DOCS / "gallery")
    return {}


def pictures(folder: Path) -> dict[str, str]:
    """The page of a study on a desktop and a phone."""
    shutil.copytree(folder / "page", DOCS / "study", dirs_exist_ok=True)
    return {}
