"""What a policy is trained and judged on: pools, who answers, and what the belief takes them to be.

Shapes: N queries, K options per query, D features.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Generator

from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError, check_positive
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.base import Question
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.choice import Choice
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import model_of

NOISY_ACCURACY = 0.9
"""The paper's "noisy user (90%)"."""


@dataclass(frozen=True)
class Human:
    """How the simulated humans of a problem answer.

    Attributes:
        tau: by what they multiply returns; None for those who never err.
        lapse: share of answers that are given at random.
        kind: what else is particular to them, in words; empty where nothing is.
    """

    tau: float | None
    lapse: float = 0.0
    kind: str = ""


@dataclass(frozen=True)
class Problem:
    """What a policy is trained and judged on.

    Attributes:
        train, test: the pools, normalised by the training pool's statistics.
        normalizer: those statistics.
        tau: what the belief takes to be the human's; None for an optimal one.
        question: what is asked.
        human: who answers; None: whom the belief expects, but without lapses.
        belief_lapse: share of answers that the belief takes to be given at random.
        task: what the pools are of, where it is not the Gridworld.
        infers: what the belief infers beside ω, in words.
    """

    train: QueryPool
    test: QueryPool
    normalizer: Normalizer
    tau: float | None
    question: Question = field(default_factory=Choice)
    human: Human | None = None
    belief_lapse: float = 0.0
    task: str = ""
    infers: str = ""

    @property
    def title(self) -> str:
        """The task, what kind of human this is, and what the belief takes them for where that is
        another, for tables and figures."""
        title = f"{self.task}, {self._who}" if self.task else self._who
        return f"{title}; {self.infers} inferred" if self.infers else title

    @property
    def _who(self) -> str:
        human = self._human
        errs = [] if human.tau is None else [f"tau={human.tau:.4g}"]
        errs += [f"lapse={human.lapse:g}"] if human.lapse else []
        name = "optimal human" if human.tau is None else "noisy human"
        who = f"{name} ({', '.join(errs)})" if errs else name
        if human.kind:
            who = f"{who}, {human.kind}"
        if type(self.question) is not Choice:
            who = f"{who}, {named(self.question)}"
        if not self.mistakes:
            return who
        beside = f", lapse={self.belief_lapse:g}" if self.belief_lapse else ""
        return f"{who}; assumed {self._assumed}{beside}"

    @property
    def _assumed(self) -> str:
        return "optimal" if self.tau is None else f"tau={self.tau:.4g}"

    @property
    def response_model(self) -> ResponseModel:
        """How the belief thinks that the human answers."""
        return model_of(self.tau, self.question, self.belief_lapse)

    @property
    def human_model(self) -> ResponseModel:
        """How the human answers."""
        return model_of(self._human.tau, self.question, self._human.lapse)

    def judging_rightly(self) -> Problem:
        """The same where the belief is told the tau and the lapses of the human, who has nothing
        else that is particular."""
        human = self._human
        own = Human(human.tau, human.lapse)
        return replace(self, tau=human.tau, belief_lapse=human.lapse, human=own)

    @property
    def mistakes(self) -> list[str]:
        """In what the belief takes the human for another, in words."""
        human, found = self._human, []
        if human.kind:
            found.append(human.kind)
        if human.tau != self.tau:
            found.append(self._assumed)
        if human.lapse != self.belief_lapse:
            found.append(f"lapse={self.belief_lapse:g}")
        return found

    @property
    def _human(self) -> Human:
        return Human(self.tau) if self.human is None else self.human


def named(question: Question) -> str:
    """A kind of question in words, with its numbers."""
    kinds = {kind: name.replace("_", " ") for name, kind in QUESTIONS.items()}
    numbers = [f"{key}={value}" for key, value in vars(question).items()]
    return " ".join([kinds.get(type(question), type(question).__name__), "questions", *numbers])


def solve_tau(tau: Any, pool: QueryPool) -> float | None:
    """The tau that a setting means on a training pool; None for a human who never errs.

    Args:
        tau: ``noisy``, ``optimal`` or a positive number.
        pool: normalised.

    Raises:
        InputError: it is none of these.
    """
    if isinstance(tau, str) and tau not in ("noisy", "optimal"):
        raise InputError(f"tau={tau!r}: expected noisy, optimal or a number above 0, as in tau=2")
    if tau == "optimal":
        return None
    if tau != "noisy":
        return check_positive("tau", tau)
    omega = uniform_sphere((2000, pool.n_features), Generator().manual_seed(0))
    returns = torch.einsum("nkd,md->nmk", pool.features, omega)
    return calibrate_tau(returns, NOISY_ACCURACY)
