"""What ``--help`` says, made from the comments in ``conf``, where alone a key is explained.

A key is explained behind its value, and in lines below that start with the mark of a comment; a
file by the comment at its top, and what a group can choose by that of its ``name``.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from torchrl_pref.config.study import ONLY_SIMULATED

CONF = Path(__file__).parent / "conf"

WIDTH, COLUMN = 100, 28

LINE = re.compile(r"(?P<indent> *)(?P<key>\w+):(?P<value>[^#]*)(#\s*(?P<comment>.*))?$")


class Key(NamedTuple):
    """A key of a file, with dots where it is in a section, its default, and what it means."""

    name: str
    value: str
    comment: str


def help_text(script: str) -> str:
    """The help of a script, by its name without ``.py``."""
    own = CONF / f"{script}.yaml"
    keys = keys_of(own)
    said = {key.name for key in keys}  # here, or nowhere
    parts = [_top_comment(own), "Keys, with their defaults:"]
    if "  - common\n" in own.read_text():
        parts.append(_table([key for key in keys_of(CONF / "common.yaml") if key.name not in said]))
    parts.append(_table(keys))
    if script == "ask":
        said |= set(ONLY_SIMULATED)
    for group, default in _groups(own):
        parts.append(_group(group, default, script, said))
    parts.append(_table([Key("hydra.run.dir", "<folder>", "where the results go")]))
    return "\n\n".join(part for part in parts if part) + "\n"


def keys_of(path: Path) -> list[Key]:
    """The keys of a file that have a value, but for Hydra's own."""
    keys: list[Key] = []
    section = ""
    for line in path.read_text().splitlines():
        if re.fullmatch(r"\s+#.*", line) and keys:
            more = line.strip(" #")
            keys[-1] = keys[-1]._replace(comment=f"{keys[-1].comment} {more}")
        match = LINE.fullmatch(line)
        if match is None:
            continue
        if not match["indent"]:
            section = ""
        value = match["value"].strip()
        if not value:
            section = f"{match['key']}."
        elif section != "hydra." and len(match["indent"]) <= 2:
            keys.append(Key(section + match["key"], value, match["comment"] or ""))
    return keys


def _groups(path: Path) -> Iterator[tuple[str, str]]:
    """The groups that a file chooses from, each with its default."""
    yield from re.findall(r"^  - (\w+): (\w+)$", path.read_text(), re.M)


def _group(group: str, default: str, script: str, said: set[str]) -> str:
    """All that a group can choose, each with its keys but for those that are said elsewhere."""
    rows = []
    paths = sorted((CONF / group).glob("*.yaml"), key=lambda path: (path.stem != default, path))
    for path in paths:
        if group == "policy" and (path.stem == "pretrained") != (script == "evaluate"):
            continue  # train.py makes policies, evaluate.py knows ours and those of checkpoints
        keys = keys_of(path)
        if own := [key for key in keys if key.name.startswith(f"{group}.")]:  # and other sections'
            keys = [key._replace(name=key.name.removeprefix(f"{group}.")) for key in own]
        named = [key for key in keys if key.name == "name"]
        meaning = named[0].comment if named else " ".join(_top_comment(path).split())
        mark = " (default)" if path.stem == default else ""
        rows.append(_row(f"{group}={path.stem}", f"{meaning}{mark}"))
        inner = [key for key in keys if named and key.name != "name" and key.value != "???"]
        rows += [
            _row(f"  {group}.{key.name}={key.value}", key.comment)
            for key in inner
            if f"{group}.{key.name}" not in said
        ]
    return "\n".join(rows)


def _table(keys: list[Key]) -> str:
    return "\n".join(_row(f"{key.name}={key.value}", key.comment) for key in keys)


def _row(name: str, meaning: str) -> str:
    """A key, and beside it or below it what it means."""
    lines = textwrap.wrap(meaning, WIDTH - COLUMN - 2)
    first = f"  {name}".ljust(COLUMN)
    if len(first) > COLUMN:
        lines = ["", *lines]
    return "\n".join(
        [f"{first}  {lines[0] if lines else ''}".rstrip()]
        + [" " * (COLUMN + 2) + line for line in lines[1:]]
    )


def _top_comment(path: Path) -> str:
    """The comment at the top of a file, as it is written."""
    lines = []
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            lines.append(line[2:])
    return "\n".join(lines)
