"""Which of these is best? The paper's question (its section 3.2), about any number of options."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_pref.errors import check_count
from torchrl_pref.questions.base import Answers, Evidence, Question, rows_of


class Choice(Question):
    """Pick one of K: one factor, in which the pick is preferred to each of the others."""

    prompt = "Which is best?"

    def places(self, n_options: int) -> list[tuple[int, ...]]:
        """See :meth:`Question.places`."""
        return [(k,) for k in range(n_options)]

    def answers(self, n_options: int) -> Answers:
        """See :meth:`Question.answers`. Answer k is option k."""
        check_count("options", n_options, 2)
        identity = torch.eye(n_options)
        # The rows of an answer start with the option after it, and go round.
        others = [identity.roll(-k, 0)[1:] for k in range(n_options)]
        contrasts = torch.stack([identity[k] - other for k, other in enumerate(others)])
        return Answers(
            labels=tuple(f"option {k + 1}" for k in range(n_options)),
            contrasts=contrasts.unsqueeze(1),
            offsets=torch.zeros(n_options, 1, n_options - 1),
            log_weights=torch.zeros(n_options),
        )


def feature_gaps(options: Tensor, answers: Tensor) -> Tensor:
    """How the features of the chosen option exceed those of the others.

    Args:
        options: (… K D), features.
        answers: (…), index of the chosen option, or -1 where there is no answer yet.

    Returns:
        (… K-1 D), zero where there is no answer.

    Raises:
        InputError: an answer is no whole number from -1 to K-1.
    """
    rows, _, _ = rows_of(Choice(), options, answers)
    return rows.squeeze(-3)


def evidence_of_gaps(gaps: Tensor) -> Evidence:
    """The evidence of choices without lapses, from their feature gaps (… K-1 D)."""
    rows = gaps.unsqueeze(-3)
    return Evidence(rows, torch.zeros_like(rows[..., 0]), torch.zeros_like(rows[..., 0, 0, 0]))
