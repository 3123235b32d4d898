"""What must be in a checkpoint, so that whoever reads it later finds what they look for.

Structure only: that each section is there, with its keys, and holds plain values of the right type.
Whether a number makes sense is checked where it is used.
"""

from __future__ import annotations

import math
import re
from typing import Any

import torch
from torch import Tensor

from torchrl_pref.checkpoints.migrations import ADDED_CURVES, TRAINING
from torchrl_pref.errors import InputError
from torchrl_pref.groups import TABLES, keys_of
from torchrl_pref.storage.files import is_dense

WHOLE, NUMBER, TEXT, FLAG = (int,), (int, float), (str,), (bool,)
NONE = (type(None),)

Types = tuple[type, ...]

TOP: dict[str, Types] = {
    "tau": NUMBER + TEXT,
    "objective": TEXT,
    "skip": TEXT,
    "device": TEXT,
    "threads": WHOLE,
    "seed": WHOLE,
}

LISTS = ("overrides", "logger")
"""Settings that are lists of texts."""

SECTIONS: dict[str, dict[str, Types]] = {
    "task": {"name": TEXT},
    "question": {"name": TEXT},
    "human": {"name": TEXT, "tau": NUMBER + TEXT + NONE, "lapse": NUMBER},
    "demonstrations": {"count": WHOLE, "alternatives": WHOLE, "tau": NUMBER + NONE},
    "pool": {
        **dict.fromkeys(("size", "options", "seed"), WHOLE),
        **dict.fromkeys(("train", "test"), TEXT + NONE),
    },
    "belief": {"name": TEXT, "lapse": NUMBER},
    "policy": {"name": TEXT, "sample": FLAG},
    "evaluation": {"humans": WHOLE, "seed": WHOLE, "during": WHOLE, "metrics": (list,)},
    "training": {
        **dict.fromkeys(("updates", "sessions", "critic_steps", "warm_up", "save_every"), WHOLE),
        **dict.fromkeys(("stages", "processes"), WHOLE),
        **dict.fromkeys(("learning_rate", "gamma", "lmbda", "entropy", "critic"), NUMBER),
        **dict.fromkeys(("grad_norm", "average"), NUMBER),
        "steps": WHOLE + NONE,
        **dict.fromkeys(("optimizer", "problems"), TEXT),
    },
}

SETUPS: dict[str, dict[str, Types]] = {
    "query": {"budget": WHOLE, "candidates": WHOLE + NONE, "repeats": FLAG, "batch": WHOLE},
    "feed": {"budget": WHOLE, "offers": WHOLE + NONE, "on_skip": TEXT},
}

ALGORITHMS: dict[str, dict[str, Types]] = {
    "a2c": {},
    "ppo": {"clip_epsilon": NUMBER, "epochs": WHOLE, "minibatches": WHOLE},
}

CURVES = (
    "train/alignment",
    "train/episode_length",
    "train/reward",
    "train/explained_variance",
    *ADDED_CURVES,
    "time/frames_per_second",
)
"""What is measured of each update; a history may have more."""

KNOWN = ("update", "history", "held_out", "baseline")
"""How a training went, of every policy."""


def check_content(content: dict[str, Any]) -> None:
    """Refuse a checkpoint in which something is missing or of another type.

    Args:
        content: the fields of a ``Checkpoint``.

    Raises:
        InputError: says what came and what was expected; the caller adds the file.
    """
    _check_settings(content["settings"])
    shape = content["pool_shape"]
    _check_types("pool_shape", shape, dict.fromkeys("NKD", WHOLE))
    _expect(shape["N"] >= 1 and shape["K"] >= 1 and shape["D"] >= 2, "pool_shape", "real sizes")
    tau = content["tau"]
    fits = type(tau) in NUMBER and math.isfinite(tau) and tau > 0
    _expect(tau is None or fits, "tau", "None or a finite number above 0")
    for name in ("mean", "std"):
        value = content[name]
        fits = _is_weight(value) and tuple(value.shape) == (shape["D"],)
        _expect(fits, name, f"{shape['D']} finite numbers")
    _expect(bool((content["std"] > 0).all()), "std", "numbers above 0")
    for name in ("train_digest", "test_digest"):
        value = content[name]
        fits = type(value) is str and re.fullmatch("[0-9a-f]{64}", value) is not None
        _expect(fits, name, "a SHA-256 in hexadecimal")
    check_weights("weights", content["weights"])
    _check_training(content["training"])


def check_weights(name: str, weights: Any) -> None:
    """Refuse what is not a dict of names to finite float32 tensors.

    Raises:
        InputError: it is not.
    """
    _expect(isinstance(weights, dict), name, "a dict of tensors")
    for key, value in weights.items():
        fits = type(key) is str and _is_weight(value)
        _expect(
            fits,
            name,
            f"float32 tensors without NaN or infinity, and {key!r:.60} is none (a training that "
            "diverged leaves NaN: lower training.learning_rate)",
        )


