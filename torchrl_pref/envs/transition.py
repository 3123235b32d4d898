"""One answer: from what is known of a session before it to what is known after.

Shapes: B sessions, M belief samples, K options per query, D features, H query budget.

:func:`tell` is what an environment's step, a live person and a replayed log have in common. It
writes to nothing that it is given, and all its luck comes from the generator.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, NotRequired, TypeAlias, TypedDict, cast

import torch
from torch import Generator, Tensor

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.errors import InputError
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.questions.prior_evidence import Given, evidence_of, joined
from torchrl_pref.tensors import check_range, directions

OPEN, LEFT_OUT = -1, -3
"""Marks in a history in the place of an answer, beside ``REFUSED``: not asked yet; answered, but
against what they had answered before, so that the belief does not hold it."""

NOT_OF_THE_POOL = -1
"""The pool index of a query that is of no pool, and of one that is not asked yet."""

Tree: TypeAlias = dict[str, Any]
"""Tensors (B …) by name, and such dictionaries."""


class History(TypedDict):
    """What was asked and answered, oldest first."""

    options: Tensor
    """(B H K D), features of the options; 0 where not asked yet."""
    answers: Tensor
    """(B H), the chosen option, or one of the marks ``OPEN``, ``REFUSED`` and ``LEFT_OUT``."""
    index: Tensor
    """(B H), index of the query in its pool, or ``NOT_OF_THE_POOL``."""


class SessionState(TypedDict):
    """What is known of sessions; it holds nothing of the human but their answers."""

    samples: Tensor
    """(B M D), the belief."""
    mean: Tensor
    """(B D), the mean direction of the samples."""
    ess: Tensor
    """(B 1), effective sample size of the belief."""
    information: Tensor
    """(B 1), sum of the information gains of the answered queries, in bits."""
    n_asked: Tensor
    """(B 1), queries asked so far."""
    history: History
    given: NotRequired[Given]
    """Where people showed something before the first question."""
    n_offered: NotRequired[Tensor]
    """(B 1), queries offered so far, where they are offered."""
    number: NotRequired[Tensor]
    """(B 1), tells a session of an environment from another."""


class Outcome(NamedTuple):
    """What came of an action."""

    session: SessionState
    """What is known after it."""
    reward: Tensor
    """(B 1)."""
    terminated: Tensor
    """(B 1) bool, whether nothing is to come after it."""
    truncated: Tensor
    """(B 1) bool, whether it was cut off where more would have come."""


def begin(samples: Tensor, budget: int, n_options: int) -> SessionState:
    """Sessions in which nothing was asked yet.

    Args:
        samples: (B M D), of the prior.
        budget: H.
        n_options: K.
    """
    size, n_samples, n_features = samples.shape
    zero = samples.new_zeros(size, 1)
    open_slots = torch.full((size, budget), OPEN, device=samples.device)
    return {
        "samples": samples,
        "mean": directions(samples).mean(1),
        "ess": zero + n_samples,
        "information": zero,
        "n_asked": zero.long(),
        "history": {
            "options": samples.new_zeros(size, budget, n_options, n_features),
            "answers": open_slots,
            "index": torch.full_like(open_slots, NOT_OF_THE_POOL),
        },
    }


def hear(
    belief: BeliefBase, session: SessionState, given: Given, generator: Generator
) -> SessionState:
    """Sessions that begin, after what people showed before the first question.

    Args:
        belief: how evidence becomes a belief.
        session: as :func:`begin` makes it.
        given: what they showed; of what contradicts the rest the belief holds nothing.
        generator: the source of the belief's luck.
    """
    samples, ess = session["samples"], session["ess"].squeeze(-1)
    offsets = given["offsets"].clone()
    for g in range(offsets.shape[1]):
        evidence = evidence_of({"rows": given["rows"], "offsets": offsets})
        samples, ess, used = belief.update(samples, ess, evidence[:, : g + 1], generator)
        offsets[:, g] = offsets[:, g].masked_fill(~used.unsqueeze(-1), torch.inf)
    heard: Given = {"rows": given["rows"], "offsets": offsets}
    known = {
        "samples": samples,
        "mean": directions(samples).mean(1),
        "ess": ess.unsqueeze(-1),
        "given": heard,
    }
    return cast(SessionState, {**session, **known})


def tell(
    belief: BeliefBase,
    session: SessionState,
    options: Tensor,
    answers: Tensor,
    index: Tensor,
    generator: Generator,
) -> SessionState:
    """The sessions after one more answer each.

    Args:
        belief: how answers become a belief.
        session: before it; its ``n_offered`` and ``number`` stay as they are.
        options: (B K D), features of the options that were shown.
        answers: (B), the chosen option, or ``REFUSED``, which counts as asked and teaches nothing.
        index: (B), index of the query in its pool, or ``NOT_OF_THE_POOL``.
        generator: the source of the belief's luck.

    Raises:
        InputError: a session is full, or an answer is no option and not ``REFUSED``.
    """
    budget, taken = session["history"]["answers"].shape[1], int(session["n_asked"].max())
    if taken >= budget:
        raise InputError(
            f"an answer after the last of {budget}: expected a session with a question left; begin "
            "another, or one with a larger budget"
        )
    last = belief.response_model.n_answers(options.shape[-2]) - 1
    answers = check_range("answers", answers, REFUSED, last, "-2 where refused")
    after: Tree = dict(session)
    heard = (answers >= 0).nonzero().squeeze(-1)
    if len(heard) == len(answers):
        marks = _learn(belief, after, options, answers, generator)
    else:
        if (answers == OPEN).any():
            raise InputError("answers of -1: expected an option from 0, or -2 where it was refused")
        part = rows(session, heard)
        marks = answers.clone()
        if len(heard):
            marks[heard] = _learn(belief, part, options[heard], answers[heard], generator)
            put(after, part, heard)
    after["history"] = _written(session, options, marks, index)
    after["n_asked"] = session["n_asked"] + 1
    return cast(SessionState, after)


def _learn(
    belief: BeliefBase, session: Tree, options: Tensor, answers: Tensor, generator: Generator
) -> Tensor:
    """Put what answers (B) teach into sessions; gives the answers, marked where left out."""
    samples, history = session["samples"], session["history"]
    # On the CPU only as many turns as were taken are worth the work.
    taken = int(session["n_asked"].max())
    past, given = history["options"][:, :taken], history["answers"][:, :taken]
    # To the belief an answer that it does not hold is as good as none.
    given, query = given.clamp(min=OPEN), options.unsqueeze(1)
    model = belief.response_model
    evidence = model.evidence(torch.cat([past, query], 1), torch.cat([given, answers[:, None]], 1))
    if "given" in session:
        evidence = joined(evidence_of(session["given"]), evidence)
    update = belief.update(samples, session["ess"].squeeze(-1), evidence, generator)
    gain = score_queries(samples, query, model, information_gain)
    session["samples"], session["mean"] = update.samples, directions(update.samples).mean(1)
    session["ess"] = update.ess.unsqueeze(-1)
    session["information"] = session["information"] + gain
    return torch.where(update.used, answers, LEFT_OUT)


def _written(session: SessionState, options: Tensor, marks: Tensor, index: Tensor) -> History:
    """The history with one more query, at the place of each session's turn."""
    history, turn = session["history"], session["n_asked"]
    place = torch.arange(history["answers"].shape[1], device=turn.device) == turn
    return {
        "options": torch.where(place[..., None, None], options.unsqueeze(1), history["options"]),
        "answers": torch.where(place, marks.unsqueeze(-1), history["answers"]),
        "index": torch.where(place, index.unsqueeze(-1), history["index"]),
    }


def rows(tree: Mapping[str, Any], who: Tensor) -> Tree:
    """The sessions ``who`` of tensors (B …) by name."""
    return {
        key: rows(value, who) if isinstance(value, Mapping) else value[who]
        for key, value in tree.items()
    }


def put(tree: Tree, changed: Mapping[str, Any], who: Tensor) -> None:
    """Put what changed in sessions ``who`` into tensors (B …) by name; none is overwritten."""
    for key, new in changed.items():
        if isinstance(new, Mapping):
            tree[key] = dict(tree[key])
            put(tree[key], new, who)
        else:
            tree[key] = tree[key].index_copy(0, who, new)
