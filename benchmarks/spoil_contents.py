"""Checkpoints and pools that are whole files with impossible content: see ``spoil.py``."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks.spoil import Case, of_content

Edit = Callable[[dict[str, Any]], Any]

WRONG: dict[type, tuple[Any, ...]] = {
    bool: ("maybe", None, 2, [True]),
    int: ("many", 2.5, -3, [], {}, math.nan, True, torch.ones(2)),
    float: ("much", None, math.nan, -math.inf, [], torch.ones(2)),
    str: (5, [], {}, "no such word", b"bytes"),
    type(None): ([], {"a": 1}, torch.ones(2)),
    list: ("csv", None, 5, [5], {}, torch.ones(2)),
}
"""What cannot stand where a value of this type does."""


def spoiled_settings(content: dict[str, Any]) -> Iterator[Case]:
    """A key of the settings taken away, or with a value that cannot be."""
    settings = content["settings"]
    places = [(key,) for key in settings if key != "overrides"]
    places += [
        (section, key)
        for section, values in settings.items()
        if isinstance(values, dict)
        for key in values
    ]
    for place in places:
        value = at(settings, place)

        def remove(content: dict[str, Any], place: tuple[str, ...] = place) -> None:
            del at(content["settings"], place[:-1])[place[-1]]

        name = ".".join(place)
        yield edited(content, "spoiled settings", f"without {name}", remove)
        for wrong in (5, "text", None, []) if isinstance(value, dict) else WRONG[type(value)]:

            def replace(
                content: dict[str, Any], place: tuple[str, ...] = place, wrong: Any = wrong
            ) -> None:
                at(content["settings"], place[:-1])[place[-1]] = wrong

            yield edited(content, "spoiled settings", f"{name}={str(wrong)[:20]}", replace)


def spoiled_content(content: dict[str, Any]) -> Iterator[Case]:
    """A checkpoint in which something is missing, of another type, size, or impossible."""
    for key in content:
        yield edited(content, "spoiled content", f"without {key}", lambda c, k=key: c.pop(k))
        for wrong in ("text", 5, [], {"a": torch.ones(2)}, torch.tensor(math.nan)):
            name = f"{key}={str(wrong)[:20]}"
            yield edited(
                content, "spoiled content", name, lambda c, k=key, w=wrong: c.update({k: w})
            )
    for key in content["training"]:
        yield edited(content, "spoiled content", f"no {key}", lambda c, k=key: c["training"].pop(k))
        for wrong in ("text", -1, [1], {"a": "b"}, torch.ones(3), b"bytes"):
            name = f"training.{key}={str(wrong)[:20]}"
            yield edited(
                content,
                "spoiled content",
                name,
                lambda c, k=key, w=wrong: c["training"].update({k: w}),
            )
    for name, edit in EDITS.items():
        yield edited(content, "spoiled content", name, edit)


def edited(content: dict[str, Any], group: str, name: str, edit: Edit) -> Case:
    """A checkpoint with something changed."""
    changed = copy.deepcopy(content)
    edit(changed)
    return Case(group, name, "checkpoint", of_content(changed))


def at(tree: dict[str, Any], place: tuple[str, ...]) -> Any:
    """What a nested dict has at a place."""
    for key in place:
        tree = tree[key]
    return tree


def put(*place: Any) -> Edit:
    """Set the value at a place: its last element."""

    def edit(content: dict[str, Any]) -> None:
        at(content, place[:-2])[place[-2]] = place[-1]

    return edit


def fill(value: float, *place: str) -> Edit:
    """Set one number of the first tensor at a place."""

    def edit(content: dict[str, Any]) -> None:
        first = at(content, place)
        while isinstance(first, dict):
            first = next(iter(first.values()))
        first.view(-1)[0] = value

    return edit


def cut(*place: str) -> Edit:
    """Take the last row of a tensor."""

    def edit(content: dict[str, Any]) -> None:
        holder = at(content, place[:-1])
        holder[place[-1]] = holder[place[-1]][:-1].clone()

    return edit


def _swap_weights(content: dict[str, Any]) -> None:
    first, second, *_ = [name for name, w in content["weights"].items() if w.ndim]
    weights = content["weights"]
    weights[first], weights[second] = weights[second], weights[first]


def _steps(content: dict[str, Any]) -> dict[str, Any]:
    return next(iter(content["training"]["optimizer"]["state"].values()))


SESSIONS = ("training", "sessions")

KEPT = (*SESSIONS, "session")

EDITS: dict[str, Edit] = {
    "format 3": put("format", 3),
    "format 10^300": put("format", 10**300),
    "one field more": put("more", 1),
    "a weight NaN": fill(math.nan, "weights"),
    "a weight infinite": fill(math.inf, "weights"),
    "a trained weight NaN": fill(math.nan, "training", "weights"),
    "a weight missing": lambda c: c["weights"].popitem(),
    "a weight too many": put("weights", "more", torch.ones(2)),
    "a weight named 5": put("weights", 5, torch.ones(2)),
    "weights exchanged": _swap_weights,
    "weights of float64": lambda c: c["weights"].update(
        {name: w.double() for name, w in c["weights"].items()}
    ),
    "weights expanded": lambda c: c["weights"].update(
        {name: torch.zeros(1).expand(10**6, 10**6) for name in c["weights"]}
    ),
    "mean NaN": fill(math.nan, "mean"),
    "std 0": fill(0, "std"),
    "std -1": fill(-1, "std"),
    "std of another D": cut("std"),
    "tau NaN": put("tau", math.nan),
    "tau of another human": put("tau", 9.5),
    "tau -1": put("tau", -1.0),
    "D = 5": put("pool_shape", "D", 5),
    "N = 0": put("pool_shape", "N", 0),
    "no K": lambda c: c["pool_shape"].pop("K"),
    "a digest of another pool": put("train_digest", "0" * 64),
    "a digest in capitals": put("test_digest", "A" * 64),
    "update 10^9": put("training", "update", 10**9),
    "a curve too long": lambda c: c["training"]["history"]["train/reward"].append(0.5),
    "a curve of texts": put("training", "history", "train/reward", ["a"]),
    "no curve of rewards": lambda c: c["training"]["history"].pop("train/reward"),
    "a curve named as a path": lambda c: c["training"]["history"].update(
        {"../../../outside": c["training"]["history"]["train/reward"]}
    ),
    "optimizer of other weights": lambda c: c["training"]["optimizer"]["state"].update(
        {99: _steps(c)}
    ),
    "optimizer of other sizes": lambda c: _steps(c).update({"exp_avg": torch.ones(3, 3, 3)}),
    "optimizer without moments": lambda c: _steps(c).pop("exp_avg"),
    "optimizer with NaN": lambda c: _steps(c).update({"step": torch.tensor(math.nan)}),
    "optimizer with a text": lambda c: _steps(c).update({"step": "three"}),
    "sessions: answers out of range": fill(2, *KEPT, "history", "answers"),
    "sessions: queries out of range": fill(10**6, *KEPT, "history", "index"),
    "sessions: asked 10^6": fill(10**6, *KEPT, "n_asked"),
    "sessions: offers out of range": fill(-1, *SESSIONS, "offers"),
    "sessions: omega NaN": fill(math.nan, *SESSIONS, "human", "omega"),
    "sessions: samples off the sphere": fill(9, *KEPT, "samples"),
    "sessions: one human less": cut(*KEPT, "samples"),
    "sessions: no humans": lambda c: c["training"]["sessions"].pop("human"),
    "sessions: humans a text": put(*SESSIONS, "human", "someone"),
    "sessions: samples complex": put(*KEPT, "samples", torch.ones(2, dtype=torch.complex64)),
    "sessions: samples expanded": put(*KEPT, "samples", torch.ones(1).expand(10**5, 10**5, 10**2)),
    "random state cut": cut("training", "env_generator"),
    "random state of zeros": put("training", "global_generator", torch.zeros(5056).byte()),
    "random state of noise": put(
        "training", "global_generator", torch.arange(5056).remainder(251).byte()
    ),
}


def spoiled_pools() -> Iterator[Case]:
    """Whole pool files of impossible features or trajectories."""
    good = torch.rand(6, 2, 3)
    walks = torch.zeros(6, 2, 5)
    nan, infinite, large = good.clone(), good.clone(), good.double()
    nan[3, 1, 2], infinite[0, 0, 0], large[1, 1, 1] = math.nan, -math.inf, 1e300
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch no longer likes to make them
        quantised = torch.quantize_per_tensor(good, 0.1, 0, torch.qint8)
    features: dict[str, Any] = {
        "none": None,
        "a list": good.tolist(),
        "a text": "features",
        "NaN": nan,
        "infinity": infinite,
        "beyond float32": large,
        "0 in float32": large * 1e-320,
        "complex": good.to(torch.complex64),
        "sparse": good.to_sparse(),
        "quantised": quantised,
        "of no query": good[:0],
        "of no options": good[:, :0],
        "of one feature": good[..., :1].clone(),
        "of two sizes": good[0].clone(),
        "expanded": torch.rand(1, 2, 3).expand(10**12, 2, 3),
        "a module": torch.nn.Linear(2, 2),
    }
    for name, value in features.items():
        content = {"kind": "query pool", "features": value, "trajectories": None}
        yield Case("spoiled content", f"features {name}", "pool", of_content(content))
    shown: dict[str, Any] = {
        "a list": [1],
        "a text": "walk",
        "of other queries": walks[:5].clone(),
        "of one size": torch.zeros(6),
        "sparse": walks.to_sparse(),
        "complex": walks.to(torch.complex64),
        "expanded": torch.zeros(1).expand(6, 2, 10**11),
    }
    for name, value in shown.items():
        content = {"kind": "query pool", "features": good, "trajectories": value}
        yield Case("spoiled content", f"trajectories {name}", "pool", of_content(content))
