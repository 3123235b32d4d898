"""Checkpoints of earlier formats, brought up to date when they are read.

A format is raised whenever a key of the settings or of the checkpoint changes its meaning or name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Content = dict[str, Any]


def migrate(content: Content, version: int) -> Content:
    """What a checkpoint of a version holds, as the present one would say it.

    Args:
        content: of the file; where it is not what the version wrote, it stays as it is, to be
            refused by whoever checks it.
        version: one of ``MIGRATIONS``.
    """
    settings = content.get("settings")
    if isinstance(settings, dict):
        migrated = dict(settings)
        for step in sorted(MIGRATIONS):
            if step >= version:
                MIGRATIONS[step](migrated)
        return {**content, "settings": migrated}
    return content


def _groups(settings: Content) -> None:
    """From 4 to 5: the task, the question, the human and the belief are chosen by name."""
    if "grid" in settings:
        grid = settings.pop("grid")
        settings["task"] = {"name": "gridworld", **(grid if isinstance(grid, dict) else {})}
    spread = settings.pop("tau_spread", 1)
    settings.setdefault("human", {"name": "simulated", "spread": spread, "lapse": 0.0})
    settings.setdefault("question", {"name": "choice"})
    if isinstance(settings.get("belief"), dict):
        settings["belief"] = {"name": "sampled", "lapse": 0.0, **settings["belief"]}


MIGRATIONS: dict[int, Callable[[Content], None]] = {4: _groups}
"""By the format that it takes settings from, what makes them those of the next."""
