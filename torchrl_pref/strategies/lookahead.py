"""Strategies that look at the questions after the next, too.

Shapes: G beliefs that are looked at, B sessions, C candidates, M belief samples, R possible
answers, D features.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import predict_answers
from torchrl_pref.envs.transition import OPEN
from torchrl_pref.errors import InputError, check_count
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import directions

HELD = 4_000_000
"""Numbers (G D+1 C R) held at once: bounds memory."""

MOST_FOLLOWED = 1000
"""Sequences of answers to a sequence of questions, all of which are followed: bounds time."""


def check_followed(response_model: ResponseModel, n_options: int, steps: int = 2) -> None:
    """Refuse to look ahead at questions with so many answers that it would take minutes or more.

    Raises:
        InputError: there are too many.
    """
    n_answers = response_model.n_answers(n_options)
    if n_answers**steps > MOST_FOLLOWED:
        raise InputError(
            f"looking {steps} questions ahead, each with {n_answers} answers: there are "
            f"{n_answers**steps} sequences of answers to follow; expected at most {MOST_FOLLOWED}; "
            "ask about fewer options, look fewer questions ahead, or choose by alignment_gain"
        )


class OneByOne(TensorDictModuleBase, ABC):
    """Choose for one session after the other: the table of all that may follow is large.

    Args:
        response_model: how the belief thinks the human answers.
        beam: first questions to follow.
        steps: questions to look ahead.

    Raises:
        InputError: a number is below 1.
    """

    in_keys = ["samples", "queries", "action_mask", ("session", "history", "answers")]
    out_keys = ["action"]

    def __init__(self, response_model: ResponseModel, beam: int, steps: int) -> None:
        super().__init__()
        self.response_model = response_model
        self.beam, self.steps = check_count("beam", beam, 1), check_count("steps", steps, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B). An InputError where the questions have too many answers."""
        check_followed(self.response_model, tensordict["queries"].shape[2], self.steps)
        actions = [self._choose(session) for session in tensordict.select(*self.in_keys).unbind(0)]
        return tensordict.set("action", torch.stack(actions))

    @abstractmethod
    def _choose(self, session: TensorDictBase) -> Tensor:
        """The action () of one session."""


class Lookahead(OneByOne):
    """Ask the candidate whose information gain and best successor's sum to most: two steps ahead.

    The belief after each answer to the first query is the present one reweighted, so that all
    second steps are matrix products. Only the ``beam`` best first steps are followed.

    Args:
        response_model: how the belief thinks the human answers.
        beam: first steps to follow.
    """

    def __init__(self, response_model: ResponseModel, beam: int = 20) -> None:
        super().__init__(response_model, beam, steps=2)

    def _choose(self, session: TensorDictBase) -> Tensor:
        samples = session["samples"].unsqueeze(0)
        predicted = predict_answers(samples, session["queries"].unsqueeze(0), self.response_model)
        gain = information_gain(predicted, samples)[0]
        gain = gain.masked_fill(~session["action_mask"], -math.inf)
        probs = predicted.probs[0]  # (C M R)
        entropy = torch.special.entr(probs).sum(-1)
        value, first = gain.topk(min(self.beam, len(gain)))
        n_open = (session["session", "history", "answers"] == OPEN).sum()
        if n_open <= 1:  # no second step after the last
            return first[0]
        joint = probs[first].mT / probs.shape[1]  # (beam R M): P(answer and sample)
        of_answer = joint.sum(-1, keepdim=True)
        weights = joint / of_answer.clamp(min=1e-30)
        later = torch.stack([weights @ answer.T for answer in probs.unbind(-1)])
        # (beam R C), information gain of every second query after every first answer
        second = torch.special.entr(later).sum(0) - weights @ entropy.T
        best = second.masked_fill(~session["action_mask"], 0.0).amax(-1) / math.log(2)
        return first[(value + (of_answer.squeeze(-1) * best).sum(-1)).argmax()]


class AlignmentLookahead(OneByOne):
    r"""Ask what leads to the highest expected :math:`\lVert E[\omega] \rVert^2` some questions on.

    That is what the belief itself expects of its alignment. After each answer the best next
    question is asked, and so on; with one step it is greedy by ``alignment_gain``. The belief after
    an answer is the present one reweighted. Only the questions of a ``beam`` are followed, those
    that are best one step ahead: ``beam`` of the first, a fifth as many of each later one.

    Args:
        response_model: how the belief thinks the human answers.
        steps: questions to look ahead, fewer where fewer are left.
        beam: first questions to follow.

    Raises:
        InputError: a number is below 1.
    """

    def __init__(self, response_model: ResponseModel, steps: int = 2, beam: int = 25) -> None:
        super().__init__(response_model, beam, steps)

    def _choose(self, session: TensorDictBase) -> Tensor:
        samples = session["samples"]
        queries = session["queries"].unsqueeze(0)
        predicted = predict_answers(samples.unsqueeze(0), queries, self.response_model)
        ahead = Ahead(predicted.probs[0], directions(samples), session["action_mask"])
        n_open = int((session["session", "history", "answers"] == OPEN).sum())
        weights = samples.new_full((1, len(samples)), 1 / len(samples))
        values = ahead.values(weights, max(1, min(self.steps, n_open)), self.beam)
        return values[0].argmax()


class Ahead:
    """What questions lead to, of one session.

    Args:
        probs: (C M R), probability of each answer under each sample.
        units: (M D), directions of the samples.
        allowed: (C), whether a candidate may be asked.
    """

    def __init__(self, probs: Tensor, units: Tensor, allowed: Tensor) -> None:
        self.probs, self.allowed = probs, allowed
        # About the mean: a small gain would drown in the rounding of two squares near 1.
        self.moments = torch.cat([units - units.mean(0), torch.ones_like(units[:, :1])], -1).mT

    def values(self, weights: Tensor, steps: int, beam: int) -> Tensor:
        """What asking each candidate leads to, in so many steps.

        Args:
            weights: (G M), of the samples in each belief; they sum to one.
            steps: at least 1.
            beam: candidates that are followed, where more than one step is left.

        Returns:
            (G C), the expected squared length of the mean, up to a number that is the same for all;
            -∞ where a candidate is not allowed or not followed.
        """
        group = max(1, HELD // (len(self.moments) * self.probs[..., 0, :].numel()))
        now = torch.cat([self._after_one(part) for part in weights.split(group)])
        if steps == 1:
            return now
        _, first = now.topk(min(beam, int(self.allowed.sum())))
        joint = weights[:, None, None, :] * self.probs[first].mT  # (G beam R M)
        share = joint.sum(-1)
        told = (joint / share.clamp(min=1e-30).unsqueeze(-1)).flatten(0, 2)
        later = self.values(told, steps - 1, max(1, beam // 5)).amax(-1).view_as(share)
        return torch.full_like(now, -math.inf).scatter(1, first, (share * later).sum(-1))

    def _after_one(self, weights: Tensor) -> Tensor:
        """The same (G C) of one step."""
        weighed = (weights.unsqueeze(1) * self.moments).flatten(0, 1)  # (G·(D+1) M)
        told = weighed @ self.probs.movedim(1, 0).flatten(1)
        told = told.view(len(weights), -1, *self.probs[:, 0].shape)  # (G D+1 C R)
        moved, share = told[:, :-1], told[:, -1]
        value = (moved.square().sum(1) / share.clamp(min=1e-30)).sum(-1)
        return value.masked_fill(~self.allowed, -math.inf)
