"""Kinds of question: what can be answered, and what each answer says of ω.

Letters: K options per query, R possible answers, F factors of an answer, J rows of a factor, U
different factors of a question, D features, ``…`` any leading dimensions.

Every answer is evidence of one form: a product of F softmax choices, in each of which something was
preferred to J others (reward-rational choice: Jeon, Milli and Dragan, 2020). A row is what the
preferred one's features are more than another's, and an offset makes the preference easier to give.
With r the return of a row and o its offset, a factor of a Boltzmann human is

    1 / (1 + Σ_j exp(-tau (r_j + o_j))).

A kind of question is a table of numbers, so that the belief, the acquisition functions, the
simulated humans and the compiled loops know all kinds alike.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_pref.errors import InputError
from torchrl_pref.tensors import check_range, check_shape


@dataclass(frozen=True)
class Evidence:
    """What answers say of ω, under a response model.

    Attributes:
        rows: (… F J D), features of what was preferred less those of what it was preferred to.
        offsets: (… F J), what is added to the returns of the rows, in their unit; infinite where
            there is no row, as where there is no answer yet.
        floor: (…), what is added to the product of the factors: 0, or more where anything may be
            answered by mistake.
    """

    rows: Tensor
    offsets: Tensor
    floor: Tensor

    def __getitem__(self, index: Any) -> Evidence:
        """The evidence of some of the answers, by an index of the leading dimensions."""
        return Evidence(self.rows[index], self.offsets[index], self.floor[index])

    def expand(self, *leading: int) -> Evidence:
        """The same evidence for more leading dimensions, as views."""
        return Evidence(
            self.rows.expand(*leading, *self.rows.shape[-3:]),
            self.offsets.expand(*leading, *self.offsets.shape[-2:]),
            self.floor.expand(*leading),
        )

    def double(self) -> Evidence:
        """The same in float64."""
        return Evidence(self.rows.double(), self.offsets.double(), self.floor.double())

    def gaps(self, samples: Tensor) -> Tensor:
        """Return gaps (S M … F J) under samples (S M D), raised by the offsets."""
        rows = (samples @ self.rows.flatten(1, -2).mT).unflatten(-1, self.rows.shape[1:-1])
        return rows + self.offsets.unsqueeze(1)


class Answers(NamedTuple):
    """The possible answers to a query of K options."""

    labels: tuple[str, ...]
    """R, what each is called."""
    contrasts: Tensor
    """(R F J K), by what the options' features are multiplied to make the rows."""
    offsets: Tensor
    """(R F J), in logits; infinite where there is no row."""
    log_weights: Tensor
    """(R), natural logarithm of what the product of an answer's factors is multiplied by."""


class Factors(NamedTuple):
    """The different factors that the answers to a query of K options are made of.

    Many answers share them: the 720 orders of six options are made of 186 choices.
    """

    contrasts: Tensor
    """(U J K), see :class:`Answers`."""
    offsets: Tensor
    """(U J), in logits; infinite where there is no row."""
    of_answer: Tensor
    """(R F), which of them make each answer."""


class Question(ABC):
    """A kind of question. Two of the same kind with the same numbers are equal.

    Attributes are numbers, texts or tuples of them, as tables are kept by them.

    Attributes:
        prompt: what a person is asked, in words.
    """

    prompt: str = "What do you say?"

    @abstractmethod
    def answers(self, n_options: int) -> Answers:
        """What can be answered to a query of K options: probabilities that sum to one, whatever the
        returns of the options are.

        Raises:
            InputError: there is no such question about so many options.
        """

    def places(self, n_options: int) -> list[tuple[int, ...]] | None:
        """The options that a person points at to give each of the R answers, in the order in which
        they point; None where answers are told by their labels alone."""
        return None

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        try:
            return hash((type(self), *sorted(vars(self).items())))
        except TypeError:
            raise InputError(
                f"{type(self).__name__} with {', '.join(vars(self))}: expected attributes that are "
                "numbers, texts or tuples of them; make a list a tuple"
            ) from None

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}={value}" for name, value in vars(self).items())
        return f"{type(self).__name__}({numbers})"


@lru_cache(maxsize=64)
def answers_on(question: Question, n_options: int, device: torch.device) -> Answers:
    """A question's possible answers, their tensors on a device."""
    answers = question.answers(n_options)
    _check_answers(question, n_options, answers)
    labels, *tensors = answers
    return Answers(labels, *(tensor.to(device) for tensor in tensors))


