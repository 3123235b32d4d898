"""Put these in order, the best first."""

from __future__ import annotations

import math
from itertools import permutations
from string import ascii_uppercase

import torch

from torchrl_pref.errors import InputError, check_count
from torchrl_pref.questions.base import Answers, Question

MOST = 6
"""Options that are ranked at most: of six there are 720 orders."""


class Ranking(Question):
    r"""Order all K options: the best of all, then the best of the rest, and so on.

    .. math:: P(\xi_1 \succ \dots \succ \xi_K \mid \omega) = \prod_{i=1}^{K-1}
        \frac{\exp \tau R(\xi_i)}{\sum_{j \ge i} \exp \tau R(\xi_j)}

    Plackett, *The analysis of permutations*, 1975; Luce, *Individual choice behavior*, 1959. For
    rewards: Myers, Bıyık, Anari and Sadigh, *Learning multimodal rewards from rankings*, 2021. The
    first factor is a choice of the best, and of two options a ranking is a choice.
    """

    prompt = "Put them in order, the best first."

    def places(self, n_options: int) -> list[tuple[int, ...]]:
        """See :meth:`Question.places`: the best first."""
        return list(permutations(range(n_options)))

    def answers(self, n_options: int) -> Answers:
        """See :meth:`Question.answers`. Answers are K! orders, those of ``itertools.permutations``;
        factor f has K-1-f rows."""
        check_count("options", n_options, 2)
        if n_options > MOST:
            raise InputError(
                f"a ranking of {n_options} options: expected at most {MOST}, which have 720 "
                "orders; show fewer, or ask for the best and the worst"
            )
        orders = list(permutations(range(n_options)))
        placed = torch.eye(n_options)[torch.tensor(orders)]  # (R K K), by place and option
        size = n_options - 1
        contrasts = torch.zeros(len(orders), size, size, n_options)
        offsets = torch.full((len(orders), size, size), math.inf)
        for place in range(size):
            n_worse = size - place
            contrasts[:, place, :n_worse] = placed[:, place : place + 1] - placed[:, place + 1 :]
            offsets[:, place, :n_worse] = 0.0
        labels = (" > ".join(ascii_uppercase[option] for option in order) for order in orders)
        return Answers(tuple(labels), contrasts, offsets, torch.zeros(len(orders)))
