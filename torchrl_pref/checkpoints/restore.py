"""From what a checkpoint holds into the objects of a run, once it is known to fit them.

Shapes: B sessions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor, nn

from torchrl_pref.envs.state import check_state
from torchrl_pref.errors import InputError
from torchrl_pref.storage.files import is_dense
from torchrl_pref.tensors import check_plain

MOMENTS = {
    torch.optim.Adam: {"step", "exp_avg", "exp_avg_sq"},
    torch.optim.RMSprop: {"step", "square_avg"},
}
"""What an optimizer keeps of each weight that has taken a step."""


def restore_weights(module: nn.Module, weights: Mapping[str, Any]) -> None:
    """Load weights into a module.

    Raises:
        InputError: they are those of another one.
    """
    own = module.state_dict()
    for name in [*own, *weights]:
        mine, found = (
            tuple(some[name].shape) if name in some else "none" for some in (own, weights)
        )
        if mine != found:
            raise InputError(
                f"the checkpoint's weights do not fit this run: {name} of shape {found}, expected "
                f"{mine}; use the settings that the policy was trained with"
            )
    module.load_state_dict(weights)


def restore_optimizer(optimizer: torch.optim.Optimizer, steps: Mapping[Any, Any]) -> None:
    """Load what an optimizer knew of each weight; its constants stay those of the settings.

    Raises:
        InputError: it is of other weights, or of another optimizer.
    """
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for place, moments in steps.items():
        fits = type(place) is int and 0 <= place < len(weights) and isinstance(moments, dict)
        if not fits or set(moments) != MOMENTS[type(optimizer)]:
            raise _spoiled("optimizer")
        for name, value in moments.items():
            shape = torch.Size() if name == "step" else weights[place].shape
            if not is_dense(value) or value.dtype != torch.float32 or value.shape != shape:
                raise _spoiled("optimizer")
            if not value.isfinite().all():
                raise _spoiled("optimizer")
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": dict(steps), "param_groups": groups})


def restore_sessions(
    carrier: TensorDictBase,
    sessions: dict[str, Any],
    state: TensorDictBase,
    n_queries: int,
    n_answers: int,
) -> None:
    """Put saved sessions (B) into a tensordict.

    Args:
        carrier: where they go, of fresh sessions.
        sessions: as saved.
        state: the part of the carrier that is the environment's state.
        n_queries: N, of the environment's pool.
        n_answers: R, of its question.

    Raises:
        InputError: they are of other sizes, or impossible.
    """
    known: dict[Any, Tensor] = {}
    for key, expected in carrier.items(True, True):
        value: Any = sessions
        for part in (key,) if isinstance(key, str) else key:
            value = value.get(part) if isinstance(value, dict) else None
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            raise _spoiled("sessions")
        if value.shape != expected.shape or value.dtype != expected.dtype:
            raise _spoiled("sessions")
        known[key] = value
    saved = TensorDict(known, carrier.batch_size)
    try:
        check_state(saved, state, n_queries, n_answers)
    except InputError as error:
        raise InputError(f"{_spoiled('sessions')} ({error})") from None
    carrier.update(saved.to(carrier.device))


def restore_generator(generator: Generator, state: Tensor) -> None:
    """Set a generator to a saved state.

    Raises:
        InputError: the state is not one of its kind.
    """
    try:
        check_plain("state", state)
        generator.set_state(state)
    except (RuntimeError, TypeError, ValueError):
        raise InputError(
            f"the checkpoint's random state does not fit a generator on {generator.device}: "
            "expected that of the device it was trained on; resume on that device"
        ) from None


def _spoiled(part: str) -> InputError:
    return InputError(
        f"the checkpoint's training state ({part}) does not fit its settings: expected what this "
        "run saved; restore a copy of the file, or start a new run from its weights by checkpoint="
    )
