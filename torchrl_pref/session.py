"""Ask and tell: questions for live people, without an environment of your own.

Shapes: B people, M belief samples, N queries in the pool, K options per query, D features, H
questions that are planned.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import torch
from torch import Generator, Tensor

from torchrl_pref.acquisition.scoring import mean_answers
from torchrl_pref.asking import (
    Asked,
    NothingToAsk,
    answers_said,
    check_same,
    draw_questions,
    make_env,
    next_question,
    query_indices,
    strategy_of,
)
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.transition import SessionState, begin, hear, tell
from torchrl_pref.errors import (
    InputError,
    check_count,
    check_flag,
    check_seed,
    check_type,
)
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.learned import Learned, Turn, expected_gain
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.base import answers_on
from torchrl_pref.questions.prior_evidence import Shown, check_given, given_digest, rows_of_shown
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.saved_session import EARLIER, FORMAT, check_content
from torchrl_pref.strategies import MakeStrategy
from torchrl_pref.tensors import as_whole

PRIME = 1_000_003
"""Between the seeds of two sessions there is room for so many answers."""


class Session(Learned):
    """Questions and answers of one person, or of B side by side, and what is known of them.

    >>> session = Session(pool, Boltzmann(2.0))
    >>> asked = session.ask()
    >>> session.tell(0)  # the first option
    >>> session.weights.mean

    Everything follows from the seed and the answers: the same answers give the same questions and
    the same belief, bit for bit.

    Args:
        pool: the queries, normalised; or their features (N K D).
        response_model: how the person is thought to answer, and what can be answered. A belief that
            is given has the same.
        strategy: a name of ``strategies.STRATEGIES``, in a feed of ``FEED_STRATEGIES``; ``policy``,
            the trained one that comes with the package; or a function from an environment to a
            module that writes ``action``.
        belief: how answers become a belief; by default samples.
        budget: H, questions that are planned, and the most that can be asked.
        people: B; None is one person, and nothing has a leading B.
        repeats: whether a question may come again; one that a person would not answer, too.
        normalizer: what the pool was normalised by, for :meth:`score` to apply to raw features.
        seed: fixes all luck.
        given: what the person, or each of the B, showed before the first question, by
            ``questions.prior_evidence``: demonstrations and corrections, normalised as the pool.
        setup: ``query``, in which the strategy chooses from the whole pool; or ``feed``, in which
            queries of the pool stream by and people see those that it lets through.
        offers: O, how many stream by at most; None is 5H. With ``repeats`` off all queries stream
            by before one comes again.

    Raises:
        InputError: something is not what it should be.
    """

    def __init__(
        self,
        pool: QueryPool | Tensor,
        response_model: ResponseModel,
        strategy: str | MakeStrategy = "alignment_gain",
        belief: BeliefBase | None = None,
        budget: int = 20,
        people: int | None = None,
        normalizer: Normalizer | None = None,
        seed: int = 0,
        repeats: bool = False,
        given: Sequence[Shown] = (),
        setup: str = "query",
        offers: int | None = None,
    ) -> None:
        check_type("response_model", response_model, ResponseModel, "Boltzmann(2.0)")
        belief = Belief(response_model) if belief is None else belief
        check_type("belief", belief, BeliefBase, "Belief(Boltzmann(2.0))")
        if repr(belief.response_model) != repr(response_model):
            raise InputError(
                f"response_model={response_model!r} and a belief with {belief.response_model!r}: "
                "expected the same; make the belief with it"
            )
        if normalizer is not None:
            check_type("normalizer", normalizer, Normalizer, "Normalizer.fit(features)")
        self.pool = QueryPool(pool) if isinstance(pool, Tensor) else pool
        self.budget, self.seed = check_count("budget", budget, 1), check_seed("seed", seed)
        self.people = None if people is None else check_count("people", people, 1)
        self.normalizer = normalizer
        self.strategy = strategy if isinstance(strategy, str) else "own"
        size = 1 if people is None else people
        self.setup, self.repeats = setup, check_flag("repeats", repeats)
        options = {"budget": budget, "repeats": repeats, "offers": offers}
        self._env = make_env(self.pool, belief, setup, size, seed, **options)
        self._belief, self._strategy = belief, strategy_of(strategy, self._env)
        self._hidden = draw_questions(self._env, size, repeats)
        luck, n_features = Generator().manual_seed(self.seed), self.pool.n_features
        state = begin(belief.prior(size, n_features, luck), budget, self.pool.n_options)
        given = check_given(given)
        if given:
            shown = rows_of_shown(given, size, n_features, response_model)
            state = hear(belief, state, shown, luck)
        self._states, self._given = [state], given_digest(given)
        self._turns: list[Turn] = []
        self._asked: Tensor | None = None
        self._nothing: NothingToAsk | None = None  # where that was found out already
        # Offers that went by, until the present question and until the one that was answered last.
        self._n_offered = self._n_gone = torch.zeros(size, 1, dtype=torch.long)

    @property
    def answers(self) -> tuple[str, ...]:
        """R, what each answer is called, by the number that :meth:`tell` takes."""
        model, device = self._belief.response_model, torch.device("cpu")
        return answers_on(model.question, self.pool.n_options, device).labels

    def ask(self) -> Asked:
        """The question to answer next, the same until it is answered.

        Raises:
            NothingToAsk: the budget is used up, or in a feed all offers went by.
        """
        if self._asked is None:
            if self.n_answered >= self.budget:
                raise NothingToAsk(
                    f"budget={self.budget}: all questions are answered; expected a larger budget "
                    "where more are to be asked"
                )
            if self._nothing is not None:
                raise self._nothing
            state: SessionState = {**self._states[-1], "n_offered": self._n_gone}
            given = self._env, self._strategy, state, self._hidden, self._luck
            try:
                asked, offered = next_question(*given)
            except NothingToAsk as nothing:
                self._nothing = nothing
                raise
            self._asked, self._n_offered = asked, self._n_gone if offered is None else offered
        index, shown_to = self._asked, self.pool.trajectories
        trajectories = None if shown_to is None else self._plain(shown_to[index])
        # A copy: what a page makes of the index is none of the session's.
        return Asked(
            self._plain(index.clone()), self._plain(self.pool.features[index]), trajectories
        )

    @property
    def expected_gain(self) -> Tensor:
        """(B), what the answer to the present question is expected to add to that, at most.

        Raises:
            NothingToAsk: there is no question left.
        """
        return self._plain(expected_gain(*self._present))

    @property
    def answer_probabilities(self) -> Tensor:
        """(B R), how probable each answer to the present question is held to be.

        Raises:
            NothingToAsk: there is no question left.
        """
        samples, options, model = self._present
        return self._plain(mean_answers(samples, options.unsqueeze(1), model).squeeze(1))

    def tell(self, answer: int | Sequence[int | None] | None) -> None:
        """Let in the answer to the question that :meth:`ask` gave.

        Args:
            answer: its number among :attr:`answers`, from 0 on (of a choice: the option), or None
                where the person would not say; for B people one each.

        Raises:
            InputError: nothing was asked, or there is no such answer. Nothing has changed then.
        """
        if self._asked is None:
            raise InputError("an answer to no question: expected ask() before tell()")
        given = [answer] if self.people is None else as_whole(answer)
        if not isinstance(given, Sequence):
            raise InputError(f"answer={answer!s:.60}: expected a list, one for each person")
        self._let_in(Turn(self._asked, answers_said(self._env, given)))
        self._n_gone = self._n_offered

    def put(self, query: int | Sequence[int], n_offered: int | None = None) -> None:
        """Ask this question of the pool next, and not the one that the strategy would choose; it
        may have been asked before, also with ``repeats`` off.

        Args:
            query: its index; for B people one each.
            n_offered: in a feed, how many offers went by until it; None: as many as before.

        Raises:
            InputError: there is no such query, or no question left.
        """
        if self.n_answered >= self.budget:
            raise NothingToAsk(f"budget={self.budget}: all questions are answered")
        query = as_whole(query)
        asked = query_indices(self._env, query if isinstance(query, Sequence) else [query])
        offered = self._n_gone
        if n_offered is not None:
            most = getattr(self._env, "n_offers", 0)
            count = check_count("n_offered", as_whole(n_offered), 0)
            if count > most:
                raise InputError(f"n_offered={count}: expected at most the {most} offers")
            offered = torch.full_like(self._n_gone, count)
        self._asked, self._n_offered = asked, offered

    @property
    def n_offered(self) -> int:
        """In a feed, how many offers went by so far, of the person with the most."""
        return int(self._n_offered.max())

    def undo(self, turn: int = -1) -> None:
        """Take an answer back; its question is asked again. The other answers stay.

        Args:
            turn: which, from 0 on; from the end where negative.

        Raises:
            InputError: there is none.
        """
        turn = as_whole(turn)
        if type(turn) is not int or not -self.n_answered <= turn < self.n_answered:
            raise InputError(
                f"nothing to undo: expected the place of one of {self.n_answered} answers, and "
                f"got {turn!s:.40}"
            )
        place = turn % self.n_answered
        again, *later = self._turns[place:]
        del self._states[place + 1 :], self._turns[place:]
        for one in later:
            self._let_in(one)
        self._asked, self._n_offered = again.query, self._n_gone

    def branch(self) -> Session:
        """A session of its own that goes on from here, at next to no cost."""
        other = copy(self)
        other._states, other._turns = list(self._states), list(self._turns)
        return other

    def to_dict(self) -> dict[str, Any]:
        """All that :meth:`from_dict` needs to go on, as plain JSON."""
        return {
            "format": FORMAT,
            "pool": self.pool.digest,
            "response_model": repr(self._belief.response_model),
            "belief": repr(self._belief),
            "strategy": self.strategy,
            "repeats": self.repeats,
            "budget": self.budget,
            "people": self.people,
            "seed": self.seed,
            "queries": [turn.query.tolist() for turn in self._turns],
            "answers": [turn.answers.tolist() for turn in self._turns],
            "given": self._given,
            "asked": None if self._asked is None else self._asked.tolist(),
            "setup": self.setup,
            "offers": getattr(self._env, "n_offers", None),
            "offered": self._n_offered.squeeze(-1).tolist(),
            "gone": self._n_gone.squeeze(-1).tolist(),
        }

    @classmethod
    def from_dict(
        cls,
        content: dict[str, Any],
        pool: QueryPool | Tensor,
        response_model: ResponseModel,
        strategy: str | MakeStrategy = "alignment_gain",
        belief: BeliefBase | None = None,
        normalizer: Normalizer | None = None,
        given: Sequence[Shown] = (),
    ) -> Session:
        """Go on where :meth:`to_dict` was taken, bit for bit: all answers are let in again.

        Args:
            content: what it made; numbers alone, no code.
            pool, response_model, strategy, belief, normalizer, given: as it was made with.

        Raises:
            InputError: the content is spoiled, or was made with another pool or belief.
        """
        check_content(content)
        content = {**EARLIER, **content}
        keys = ("budget", "people", "seed", "repeats", "setup", "offers")
        made = {key: content[key] for key in keys}
        session = cls(
            pool, response_model, strategy, belief, normalizer=normalizer, given=given, **made
        )
        check_same(content, session.to_dict())
        for queries, answers in zip(content["queries"], content["answers"], strict=True):
            given_up = [None if answer == REFUSED else answer for answer in answers]
            said = answers_said(session._env, given_up)
            session._let_in(Turn(query_indices(session._env, queries), said))
        if content["asked"] is not None:
            session._asked = query_indices(session._env, content["asked"])
        if content["offered"] is not None and content["gone"] is not None:
            session._n_offered = torch.tensor(content["offered"]).view_as(session._n_gone)
            session._n_gone = torch.tensor(content["gone"]).view_as(session._n_gone)
        return session

    @property
    def _present(self) -> tuple[Tensor, Tensor, ResponseModel]:
        """The belief (B M D), the options (B K D) of the present question, and how people are
        thought to answer."""
        self.ask()
        assert self._asked is not None
        options, model = self.pool.features[self._asked], self._belief.response_model
        return self._states[-1]["samples"], options, model

    @property
    def _luck(self) -> int:
        """The seed of the present turn."""
        return self.seed * PRIME + self.n_answered

    def _let_in(self, turn: Turn) -> None:
        """Add answers to pool queries to the belief."""
        options, generator = self.pool.features[turn.query], Generator().manual_seed(self._luck)
        before, belief = self._states[-1], self._belief
        self._states.append(tell(belief, before, options, turn.answers, turn.query, generator))
        self._turns.append(turn)
        self._asked = self._nothing = None
