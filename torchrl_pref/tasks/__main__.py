"""``python -m torchrl_pref.tasks driver``: what the questions of a task look like."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from torchrl_pref.errors import InputError, check_choice, check_count, check_seed, one_line_errors
from torchrl_pref.tasks import TASKS
from torchrl_pref.tasks.base import Task, make_pool
from torchrl_pref.tasks.drawing import save_animation
from torchrl_pref.tasks.sheet import contact_sheet


def main(arguments: list[str] | None = None) -> None:
    """Draw some random questions, and print the paths of the files."""
    typed = parser().parse_args(arguments)
    with one_line_errors():
        sheet = Path(typed.out or f"{typed.task}.png")
        check_seed("--seed", typed.seed)
        check_count("--queries", typed.queries, 1)
        check_count("--options", typed.options, 2)
        task = task_of(typed.task, typed.settings)
        pool = make_pool(task, typed.queries, typed.options, typed.seed)
        contact_sheet(task, pool, sheet)
        print(sheet)
        if typed.animate:
            assert pool.trajectories is not None
            clip = sheet.with_suffix(".gif")
            save_animation([task.scene(option) for option in pool.trajectories[0]], clip)
            print(clip)


def parser() -> argparse.ArgumentParser:
    """What can be typed."""
    about = "Draw what random questions about a task look like: a sheet of them, and an animation."
    made = argparse.ArgumentParser(
        "python -m torchrl_pref.tasks",
        description=about,
        epilog=f"The tasks and their settings:\n{overview()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("task", help=f"one of {', '.join(TASKS)}")
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
    """A task of the table.

    Args:
        name: its name.
        settings: ``key=value``, each value a number, true, false, null or a text.

    Raises:
        InputError: there is no such task or setting, or a value cannot be used.
    """
    make = TASKS[check_choice("task", name, tuple(TASKS))]
    keys = tuple(inspect.signature(make).parameters)
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
    try:
        inspect.signature(make).bind(**values)
    except TypeError as error:
        raise InputError(f"{name}: {error}; add it as key=value") from None
    return make(**values)


if __name__ == "__main__":
    main(sys.argv[1:])
