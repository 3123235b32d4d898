"""A kind of answer of your own: which of these is worst? Easier than which is best, of poor ones.

    python ../../train.py question=my_question:Worst pool.options=3

An answer is one softmax choice of the lowest return: each of the others is preferred to it.
"""

import torch

from torchrl_pref.questions.base import Answers, Question


class Worst(Question):
    """Pick the worst of K options; answer k is option k."""

    def answers(self, n_options: int) -> Answers:
        """A table of K answers of one factor, with a row for each of the other options."""
        option = torch.eye(n_options)
        others = [[k for k in range(n_options) if k != worst] for worst in range(n_options)]
        rows = [option[others[worst]] - option[worst] for worst in range(n_options)]
        return Answers(
            labels=tuple(f"option {k + 1} is worst" for k in range(n_options)),
            contrasts=torch.stack(rows).unsqueeze(1),
            offsets=torch.zeros(n_options, 1, n_options - 1),
            log_weights=torch.zeros(n_options),
        )
