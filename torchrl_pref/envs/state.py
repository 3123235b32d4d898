"""The state of sessions that someone hands to an environment: humans, or sessions half-way.

Shapes: B sessions, M belief samples, N queries in the pool, C candidates, K options per query, D
features, H query budget, O offers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from torchrl_pref.envs.transition import LEFT_OUT, NOT_OF_THE_POOL, OPEN, History, Tree
from torchrl_pref.errors import InputError
from torchrl_pref.tensors import check_finite, check_plain, check_range, check_shape, lengths

Key = str | tuple[str, ...]

MEANING = {
    "human.omega": "sessions and features",
    "human.noise": "sessions, asks (the budget) and answers",
    "human.care": "sessions and one factor",
    "human.walk": "sessions, questions and features",
    "session.samples": "sessions, samples of the belief and features",
    "session.mean": "sessions and features",
    "session.given.rows": "sessions, demonstrations, alternatives and features",
    "session.given.offsets": "sessions, demonstrations and alternatives",
    "session.history.options": "sessions, asks (the budget), options and features",
    "session.history.answers": "sessions and asks (the budget)",
    "session.history.index": "sessions and asks (the budget)",
    "offers": "sessions and offers",
    "candidates": "sessions and candidates",
}
"""What the sizes of each part of the state are; of the others they are sessions and one number."""

NUMBERS = (("human", "number"), ("session", "number"))
"""What an environment makes anew for itself."""

HISTORY: tuple[Key, ...] = tuple(("session", "history", key) for key in History.__annotations__)


def check_state(
    given: TensorDictBase, fresh: TensorDictBase, n_queries: int, n_answers: int
) -> TensorDict:
    """What a tensordict holds of the state of sessions, in the types of a fresh state.

    Args:
        given: some or all keys of the state, and any others, which are left out.
        fresh: a whole state of the environment, for its shapes.
        n_queries: N.
        n_answers: R.

    Returns:
        The keys of ``fresh`` that were given.

    Raises:
        InputError: a shape, a type or a number is impossible, or the parts contradict each other.
    """
    state: dict[Key, Tensor] = {}
    parts = dict(given.items(True, True))
    for key, expected in fresh.items(True, True):
        if key in parts and key not in NUMBERS:
            state[key] = _check_part(_name(key), parts[key], expected)
    if not state:
        raise InputError(
            f"set_state=True with none of {', '.join(map(_name, fresh.keys(True, True)))}: "
            "expected at least one; give humans as env.reset() returns them, or set_state=False"
        )
    _check_ranges(state, fresh, n_queries, n_answers)
    _check_vectors(state, fresh["session", "samples"])
    _check_history(state)
    if ("session", "given", "rows") in fresh.keys(True):
        _check_given(state)
    return TensorDict(state, fresh.batch_size, device=fresh.device)


def _check_ranges(
    state: dict[Key, Tensor], fresh: TensorDictBase, n_queries: int, n_answers: int
) -> None:
    """Indices point at something, and counts are within the session."""
    n_asks = fresh["session", "history", "answers"].shape[1]
    n_offers = 0 if fresh.get("offers", None) is None else fresh["offers"].shape[1]
    limits: dict[Key, tuple[int, int, str]] = {
        ("session", "history", "index"): (
            -1,
            n_queries - 1,
            "indices of the pool, -1 for no query",
        ),
        ("session", "history", "answers"): (LEFT_OUT, n_answers - 1, "the answer or a mark"),
        "candidates": (0, n_queries - 1, "indices of the pool"),
        "offers": (0, n_queries - 1, "indices of the pool"),
        ("session", "n_asked"): (0, n_asks, "queries asked so far"),
        ("session", "n_offered"): (0, n_offers, "queries offered so far"),
    }
    for key, limit in limits.items():
        if key in state:
            check_range(_name(key), state[key], *limit)


def _name(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)


def _check_part(name: str, value: Tensor, expected: Tensor) -> Tensor:
    """One part of the state, in the type and on the device of a fresh one."""
    check_plain(name, value)
    meaning = MEANING.get(name, "as a fresh session has it")
    check_shape(
        name,
        value,
        tuple(expected.shape),
        f"which is {meaning}; take it from an environment of the same sizes",
    )
    if value.is_floating_point() != expected.is_floating_point():
        raise InputError(
            f"{name} of dtype {value.dtype}: expected {expected.dtype}; convert it, as by "
            f".to({expected.dtype})"
        )
    value = value.detach().to(expected)
    if value.is_floating_point():
        may_be_infinite = name == "session.given.offsets"
        check_finite(name, value[value != torch.inf] if may_be_infinite else value)
    return value


def _check_vectors(state: dict[Key, Tensor], fresh: Tensor) -> None:
    """Samples have a direction, and lie on the unit sphere where the belief's own (B M D) do; a
    human has a direction."""
    samples, omega = state.get(("session", "samples")), state.get(("human", "omega"))
    if samples is not None and (samples == 0).all(-1).any():
        raise InputError("samples of length 0: expected directions; give weights above zero")
    unit = bool((lengths(fresh) == 1).all())
    if unit and samples is not None and ((lengths(samples) - 1).abs() > 0.01).any():
        raise InputError(
            "samples that are not of length 1: expected points of the unit sphere, as tau carries "
            "the scale; divide them by their length, as by torch.nn.functional.normalize"
        )
    if omega is not None and (omega == 0).all(-1).any():
        raise InputError("human.omega of length 0: expected a direction; give weights above zero")
    if (state.get(("human", "care"), torch.ones(1)) <= 0).any():
        raise InputError("human.care of 0 or less: expected a factor above 0; 1 is the model's tau")


def _check_given(state: dict[Key, Tensor]) -> None:
    """Whoever showed something comes with it, and with the belief that it led to."""
    together: tuple[Key, ...] = (
        ("human", "omega"),
        ("session", "samples"),
        ("session", "given", "rows"),
        ("session", "given", "offsets"),
    )
    missing = [key for key in together if key not in state]
    if 0 < len(missing) < len(together):
        raise InputError(
            f"humans who show something before the first question, without "
            f"{', '.join(map(_name, missing))}: expected all of "
            f"{', '.join(map(_name, together))}; give them as env.reset() returns them"
        )


def _check_history(state: dict[Key, Tensor]) -> None:
    """The asked queries are the first ``n_asked``, and the belief knows of their answers."""
    given = [state.get(key) for key in (*HISTORY, ("session", "n_asked"))]
    options, answers, index, n_asked = given
    if all(part is None for part in given):
        return
    if options is None or answers is None or index is None or n_asked is None:
        raise InputError(
            "a history in part: expected session.history (options, answers, index) and "
            "session.n_asked together; give all of them, or none for sessions that begin"
        )
    asked = answers != OPEN
    first = torch.arange(answers.shape[1], device=answers.device) < n_asked
    if (asked != first).any() or ((index != NOT_OF_THE_POOL) & ~asked).any():
        raise InputError(
            "session.history and session.n_asked contradict each other: expected answers (-2 where "
            "refused, -3 where left out) to the first n_asked queries, and -1 after them"
        )
    if asked.any() and ("session", "samples") not in state:
        raise InputError(
            "a history of answers without the samples of the belief that they led to: expected "
            "both; give session.samples too, or leave the history out"
        )


def overwrite(tree: Tree, given: Mapping[str, Any]) -> None:
    """Take the tensors that are given in the place of a tree's own."""
    for key in tree.keys() & given.keys():
        if isinstance(tree[key], dict):
            overwrite(tree[key], given[key])
        else:
            tree[key] = given[key]


def spec_of(state: TensorDictBase) -> Composite:
    """Unbounded specs of the shapes and types in a state."""
    spec = Composite(shape=state.batch_size, device=state.device)
    for key, value in state.items(include_nested=True, leaves_only=True):
        if value.dtype == torch.bool:
            spec[key] = Binary(n=value.shape[-1], shape=value.shape, dtype=torch.bool)
        else:
            spec[key] = Unbounded(shape=value.shape, dtype=value.dtype)
    return spec.to(state.device)
