"""A kind of answer of your own: put all K options in order, the best first.

    python ../../train.py question=my_question:Ranking pool.options=3

The best of K is picked first, then the best of the rest, and so on (Plackett, 1975; Luce, 1959): an
answer is K-1 softmax choices, of K-1 rows, of K-2, … and of one.
"""

import math
from itertools import permutations

import torch

from torchrl_pref.questions.base import Answers, Question


class Ranking(Question):
    """Order all options; answer r is the r-th permutation, in the order of itertools."""

    def answers(self, n_options: int) -> Answers:
        """A table of K! answers, K-1 factors and at most K-1 rows."""
        orders = list(permutations(range(n_options)))
        size = n_options - 1
        contrasts = torch.zeros(len(orders), size, size, n_options)
        offsets = torch.full((len(orders), size, size), math.inf)  # no row, unless set below
        for order, rows, raised in zip(orders, contrasts, offsets, strict=True):
            for place in range(size):
                for row, worse in enumerate(order[place + 1 :]):
                    rows[place, row, order[place]] = 1.0
                    rows[place, row, worse] = -1.0
                    raised[place, row] = 0.0
        labels = tuple(" > ".join(str(option + 1) for option in order) for order in orders)
        return Answers(labels, contrasts, offsets, torch.zeros(len(orders)))
