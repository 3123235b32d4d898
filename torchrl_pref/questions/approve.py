"""Is this one good? Yes or no."""

from __future__ import annotations

import torch

from torchrl_pref.errors import InputError, check_between
from torchrl_pref.questions.base import Answers, Question

LARGEST = 100.0
"""Whoever needs a return further from 0 says the same of all that there is."""


class Approve(Question):
    r"""Say of one option whether it is good enough.

    .. math:: P(\text{yes} \mid \omega) = \sigma(\tau R(\xi) - \theta)

    It is the only kind of question that asks for a return itself and not for a difference of two
    (Knox and Stone, *TAMER*, 2009, whose people say good or bad of what they see). Features are
    normalised, so that the average trajectory has a return of 0: with a threshold θ of 0 a yes says
    that this one is better than it.

    Args:
        threshold: θ, in the unit of tau times the return; above 0 for people hard to please.

    Raises:
        InputError: the threshold is no number from -100 to 100.
    """

    prompt = "Is this one good?"

    def __init__(self, threshold: float = 0.0) -> None:
        self.threshold = check_between("threshold", threshold, -LARGEST, LARGEST)

    def places(self, n_options: int) -> list[tuple[int, ...]]:
        """See :meth:`Question.places`: yes points at it, and no does not."""
        return [(), (0,)]

    def answers(self, n_options: int) -> Answers:
        """See :meth:`Question.answers`. Answer 0 is no, and 1 is yes."""
        if n_options != 1:
            raise InputError(
                f"a yes or no about {n_options} options: expected 1; make queries of one option "
                "(pool.options=1), or ask a choice"
            )
        sign = torch.tensor([-1.0, 1.0])
        return Answers(
            labels=("no", "yes"),
            contrasts=sign.view(2, 1, 1, 1),
            offsets=-self.threshold * sign.view(2, 1, 1),
            log_weights=torch.zeros(2),
        )
