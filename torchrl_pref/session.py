"""Ask and tell: questions for live people, without an environment of your own.

Shapes: B people, M belief samples, N queries in the pool, K options per query, D features, H
questions that are planned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.asking import strategy_of
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import begin, hear, tell
from torchrl_pref.errors import (
    InputError,
    check_count,
    check_flag,
    check_seed,
    check_type,
)
from torchrl_pref.humans.base import REFUSED
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.base import answers_on
from torchrl_pref.questions.prior_evidence import Shown, given_digest, rows_of_shown
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.saved_session import FORMAT, check_content
from torchrl_pref.strategies import MakeStrategy
from torchrl_pref.tensors import check_finite, check_plain, directions

PRIME = 1_000_003
"""Between the seeds of two sessions there is room for so many answers."""


class Asked(NamedTuple):
    """A question to show; with one person the leading B is left out."""

    query: Tensor
    """(B), its index in the pool."""
    features: Tensor
    """(B K D), of its options, as in the pool."""
    trajectories: Tensor | None
    """(B K …), what the person is shown, where the pool has it."""


class Weights(NamedTuple):
    """What is known of the weights; with one person the leading B is left out."""

    mean: Tensor
    """(B D), mean of the samples."""
    sd: Tensor
    """(B D), their standard deviation."""
    low: Tensor
    """(B D), below it lie 5% of the samples."""
    high: Tensor
    """(B D), above it lie 5%."""
    names: tuple[str, ...]
    """D, what the features are called."""


class Session:
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
        strategy: a name of ``strategies.STRATEGIES``; ``policy``, the trained one that comes with
            the package; or a function from a ``QueryEnv`` to a module that writes ``action``.
        belief: how answers become a belief; by default samples.
        budget: H, questions that are planned, and the most that can be asked.
        people: B; None is one person, and nothing has a leading B.
        repeats: whether a question may come again; one that a person would not answer, too.
        normalizer: what the pool was normalised by, for :meth:`score` to apply to raw features.
        seed: fixes all luck.
        given: what the person, or each of the B, showed before the first question, by
            ``questions.prior_evidence``: demonstrations and corrections, normalised as the pool.

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
        human = SimulatedHuman(response_model)  # nobody whom it asks
        size = (1 if people is None else people,)
        check_flag("repeats", repeats)
        self._env = QueryEnv(
            self.pool, human, belief, budget, repeats=repeats, batch_size=size, seed=seed
        )
        self._strategy = strategy_of(strategy, self._env)
        luck, n_features = Generator().manual_seed(self.seed), self.pool.n_features
        state = begin(belief.prior(size[0], n_features, luck), budget, self.pool.n_options)
        if given:
            shown = rows_of_shown(given, size[0], n_features, response_model)
            state = hear(belief, state, shown, luck)
        self._states, self._given = [state], given_digest(given)
        self._told: list[tuple[Tensor, Tensor]] = []
        self._asked: Tensor | None = None

    @property
    def n_answered(self) -> int:
        """Answers so far, of each person; one that was refused counts."""
        return len(self._states) - 1

    @property
    def answers(self) -> tuple[str, ...]:
        """R, what each answer is called, by the number that :meth:`tell` takes."""
        model, device = self._env.belief.response_model, torch.device("cpu")
        return answers_on(model.question, self.pool.n_options, device).labels

    @torch.no_grad()
    def ask(self) -> Asked:
        """The question to answer next, the same until it is answered.

        Raises:
            InputError: the budget is used up.
        """
        if self.n_answered >= self.budget:
            raise InputError(
                f"budget={self.budget}: all questions are answered; expected a larger budget where "
                "more are to be asked"
            )
        if self._asked is None:
            for module in self._strategy.modules():
                if isinstance(getattr(module, "generator", None), Generator):
                    module.generator.manual_seed(self._luck)
            shown = self._env.show(self._states[-1])
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                self._asked = self._strategy(shown)["action"]
        index, shown_to = self._asked, self.pool.trajectories
        trajectories = None if shown_to is None else self._plain(shown_to[index])
        return Asked(self._plain(index), self._plain(self.pool.features[index]), trajectories)

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
        given = [answer] if self.people is None else answer
        if not isinstance(given, Sequence):
            raise InputError(f"answer={answer!r}: expected a list, one for each person")
        self._let_in(self._asked, self._said(given))

    def undo(self) -> None:
        """Take the last answer back; its question is asked again.

        Raises:
            InputError: there is none.
        """
        if not self.n_answered:
            raise InputError("nothing to undo: expected at least one answer")
        self._states.pop()
        self._asked, _ = self._told.pop()

    @property
    def samples(self) -> Tensor:
        """(B M D), the belief's."""
        return self._plain(self._states[-1]["samples"])

    @property
    def weights(self) -> Weights:
        """What is known of the weights: of their directions."""
        samples = directions(self._states[-1]["samples"])
        low, high = torch.quantile(samples, samples.new_tensor([0.05, 0.95]), dim=1)
        mean, sd, low, high = map(self._plain, (samples.mean(1), samples.std(1), low, high))
        return Weights(mean, sd, low, high, self.pool.feature_names)

    @property
    def rationality(self) -> Tensor:
        """(B 3), what the person's tau is thought to be: the median, and what 5% of the samples are
        below and above; the response model's own thrice where the belief does not infer it. An
        InputError where the belief is of a human who never errs."""
        tau = self._env.belief.rationality(self._states[-1]["samples"])
        return self._plain(torch.quantile(tau, tau.new_tensor([0.5, 0.05, 0.95]), dim=1).mT)

    def score(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The reward of trajectories, and how sure that is.

        Args:
            features: (n D), raw where the session knows the normaliser, else normalised.

        Returns:
            (B n) and (B n), mean and standard deviation over the samples.

        Raises:
            InputError: the features are not (n D) finite numbers.
        """
        check_finite("features", check_plain("features", features))
        if self.normalizer is not None:
            features = self.normalizer(features)
        if features.ndim != 2 or features.shape[-1] != self.pool.n_features:
            raise InputError(
                f"features of shape {tuple(features.shape)}: expected (n, {self.pool.n_features})"
            )
        rewards = directions(self._states[-1]["samples"]) @ features.mT
        return self._plain(rewards.mean(1)), self._plain(rewards.std(1))

    def to_dict(self) -> dict[str, Any]:
        """All that :meth:`from_dict` needs to go on, as plain JSON."""
        return {
            "format": FORMAT,
            "pool": self.pool.digest,
            "response_model": repr(self._env.belief.response_model),
            "belief": repr(self._env.belief),
            "strategy": self.strategy,
            "repeats": self._env.repeats,
            "budget": self.budget,
            "people": self.people,
            "seed": self.seed,
            "queries": [index.tolist() for index, _ in self._told],
            "answers": [answers.tolist() for _, answers in self._told],
            "given": self._given,
            "asked": None if self._asked is None else self._asked.tolist(),
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
        keys = ("budget", "people", "seed", "repeats")
        budget, people, seed, repeats = (content[key] for key in keys)
        others = strategy, belief, budget, people, normalizer, seed, repeats, given
        session = cls(pool, response_model, *others)
        made_with = session.to_dict()
        for key in ("pool", "response_model", "belief", "strategy", "given"):
            was = content.get(key)  # sessions of earlier versions were given nothing
            if was != made_with[key]:
                raise InputError(
                    f"{key}: the session was made with {was!s:.80}, and this is "
                    f"{made_with[key]!s:.80}; expected the same"
                )
        for queries, answers in zip(content["queries"], content["answers"], strict=True):
            said = session._said([None if answer == REFUSED else answer for answer in answers])
            session._let_in(session._index_of(queries), said)
        if content["asked"] is not None:
            session._asked = session._index_of(content["asked"])
        return session

    @property
    def _luck(self) -> int:
        """The seed of the present turn."""
        return self.seed * PRIME + self.n_answered

    def _said(self, answers: Sequence[Any]) -> Tensor:
        """(B), answers as the belief is told them.

        Raises:
            InputError: there is no such answer, or there are not B.
        """
        size, last = self._env.batch_size.numel(), self._env.n_answers - 1
        if len(answers) != size:
            raise InputError(f"answers {answers!s:.60}: expected one for each of {size} people")
        for one in answers:
            if one is not None and (type(one) is not int or not 0 <= one <= last):
                raise InputError(
                    f"answer={one!s:.40}: expected a whole number from 0 to {last}, or None where "
                    "the person would not say"
                )
        return torch.tensor([REFUSED if one is None else one for one in answers])

    def _let_in(self, index: Tensor, answers: Tensor) -> None:
        """Add answers (B) to pool queries (B) to the belief."""
        options, generator = self.pool.features[index], Generator().manual_seed(self._luck)
        belief = self._env.belief
        after = tell(belief, self._states[-1], options, answers, index, generator)
        self._states.append(after)
        self._told.append((index, answers))
        self._asked = None

    def _index_of(self, queries: list[int]) -> Tensor:
        """(B), queries of the pool.

        Raises:
            InputError: one is not of the pool, or there are not B.
        """
        size = self._env.batch_size.numel()
        if len(queries) != size or not all(0 <= query < len(self.pool) for query in queries):
            raise InputError(f"queries {queries!s:.80}: expected {size} of the {len(self.pool)}")
        return torch.tensor(queries)

    def _plain(self, tensor: Tensor) -> Tensor:
        """Without the leading B where there is one person."""
        return tensor[0] if self.people is None else tensor
