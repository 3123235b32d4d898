"""Which of these is best, and which is worst?"""

from __future__ import annotations

import math
from itertools import permutations
from string import ascii_uppercase

import torch

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.questions.base import Answers, Question

MOST = len(ascii_uppercase)
"""Options at most: each has a letter of its own."""


class BestWorst(Question):
    r"""Pick the best of K options, and then the worst of the others.

    .. math:: P(b, w \mid \omega) = \frac{\exp \tau R(\xi_b)}{\sum_k \exp \tau R(\xi_k)} \;
        \frac{\exp -\tau R(\xi_w)}{\sum_{k \ne b} \exp -\tau R(\xi_k)}

    Best-worst scaling, the sequential model (Marley and Louviere, *Some probabilistic models of
    best, worst, and best-worst choices*, 2005). Of two options it is a choice, and of three a
    ranking.
    """

    prompt = "Which is best, and which is worst?"

    def places(self, n_options: int) -> list[tuple[int, ...]]:
        """See :meth:`Question.places`: the best, then the worst."""
        return list(permutations(range(n_options), 2))

    def answers(self, n_options: int) -> Answers:
        """See :meth:`Question.answers`. Answers are the K(K-1) pairs of a best and a worst option;
        the first factor has K-1 rows and the second K-2."""
        check_count("options", n_options, 2)
        if n_options > MOST:
            raise InputError(f"a best and a worst of {n_options} options: expected at most {MOST}")
        pairs = list(permutations(range(n_options), 2))
        contrasts = torch.zeros(len(pairs), 2, n_options - 1, n_options)
        offsets = torch.full(contrasts.shape[:-1], math.inf)
        offsets[:, 0] = offsets[:, 1, : n_options - 2] = 0.0
        option = torch.eye(n_options)
        for (best, worst), (first, second) in zip(pairs, contrasts, strict=True):
            others = [k for k in range(n_options) if k != best]
            between = [k for k in others if k != worst]
            first[:] = option[best] - option[others]
            second[: len(between)] = option[between] - option[worst]
        named = ((ascii_uppercase[best], ascii_uppercase[worst]) for best, worst in pairs)
        labels = tuple(f"best {best}, worst {worst}" for best, worst in named)
        return Answers(labels, contrasts, offsets, torch.zeros(len(pairs)))
