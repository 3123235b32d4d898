"""``python -m torchrl_pref.tasks driver``: what the questions of a task look like."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from torchrl_pref.config.sections import CODE
from torchrl_pref.errors import InputError, check_count, check_seed, one_line_errors
from torchrl_pref.pool import QueryPool
from torchrl_pref.tasks import TASKS
from torchrl_pref.tasks.base import Task, make_pool
from torchrl_pref.tasks.drawing import save_animation
from torchrl_pref.tasks.sheet import contact_sheet
from torchrl_pref.typed_code import allow, load, load_typed, where


def main(arguments: list[str] | None = None) -> None:
    """Draw some random questions, and print the paths of the files."""
    typed = parser().parse_args(arguments)
    with one_line_errors():
        sheet = Path(typed.out or f"{typed.task.rpartition(':')[2]}.png")
        check_seed("--seed", typed.seed)
        check_count("--queries", typed.queries, 1)
        check_count("--options", typed.options, 2)
        task = task_of(typed.task, typed.settings)
        pool = pool_of(task, typed)
        contact_sheet(task, pool, sheet)
        print(sheet)
        if typed.animate:
            assert pool.trajectories is not None
            clip = sheet.with_suffix(".gif")
            save_animation([task.scene(option) for option in pool.trajectories[0]], clip)
            print(clip)


def pool_of(task: Task, typed: argparse.Namespace) -> QueryPool:
    """The queries of a sheet.

    Raises:
        InputError: the task has no such queries, or, where it is the user's, fails.
    """
    try:
        return make_pool(task, typed.queries, typed.options, typed.seed)
    except InputError as error:
        raise InputError(str(error).replace("pool.options=", "--options=")) from None
    except Exception as error:
        if typed.task in TASKS:
            raise
        raise InputError(
            f"{typed.task}: its first trajectories fail ({where(error)}); mend it, or its settings"
        ) from error


def parser() -> argparse.ArgumentParser:
    """What can be typed."""
    about = "Draw what random questions about a task look like: a sheet of them, and an animation."
    made = argparse.ArgumentParser(
        "python -m torchrl_pref.tasks",
        description=about,
        epilog=f"The tasks and their settings:\n{overview()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("task", help=f"one of {', '.join(TASKS)}; or yours, <module>:<name>")
    made.add_argument("settings", nargs="*", metavar="key=value", help="settings of the task")
    made.add_argument("--queries", type=int, default=6, help="questions on the sheet (6)")
    made.add_argument("--options", type=int, default=2, help="trajectories in a question (2)")
    made.add_argument("--seed", type=int, default=0, help="fixes the questions (0)")
    made.add_argument("--out", metavar="FILE", help="the sheet, PNG or SVG (<task>.png)")
    made.add_argument(
        "--animate", action="store_true", help="write the first question as a GIF as well"
    )
    return made


def overview() -> str:
    """A line or two for each task."""
    lines = []
    for name, make in TASKS.items():
        first = (inspect.getdoc(make) or "").partition("\n")[0]
        settings = inspect.signature(make).parameters.values()
        typed = " ".join(
            one.name if one.default is one.empty else f"{one.name}={json.dumps(one.default)}"
            for one in settings
        )
        lines += [f"  {name}  {typed}".rstrip(), f"      {first}"]
    return "\n".join(lines)


def task_of(name: str, settings: list[str]) -> Task:
    """A task of the table, or of the user's own.

    Args:
        name: in the table, or ``module:name``.
        settings: ``key=value``, each value a number, true, false, null or a text; or what names
            code of the user's, which may be imported, as it was typed.

    Raises:
        InputError: there is no such task or setting, or a value cannot be used.
    """
    own = ":" in name
    make = load(name, name) if own else TASKS.get(name)
    if make is None:
        known = ", ".join(TASKS)
        raise InputError(f"{name}: no task; expected one of {known}, or <module>:<name> of yours")
    values = values_of(name, tuple(inspect.signature(make).parameters), settings)
    for key in () if own else CODE["task"]:
        if values.get(key) is not None:
            allow(str(values[key]))
            values[key] = load_typed(key, values[key])
    try:
        inspect.signature(make).bind(**values)
    except TypeError as error:
        raise InputError(f"{name}: {error}; add it as key=value") from None
    try:
        task = make(**values)
    except Exception as error:
        if isinstance(error, InputError) or not own:
            raise
        raise InputError(f"{name}: fails ({where(error)}); mend it, or its settings") from error
    if not isinstance(task, Task):
        raise InputError(f"{name}: makes a {type(task).__name__}; expected a Task")
    return task


def values_of(name: str, keys: tuple[str, ...], settings: list[str]) -> dict[str, Any]:
    """The settings of a task, from ``key=value`` each.

    Raises:
        InputError: one is none of its ``keys``.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or key not in keys:
            known = ", ".join(f"{key}=…" for key in keys) or "none, as it has no settings"
            raise InputError(f"{setting}: no setting of {name}; expected {known}")
        try:
            values[key] = json.loads(text)
        except ValueError:
            values[key] = text
    return values


if __name__ == "__main__":
    main(sys.argv[1:])
