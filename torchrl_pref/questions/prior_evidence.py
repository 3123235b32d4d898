"""What people showed before the first question: demonstrations and corrections.

Shapes: B people, G demonstrations and corrections of each, J alternatives, H answers, F factors of
an answer, D features, ``…`` any leading dimensions.

Each is a single softmax choice, evidence of the same form as an answer, with a tau of its own: a
demonstration was preferred to J other trajectories of the task (Fitzgerald et al., *INQUIRE*,
2022), and a corrected trajectory to the one that it replaced (Jeon, Milli and Dragan, 2020).

A belief knows one tau, that of the answers. A factor with another tau is the same factor with its
rows multiplied by the ratio of the two.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_pref.errors import InputError, check_positive
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Optimal
from torchrl_pref.tensors import check_finite, check_plain


@dataclass(frozen=True)
class Shown:
    """What was preferred to J others, of one person or of several.

    Attributes:
        rows: (… J D) float32, features of what was preferred less those of each of the others;
            without the gradients of what was given.
        tau: what their returns are multiplied by; None: as much as those of the answers.

    Raises:
        InputError: the rows are not (… J ≥ 1, D) finite numbers, or tau is not above 0.
    """

    rows: Tensor
    tau: float | None = None

    def __post_init__(self) -> None:
        check_tau(self.tau)
        if check_plain("rows", self.rows).ndim < 2 or 0 in self.rows.shape:
            raise InputError(f"rows of shape {tuple(self.rows.shape)}: expected (… J D)")
        object.__setattr__(self, "rows", self.rows.detach().float())
        check_finite("features of a demonstration or correction", self.rows)


class Given(TypedDict):
    """What people showed, as a session keeps it: G demonstrations and corrections each."""

    rows: Tensor
    """(B G J D), features of what was preferred less those of J others, times the tau of the
    demonstration over that of the answers."""
    offsets: Tensor
    """(B G J), 0; infinite where there is no row, or where the belief does not hold it."""


def demonstration(shown: Tensor, alternatives: Tensor, tau: float | None = None) -> Shown:
    """What a person showed as the way to do it, against J others that they could have shown.

    Args:
        shown: (… D), features of the trajectory that was shown, as in the pool.
        alternatives: (… J D), features of others, such as trajectories sampled from the task.
        tau: how carefully they showed it; larger is more careful. None: as they answer.

    Raises:
        InputError: the features do not belong together or are not finite, or tau is not above 0.
    """
    for name, features in (("shown", shown), ("alternatives", alternatives)):
        check_finite(name, check_plain(name, features))
    if alternatives.ndim < 2 or shown.shape != (*alternatives.shape[:-2], alternatives.shape[-1]):
        raise InputError(
            f"shown of shape {tuple(shown.shape)} and alternatives {tuple(alternatives.shape)}: "
            "expected (… D) and (… J D); a single alternative has J = 1"
        )
    if alternatives.shape[-2] == 0:
        raise InputError("alternatives of shape (… 0 D): expected at least one to be preferred to")
    return Shown(shown.float().unsqueeze(-2) - alternatives.float(), tau)


def correction(after: Tensor, before: Tensor, tau: float | None = None) -> Shown:
    """A trajectory that a person put in the place of another one.

    Args:
        after: (… D), features of the corrected trajectory, as in the pool.
        before: (… D), of the one that it replaced.
        tau: how carefully they corrected; None: as they answer.

    Raises:
        InputError: the features do not belong together or are not finite, or tau is not above 0.
    """
    if check_plain("before", before).ndim < 1:
        raise InputError("before of shape (): expected features (… D), as in the pool")
    return demonstration(after, before.unsqueeze(-2), tau)


def check_tau(tau: float | None) -> float | None:
    """Return ``tau`` if it is None or a number above 0.

    Raises:
        InputError: it is not.
    """
    return None if tau is None else check_positive("tau", tau)


def check_given(given: Any) -> tuple[Shown, ...]:
    """Return demonstrations and corrections of people.

    Raises:
        InputError: it is no list of them.
    """
    if not isinstance(given, list | tuple) or not all(isinstance(one, Shown) for one in given):
        raise InputError(
            f"given of type {type(given).__name__}: expected a list of what demonstration(…) and "
            "correction(…) make, as in given=[demonstration(…)]"
        )
    return tuple(given)


def rows_of_shown(
    shown: Sequence[Shown], size: int, n_features: int, model: ResponseModel
) -> Given:
    """Demonstrations and corrections of B people, as a session keeps them.

    Args:
        shown: G of them, each of one person, which then counts for all, or of B.
        size: B.
        n_features: D.
        model: how the belief thinks that they answer.

    Raises:
        InputError: features are not those of B people, or the model has no tau to compare with.
    """
    most = max(one.rows.shape[-2] for one in shown)
    rows, offsets = [], []
    for one in shown:
        n_rows = one.rows.shape[-2]
        try:
            own = one.rows.expand(size, n_rows, n_features)
        except RuntimeError:
            raise InputError(
                f"a demonstration or correction with rows {tuple(one.rows.shape)}: expected (… D) "
                f"features with D={n_features}, of one person or of each of {size}"
            ) from None
        rows.append(F.pad(ratio(one.tau, model) * own, (0, 0, 0, most - n_rows)))
        absent = (0, most - n_rows)
        offsets.append(F.pad(own.new_zeros(size, n_rows), absent, value=torch.inf))
    return {"rows": torch.stack(rows, 1), "offsets": torch.stack(offsets, 1)}


def given_digest(shown: Sequence[Shown]) -> str | None:
    """SHA-256 of demonstrations and corrections, in hexadecimal; None where there are none."""
    digest = hashlib.sha256()
    for one in shown:
        content = one.rows.contiguous().cpu().numpy()
        digest.update(repr((content.shape, str(content.dtype), one.tau)).encode())
        digest.update(content.tobytes())
    return digest.hexdigest() if shown else None


def ratio(tau: float | None, model: ResponseModel) -> float:
    """By what rows of another tau are multiplied, for a belief that knows the model's.

    Raises:
        InputError: the model never errs.
    """
    if tau is None:
        return 1.0
    if isinstance(model, Optimal):
        raise InputError(
            f"a demonstration or correction with tau={tau:g} and {model!r}, who never errs: "
            "expected no tau of its own; leave it out, or assume a Boltzmann human"
        )
    return tau / model.scale


def evidence_of(given: Given) -> Evidence:
    """The evidence (B G) of what a session keeps of demonstrations and corrections."""
    rows, offsets = given["rows"].unsqueeze(-3), given["offsets"].unsqueeze(-2)
    return Evidence(rows, offsets, torch.zeros_like(offsets[..., 0, 0]))


def joined(first: Evidence, second: Evidence) -> Evidence:
    """Evidence (B H) and then more (B H'), as one (B H+H')."""
    n_factors = max(first.offsets.shape[-2], second.offsets.shape[-2])
    n_rows = max(first.offsets.shape[-1], second.offsets.shape[-1])
    rows, offsets = [], []
    for one in (first, second):
        more = n_factors - one.offsets.shape[-2], n_rows - one.offsets.shape[-1]
        rows.append(F.pad(one.rows, (0, 0, 0, more[1], 0, more[0])))
        offsets.append(F.pad(one.offsets, (0, more[1], 0, more[0]), value=torch.inf))
    floor = torch.cat([first.floor, second.floor], -1)
    return Evidence(torch.cat(rows, 1), torch.cat(offsets, 1), floor)
