"""What files of earlier versions lack, added where they are read: the one place that knows of it.

Each function takes what may be of any version, or spoiled, and changes it in place. What it cannot
make sense of it leaves to the checks that follow. Applied twice, it does what it does once.
"""

from __future__ import annotations

import math
from typing import Any

ADDED_CURVES = (
    "train/actor_loss",
    "train/critic_loss",
    "train/entropy",
    "train/gradient_norm",
    "train/learning_rate",
    "train/share_asked",
)
"""Measured of each update since format 5."""

TRAINING = ("weights", "optimizer", "sessions", "env_generator", "global_generator")
"""What training goes on from; a policy that is only used has none of it."""


def migrate(settings: Any) -> None:
    """Add the keys that settings of earlier versions lack, with what these versions did.

    Args:
        settings: of a checkpoint, or of a run's ``config.yaml``.
    """
    if not isinstance(settings, dict):
        return
    # Version 0.1.0 evaluated nothing while it trained, and up to format 6 alignment alone was
    # measured; up to format 4 there was A2C alone.
    if isinstance(settings.get("evaluation"), dict):
        settings["evaluation"].setdefault("during", 0)
        settings["evaluation"].setdefault("metrics", [])
    settings.setdefault("algorithm", {"name": "a2c"})
    # Up to format 4 there was one task, one question, one kind of human and one of belief.
    if "grid" in settings:
        grid = settings.pop("grid")
        settings["task"] = {"name": "gridworld", **(grid if isinstance(grid, dict) else {})}
    spread = settings.pop("tau_spread", 1)
    settings.setdefault("human", {"name": "simulated", "spread": spread, "lapse": 0.0})
    # Up to format 5 the human's tau was the belief's, and nobody showed anything first.
    if isinstance(settings["human"], dict):
        settings["human"].setdefault("tau", None)
    settings.setdefault("demonstrations", {"count": 0, "alternatives": 10, "tau": None})
    # There were no batches.
    if isinstance(settings.get("setup"), dict) and settings["setup"].get("name") == "query":
        settings["setup"].setdefault("batch", 1)
    # Up to format 7 a training was about one problem, up to format 8 sessions began together, and
    # up to format 9 one process asked them.
    if isinstance(settings.get("training"), dict):
        settings["training"].setdefault("problems", "one")
        settings["training"].setdefault("stages", 1)
        settings["training"].setdefault("processes", 1)
    settings.setdefault("question", {"name": "choice"})
    if isinstance(settings.get("belief"), dict):
        settings["belief"] = {"name": "sampled", "lapse": 0.0, **settings["belief"]}
    settings.setdefault("logger", ["csv", "tensorboard"])


def migrate_training(training: Any) -> None:
    """Add what the ``training`` of earlier checkpoints lacks; what was not measured is NaN."""
    if not isinstance(training, dict) or not isinstance(training.get("history"), dict):
        return
    history = training["history"]
    rewards = history.get("train/reward")
    if not isinstance(rewards, list):
        return
    for name in ADDED_CURVES:
        history.setdefault(name, [math.nan] * len(rewards))
    # Sessions of before format 5 cannot go on: their history does not hold the options.
    if isinstance(training.get("sessions"), dict) and "session" not in training["sessions"]:
        for name in TRAINING:
            training.pop(name, None)
    # Policies of version 0.1.0 were saved without these.
    training.setdefault("update", len(rewards))
    training.setdefault("held_out", {})
    training.setdefault("baseline", None)
