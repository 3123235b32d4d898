"""One answer is one pure step, whoever gives it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import make
from torch import Generator, Tensor

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import (
    LEFT_OUT,
    NOT_OF_THE_POOL,
    OPEN,
    REFUSED,
    SessionState,
    begin,
    tell,
)
from torchrl_pref.errors import InputError
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.responses import Optimal

BELIEF = Belief(RESPONSE_MODELS[0], 20, 2)


def fresh(belief: Belief = BELIEF, size: int = 3, budget: int = 4) -> SessionState:
    return begin(belief.prior(size, 4, Generator().manual_seed(1)), budget, 2)


def told(
    session: SessionState, answers: list[int], seed: int = 2, belief: Belief = BELIEF
) -> SessionState:
    """After an answer each to a made-up query."""
    options = torch.randn(len(answers), 2, 4, generator=Generator().manual_seed(3))
    index = torch.full((len(answers),), NOT_OF_THE_POOL)
    generator = Generator().manual_seed(seed)
    return tell(belief, session, options, torch.tensor(answers), index, generator)


def leaves(session: Any) -> dict[str, Tensor]:
    flat = {key: value for key, value in session.items() if key != "history"}
    return {**flat, **session["history"]}


def test_it_is_pure_and_its_luck_is_the_generators() -> None:
    before = fresh()
    copy = {key: value.clone() for key, value in leaves(before).items()}
    first, again, other = (told(before, [0, 1, 1], seed) for seed in (2, 2, 9))
    assert all(torch.equal(value, copy[key]) for key, value in leaves(before).items())
    assert all(torch.equal(value, leaves(again)[key]) for key, value in leaves(first).items())
    assert not torch.equal(first["samples"], other["samples"])
    assert torch.equal(first["mean"], first["samples"].mean(1))
    assert (first["information"] > 0).all()


def test_the_history_holds_options_answers_and_where_they_come_from() -> None:
    session = told(told(fresh(), [0, 1, 1]), [1, 1, 0])
    options = torch.randn(3, 2, 4, generator=Generator().manual_seed(3))
    history = session["history"]
    assert history["answers"][:, :2].tolist() == [[0, 1], [1, 1], [1, 0]]
    assert (history["answers"][:, 2:] == OPEN).all()
    assert torch.equal(history["options"][:, :2], options.unsqueeze(1).expand(3, 2, 2, 4))
    assert (history["options"][:, 2:] == 0).all()
    assert (history["index"] == NOT_OF_THE_POOL).all()
    assert (session["n_asked"] == 2).all()


def test_who_refuses_was_asked_and_teaches_nothing() -> None:
    before = fresh()
    after = told(before, [0, REFUSED, 1])
    alone = tell(
        BELIEF,
        fresh(),
        torch.randn(3, 2, 4, generator=Generator().manual_seed(3)),
        torch.full((3,), REFUSED),
        torch.arange(3),
        Generator().manual_seed(2),
    )
    for key in ("samples", "mean", "ess", "information"):
        assert torch.equal(after[key][1], before[key][1])  # type: ignore[literal-required]
        assert not torch.equal(after[key][0], before[key][0]) or key == "ess"  # type: ignore[literal-required]
        assert torch.equal(alone[key], before[key])  # type: ignore[literal-required]
    assert after["history"]["answers"][:, 0].tolist() == [0, REFUSED, 1]
    assert (after["n_asked"] == 1).all()
    assert alone["history"]["index"][:, 0].tolist() == [0, 1, 2]
    # A refusal in the past is to the belief as if it had not been asked.
    assert told(alone, [0, 1, 1])["samples"].isfinite().all()


def test_a_contradiction_is_left_out_and_is_no_refusal_and_not_open() -> None:
    belief = Belief(Optimal(), 20, 2)
    session = told(fresh(belief), [0, 0, 0], belief=belief)
    after = told(session, [1, 0, 1], belief=belief)
    assert after["history"]["answers"][:, 1].tolist() == [LEFT_OUT, 0, LEFT_OUT]
    assert torch.equal(after["samples"][0], session["samples"][0])
    assert len({OPEN, REFUSED, LEFT_OUT}) == 3


@pytest.mark.parametrize("answers", [[0, OPEN, 1], [0, LEFT_OUT, 1], [0, 2, 1]])
def test_other_marks_are_no_answers(answers: list[int]) -> None:
    with pytest.raises(InputError, match="answers"):
        told(fresh(), answers)


def test_a_full_session_takes_no_answer() -> None:
    session = fresh(budget=1)
    with pytest.raises(InputError, match="an answer after the last of 1"):
        told(told(session, [0, 1, 1]), [0, 1, 1])


def test_a_replayed_log_ends_where_the_environment_did(pool: QueryPool) -> None:
    """The same answers, with the same luck, by ``tell`` alone."""
    env = make(QueryEnv, pool, batch=1)
    session = env.reset()
    generator, belief = Generator(), env.belief
    generator.set_state(env.generator.get_state())
    replayed: SessionState = begin(session["session", "samples"], 5, 2)
    for action in (7, 2, 9):
        session = env.step_mdp(env.step(session.set("action", torch.tensor([action]))))
    history = session["session", "history"]
    for turn in range(3):
        options, answers, index = (history[key][:, turn] for key in ("options", "answers", "index"))
        replayed = tell(belief, replayed, options, answers, index, generator)
    for key, value in leaves(replayed).items():
        assert torch.equal(value, leaves(session["session"])[key]), key