@lru_cache(maxsize=64)
def factors_on(question: Question, n_options: int, device: torch.device) -> Factors:
    """The different factors of a question's answers, on a device, in the order of the answers."""
    _, contrasts, offsets, _ = answers_on(question, n_options, torch.device("cpu"))
    number: dict[tuple[bytes, ...], int] = {}
    places, of_answer = [], []
    for place, factor in enumerate(torch.cat([contrasts, offsets.unsqueeze(-1)], -1).flatten(0, 1)):
        key = tuple(sorted(row.tobytes() for row in factor.numpy()))  # rows are in no order
        if key not in number:
            number[key] = len(number)
            places.append(place)
        of_answer.append(number[key])
    tensors = contrasts.flatten(0, 1)[places], offsets.flatten(0, 1)[places]
    index = torch.tensor(of_answer).view(contrasts.shape[:2])
    return Factors(*(tensor.to(device) for tensor in (*tensors, index)))


def _check_answers(question: Question, n_options: int, answers: Answers) -> None:
    """Refuse a table whose shapes differ, or whose probabilities do not sum to one.

    Raises:
        InputError: they do.
    """
    labels, contrasts, offsets, log_weights = answers
    n_factors, n_rows = contrasts.shape[1:3] if contrasts.ndim == 4 else (0, 0)
    sizes = (len(labels), n_factors, n_rows)
    for name, tensor, expected in (
        ("contrasts", contrasts, (*sizes, n_options)),
        ("offsets", offsets, sizes),
        ("log_weights", log_weights, sizes[:1]),
    ):
        check_shape(f"{name} of {question!r}", tensor, expected, f"for {sizes[0]} answers (labels)")
    returns = torch.linspace(-1.5, 2.0, 5 * n_options).view(5, n_options).sin() * 2
    logits = torch.einsum("rfjk,bk->brfj", contrasts, returns) + offsets
    factors = -torch.log1p((-logits).exp().sum(-1)).sum(-1)
    total = (factors + log_weights).exp().sum(-1)
    if (total - 1).abs().max() > 1e-3:
        raise InputError(
            f"{question!r}: the probabilities of its answers sum to {float(total[0]):.3g}; "
            "expected 1 whatever the returns are; look at the offsets and log_weights of its table"
        )


def rows_of(question: Question, options: Tensor, answers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows (… F J D), offsets (… F J) in logits, and the answers (…) as int64, of queries (… K D).

    Args:
        question: the kind of question.
        options: (… K D), features.
        answers: (…), indices of the question's answers, -1 where there is none.

    Raises:
        InputError: an answer is no whole number from -1 to R-1.
    """
    table = answers_on(question, options.shape[-2], options.device)
    last = len(table.labels) - 1
    answers = check_range("answers", answers, -1, last, f"{table.labels}, -1 where none")
    there = (answers >= 0)[..., None, None]
    given = answers.clamp(min=0)
    # A sum and no matrix product: each row is the difference of a few numbers, exactly.
    rows = (table.contrasts[given].unsqueeze(-1) * options[..., None, None, :, :]).sum(-2)
    offsets = torch.where(there, table.offsets[given], torch.inf)
    return rows * there.unsqueeze(-1), offsets, answers


@lru_cache(maxsize=1024)
def reordered(question: Question, order: tuple[int, ...]) -> list[int] | None:
    """Which answer a person means who saw the options in another order.

    Args:
        question: what was asked.
        order: K, the option at each place.

    Returns:
        R, by the answer in terms of places the one in terms of options; None where the question
        does not treat all options alike.
    """
    _, contrasts, offsets, log_weights = answers_on(question, len(order), torch.device("cpu"))
    place_of = [order.index(option) for option in range(len(order))]
    meant = _as_keys(contrasts, offsets, log_weights)
    number = {key: answer for answer, key in enumerate(meant)}
    said = _as_keys(contrasts[..., place_of], offsets, log_weights)
    found = [number.get(key) for key in said]
    return None if None in found else [answer for answer in found if answer is not None]


def _as_keys(contrasts: Tensor, offsets: Tensor, log_weights: Tensor) -> list[tuple[Any, ...]]:
    """R keys, equal where answers say the same of the options: factors and rows are in no order."""
    rows = torch.cat([contrasts, offsets.unsqueeze(-1)], -1) + 0.0  # no negative zeros
    return [
        (weight, tuple(sorted(tuple(sorted(map(tuple, factor))) for factor in answer)))
        for weight, answer in zip(log_weights.tolist(), rows.tolist(), strict=True)
    ]


def check_same(human: Question, belief: Question) -> None:
    """Refuse a human and a belief who are not asked the same.

    Raises:
        InputError: the answers of one are not those of the other.
    """
    if type(human) is not type(belief):
        raise InputError(
            f"the human answers {human!r} and the belief expects {belief!r}: expected the same "
            "kind of question; their numbers may differ"
        )
