"""Which of these two is better, or are they about equal?"""

from __future__ import annotations

import math

import torch

from torchrl_pref.errors import InputError, check_positive
from torchrl_pref.questions.base import Answers, Question

LARGEST = 100.0
"""Whoever needs a difference of more calls all that there is equal."""


class Weak(Question):
    r"""Pick one of two, or say that they are about equal.

    With z the difference of the returns times tau and a threshold δ, A is picked with probability
    σ(z - δ), B with σ(-z - δ), and the two are called equal with (e^{2δ} - 1) times both: the three
    sum to one (Bıyık, Palan, Landolfi, Losey and Sadigh, *Asking easy questions*, 2019, where δ is
    1; Krishnan, 1977).

    Args:
        threshold: δ, above 0, in the unit of tau times the return.

    Raises:
        InputError: the threshold is not a number above 0 and at most 100.
    """

    prompt = "Which is better, or are they about equal?"

    def __init__(self, threshold: float = 1.0) -> None:
        self.threshold = check_positive("threshold", threshold)
        if threshold > LARGEST:
            raise InputError(f"threshold={threshold}: expected at most {LARGEST:g}; lower it")

    def places(self, n_options: int) -> list[tuple[int, ...]]:
        """See :meth:`Question.places`: about equal is none of the two."""
        return [(0,), (1,), ()]

    def answers(self, n_options: int) -> Answers:
        """See :meth:`Question.answers`. Answers 0 and 1 are the options, 2 is "about equal"."""
        if n_options != 2:
            raise InputError(
                f"a weak question about {n_options} options: expected 2; ask a choice, or make "
                "queries of two options"
            )
        one_way = torch.tensor([[[1.0, -1.0]], [[0.0, 0.0]]])
        other_way = -one_way
        absent = torch.tensor([[-self.threshold], [math.inf]])
        return Answers(
            labels=("the first", "the second", "about equal"),
            contrasts=torch.stack([one_way, other_way, torch.cat([one_way[:1], other_way[:1]])]),
            offsets=torch.stack([absent, absent, torch.full((2, 1), -self.threshold)]),
            log_weights=torch.tensor([0.0, 0.0, math.log(math.expm1(2 * self.threshold))]),
        )