def _check_settings(settings: Any) -> None:
    _expect(isinstance(settings, dict), "settings", "a dict")
    named = {"setup": SETUPS, "algorithm": ALGORITHMS}
    for section, known in named.items():
        value = settings.get(section)
        name = value.get("name") if isinstance(value, dict) else None
        name = name if type(name) is str else ""
        _expect(name in known, f"settings.{section}.name", f"one of {', '.join(known)}")
        _check_types(f"settings.{section}", value, known[name])
    for section, keys in SECTIONS.items():
        _check_types(f"settings.{section}", settings.get(section), keys)
    for group in TABLES:
        for key in keys_of(group, settings[group]["name"]):
            _expect(key in settings[group], f"settings.{group}.{key}", "a value")
    _check_types("settings", settings, TOP, (*SECTIONS, *named, *LISTS))
    lists = {name: settings.get(name) for name in LISTS}
    lists["evaluation.metrics"] = settings["evaluation"]["metrics"]
    for name, texts in lists.items():
        fits = type(texts) is list and all(type(text) is str for text in texts)
        _expect(fits, f"settings.{name}", "a list of texts")


def _check_types(
    name: str, section: Any, keys: dict[str, Types], others: tuple[str, ...] = ()
) -> None:
    """A section has these keys with values of these types; what else it has is plain."""
    _expect(isinstance(section, dict), name, "a section of keys")
    for key, types in keys.items():
        words = " or ".join("null" if kind is NONE[0] else kind.__name__ for kind in types)
        _expect(type(section.get(key, ...)) in types, f"{name}.{key}", words)
    for key, value in section.items():
        members = value if type(value) is list else [value]
        plain = all(type(one) in NUMBER + TEXT + FLAG + NONE for one in members) or key in others
        _expect(type(key) is str and plain, f"{name}.{key!s:.60}", "a plain value")


def _check_training(training: Any) -> None:
    _expect(isinstance(training, dict), "training", "a dict")
    history = training.get("history")
    fits = isinstance(history, dict) and all(name in history for name in CURVES)
    _expect(fits, "training.history", f"a dict of lists, {', '.join(CURVES)} among them")
    for name, values in history.items():
        fits = type(name) is str and re.fullmatch("[a-z]+/[a-z_]+", name) is not None
        fits = fits and type(values) is list
        fits = fits and all(type(value) in NUMBER for value in values)
        _expect(fits, "training.history", "lists of numbers")
    lengths = {len(values) for values in history.values()}
    _expect(len(lengths) <= 1, "training.history", "lists of one length")
    for name in KNOWN:
        _expect(name in training, f"training.{name}", "how the training went")
    update = training["update"]
    _expect(type(update) is int and lengths == {update}, "training.update", "the history's length")
    _check_held_out(training["held_out"], training["baseline"])
    if set(training) == set(KNOWN):
        return
    for name in TRAINING:
        _expect(name in training, f"training.{name}", "the state of the training")
    check_weights("training.weights", training["weights"])
    optimizer = training["optimizer"]
    fits = isinstance(optimizer, dict) and isinstance(optimizer.get("state"), dict)
    _expect(fits, "training.optimizer", "the state of an optimizer")
    _expect(isinstance(training["sessions"], dict), "training.sessions", "a dict of tensors")
    for name in ("env_generator", "global_generator"):
        value = training[name]
        fits = is_dense(value) and value.dtype == torch.uint8 and value.ndim == 1
        _expect(fits, f"training.{name}", "a tensor of bytes")


def _check_held_out(held_out: Any, baseline: Any) -> None:
    """What is known of held-out humans: one number for each, by update and of a baseline."""
    fits = isinstance(held_out, dict) and all(
        type(update) is int and update >= 0 and _is_weight(values) and values.ndim == 1
        for update, values in held_out.items()
    )
    _expect(fits, "training.held_out", "by update, a number for each held-out human")
    fits = type(baseline) is tuple and len(baseline) == 2 and type(baseline[0]) is str
    fits = fits and _is_weight(baseline[1]) and baseline[1].ndim == 1
    _expect(baseline is None or fits, "training.baseline", "a name, and a number for each human")


def _is_weight(value: Any) -> bool:
    fits = is_dense(value) and isinstance(value, Tensor) and value.dtype == torch.float32
    return fits and bool(value.isfinite().all())


def _expect(fits: bool, name: str, expected: str) -> None:
    if not fits:
        raise InputError(f"{name} is missing or spoiled: expected {expected}")
