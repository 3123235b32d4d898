"""What a belief has learned of people, in numbers for people to read.

Shapes: B people, M belief samples, N queries in the pool, K options per query, D features, H
answers so far.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.acquisition.scoring import mean_answers, score_queries
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.envs.transition import SessionState
from torchrl_pref.errors import InputError
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import check_finite, check_plain, directions


class Weights(NamedTuple):
    """What is known of the weights; with one person the leading B is left out."""

    mean: Tensor
    """(B D), mean of the samples."""
    sd: Tensor
    """(B D), their standard deviation."""
    low: Tensor
    """(B D), below it lie 5% of the samples."""
    high: Tensor
    """(B D), above it lie 5%."""
    names: tuple[str, ...]
    """D, what the features are called."""


class Turn(NamedTuple):
    """A question that was answered."""

    query: Tensor
    """(B), its index in the pool."""
    answers: Tensor
    """(B), as the belief was told them."""


class Learned:
    """What is known of people of whom somebody keeps the states: see :class:`session.Session`.

    Attributes:
        pool: the queries, normalised.
        people: B; None is one person, and nothing has a leading B.
        normalizer: what the pool was normalised by, where it is known.
    """

    pool: QueryPool
    people: int | None
    normalizer: Normalizer | None
    _belief: BeliefBase
    _states: list[SessionState]
    """Before the first answer, and after each."""
    _turns: list[Turn]
    """The answers."""

    @property
    def n_answered(self) -> int:
        """Answers so far, of each person; one that was refused counts."""
        return len(self._states) - 1

    @property
    def samples(self) -> Tensor:
        """(B M D), a copy of the belief's."""
        return self._plain(self._states[-1]["samples"]).clone()

    @property
    def weights(self) -> Weights:
        """What is known of the weights: of their directions."""
        parts = summary(directions(self._states[-1]["samples"]))
        mean, sd, low, high = map(self._plain, parts)
        return Weights(mean, sd, low, high, self.pool.feature_names)

    @property
    def rationality(self) -> Tensor:
        """(B 3), what the person's tau is thought to be: the median, and what 5% of the samples are
        below and above; the response model's own thrice where the belief does not infer it. An
        InputError where the belief is of a human who never errs."""
        tau = self._belief.rationality(self._states[-1]["samples"])
        return self._plain(torch.quantile(tau, tau.new_tensor([0.5, 0.05, 0.95]), dim=1).mT)

    @property
    def expected_alignment(self) -> Tensor:
        """(B n+1), how well the belief expects to be aligned with the person, from 0 to 1: before
        the first answer, and after each."""
        squares = torch.stack([state["mean"].square().sum(-1) for state in self._states], 1)
        return self._plain(expected_alignment(squares, self._states[-1]["samples"].shape[1]))

    @property
    def likelihoods(self) -> Tensor:
        """(B n), how probable each answer is, now that all are known; 1 where a person would not
        say."""
        state, model = self._states[-1], self._belief.response_model
        options = state["history"]["options"][:, : self.n_answered]
        if not self.n_answered:
            return self._plain(options.new_ones(len(options), 0))
        answers = torch.stack([answers for _, answers in self._turns], 1)
        return self._plain(likelihoods(state["samples"], options, answers, model))

    def score(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The reward of trajectories, and how sure that is.

        Args:
            features: (n D), raw where the session knows the normaliser, else normalised.

        Returns:
            (B n) and (B n), mean and standard deviation over the samples. No gradients flow through
            them: those of a :class:`reward.Reward` are for that.

        Raises:
            InputError: the features are not (n D) finite numbers.
        """
        check_finite("features", check_plain("features", features))
        if features.ndim != 2 or features.shape[-1] != self.pool.n_features:
            raise InputError(
                f"features of shape {tuple(features.shape)}: expected (n, {self.pool.n_features})"
            )
        features = features.detach()
        if self.normalizer is not None:
            features = self.normalizer(features)
        mean, deviation = scores(directions(self._states[-1]["samples"]), features.float())
        return self._plain(mean), self._plain(deviation)

    def _plain(self, tensor: Tensor) -> Tensor:
        """Without the leading B where there is one person."""
        return tensor[0] if self.people is None else tensor


def summary(samples: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean, standard deviation, 5% and 95% quantile (B D) of directions (B M D)."""
    low, high = torch.quantile(samples, samples.new_tensor([0.05, 0.95]), dim=1)
    return samples.mean(1), samples.std(1), low, high


def scores(samples: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (… n) of the reward of features (n D) over directions (… M D)."""
    rewards = samples.double() @ features.double().mT  # whose squares float32 may not hold
    return rewards.mean(-2).to(samples), rewards.std(-2).to(samples)


def expected_alignment(squares: Tensor, n_samples: int) -> Tensor:
    """How well beliefs expect the direction of their mean to be aligned with the person.

    The person's ω is as any sample, but none of those that made the mean: the mean cosine between
    the mean's direction and *another* sample. Of M samples, each of length 1, the mean of length m
    has it at (m² - 1/M) / (m (1 - 1/M)), which is about 0 where nothing is known.

    Args:
        squares: (…), the squared length m² of the mean of the samples' directions.
        n_samples: M.

    Returns:
        (…), from 0 to 1.
    """
    others = (n_samples * squares - 1) / (n_samples - 1)
    return (others / squares.sqrt().clamp(min=1e-12)).clamp(0, 1)


def expected_gain(samples: Tensor, options: Tensor, response_model: ResponseModel) -> Tensor:
    """(B), what the answer to a question is expected to add to the expected alignment, at most.

    The gain is of the squared length of the mean (:func:`acquisition.functions.alignment_gain`),
    and the expected alignment is concave in that: by Jensen's inequality what belongs to the
    expected square is never less than what is expected.

    Args:
        samples: (B M D), the belief.
        options: (B K D), the question.
        response_model: how the belief thinks that people answer.
    """
    gain = score_queries(samples, options.unsqueeze(1), response_model, alignment_gain).squeeze(-1)
    before, n_samples = directions(samples).mean(1).square().sum(-1), samples.shape[1]
    return expected_alignment(before + gain, n_samples) - expected_alignment(before, n_samples)


def likelihoods(
    samples: Tensor, options: Tensor, answers: Tensor, response_model: ResponseModel
) -> Tensor:
    """(B H), how probable the belief holds answers to be that it knows; 1 where there is none.

    Args:
        samples: (B M D), the belief.
        options: (B H K D), what was asked.
        answers: (B H), negative where there is none.
        response_model: how the belief thinks that people answer.
    """
    probs = mean_answers(samples, options, response_model)
    given = probs.gather(-1, answers.clamp(min=0).unsqueeze(-1)).squeeze(-1)
    return torch.where(answers < 0, 1.0, given)
