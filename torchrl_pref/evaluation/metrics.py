"""Metrics by name: what a belief is worth, told by who knows the human.

Shapes: B sessions, M belief samples, N questions that nobody asks, K options per question, R
possible answers, D features, T trajectories, G bins.

What each means, and when it misleads, is in ``docs/metrics.md``. A metric of the answers looks at
how likely the human gives each answer, and not at answers that they gave: no luck enters. Nothing
here draws a random number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_pref.acquisition.scoring import mean_answers
from torchrl_pref.build import human_of, weigh_steps
from torchrl_pref.config.sections import Settings
from torchrl_pref.envs.objectives import alignment, alignment_of_mean
from torchrl_pref.pool import QueryPool
from torchrl_pref.problem import Problem
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import directions

QUESTIONS = 100
"""N: with more, evaluations would get slower by more than a tenth."""

BINS = 9
"""G, of the probability that an answer was predicted to have. Odd, so that ½ is the middle of one
and not where two meet: who knows nothing predicts it, and M samples scatter about it, by about .05
where M is 100. Narrower bins would tell those apart that differ by this luck alone."""

PARTS = ("answers", "predicted", "given")
"""Of a bin of :func:`reliability`."""


@dataclass(frozen=True)
class Exam:
    """What beliefs are examined by: questions that nobody asks.

    Attributes:
        queries: (N K D), as the belief sees them.
        seen: (N K D), as the human sees them.
        trajectories: (T D), among which a learned reward is to find the best.
        metrics: names of ``METRICS``.
    """

    queries: Tensor
    seen: Tensor
    trajectories: Tensor
    metrics: tuple[str, ...]

    def ranks(self, omega: Tensor) -> Tensor | None:
        """(B T), of the trajectories' rewards to humans (B D): told once, as sorting them takes
        longer than all else, and no answer changes them. None: no metric looks at them."""
        if "rank_correlation" not in self.metrics:
            return None
        return _centred_ranks(omega @ self.trajectories.mT)

    def without(self, name: str) -> Exam:
        """The same, but for one metric."""
        return replace(self, metrics=tuple(each for each in self.metrics if each != name))

    def to(self, device: torch.device) -> Exam:
        """The same on a device."""
        return replace(
            self,
            queries=self.queries.to(device),
            seen=self.seen.to(device),
            trajectories=self.trajectories.to(device),
        )


@dataclass(frozen=True)
class Standing:
    """The beliefs of sessions as they stand, and what they are judged by.

    Attributes:
        samples: (B M D), the beliefs.
        omega: (B D), the humans' weights.
        answers: (B N R), how likely the humans give each answer to the questions.
        exam: the questions.
        response_model: how the belief thinks that people answer.
        ranks: (B T), of the trajectories' rewards to the humans where they are known already, see
            :meth:`Exam.ranks`.
    """

    samples: Tensor
    omega: Tensor
    answers: Tensor
    exam: Exam
    response_model: ResponseModel
    ranks: Tensor | None = None

    @cached_property
    def predicted(self) -> Tensor:
        """(B N R), how likely the beliefs hold each answer to be."""
        queries = self.exam.queries.expand(len(self.samples), *self.exam.queries.shape)
        return mean_answers(self.samples, queries, self.response_model)

    @cached_property
    def rewards(self) -> tuple[Tensor, Tensor]:
        """(B T) and (B T), of the trajectories: to the humans, and as the beliefs expect."""
        learned = directions(self.samples).mean(-2)
        return self.omega @ self.exam.trajectories.mT, learned @ self.exam.trajectories.mT


def accuracy(standing: Standing) -> Tensor:
    """(B), how likely the answer that the belief holds most likely is what the human says.

    As the literature has it, who holds predictions against labels: a human who errs in a tenth of
    the answers is predicted in at most nine tenths. Answers that are equally likely share.
    """
    likely = standing.predicted
    picked = (likely >= likely.amax(-1, keepdim=True) - 1e-6).float()
    return ((standing.answers * picked).sum(-1) / picked.sum(-1)).mean(-1)


def log_likelihood(standing: Standing) -> Tensor:
    """(B), mean log-probability of the human's answers to the belief, in bits: at most 0.

    M samples cannot tell a probability below 1/M from 0, whose logarithm would be all that counts:
    one sample more, which holds all answers equally likely, is taken to be among them.
    """
    likely, n_samples = standing.predicted, standing.samples.shape[-2]
    likely = (n_samples * likely + 1 / likely.shape[-1]) / (n_samples + 1)
    return (standing.answers * likely.log2()).sum(-1).mean(-1)


def regret(standing: Standing) -> Tensor:
    """(B), what is lost by taking the trajectory that the belief expects most of, to the human.

    In units of what the best has over the mean one: 0 is the best of all, 1 as good as any.
    """
    true, learned = standing.rewards
    best = true.amax(-1)
    taken = true.gather(-1, learned.argmax(-1, keepdim=True)).squeeze(-1)
    return (best - taken) / (best - true.mean(-1)).clamp(min=1e-12)


def rank_correlation(standing: Standing) -> Tensor:
    """(B), Spearman's between the trajectories' rewards to the human and as the belief expects;
    0 where one of them is the same for all."""
    true, learned = standing.ranks, _centred_ranks(standing.rewards[1])
    true = _centred_ranks(standing.rewards[0]) if true is None else true
    lengths = (true.square().sum(-1) * learned.square().sum(-1)).sqrt()
    return (true * learned).sum(-1) / lengths.clamp(min=1e-12)


def _centred_ranks(values: Tensor) -> Tensor:
    """Ranks of values (B T) less their mean, in double; equal ones have the mean of theirs."""
    ordered, values = values.sort(-1).values, values.contiguous()
    below = torch.searchsorted(ordered, values)
    up_to = torch.searchsorted(ordered, values, right=True)
    return (below + up_to - values.shape[-1]).double() / 2


def reliability(standing: Standing) -> Tensor:
    """(B 3G), answers by how likely they were predicted to be, in G bins of equal width.

    Of each bin the number of answers that fall into it, the sum of what was predicted of them, and
    of how likely the human gives them.
    """
    predicted, given = (each.flatten(1) for each in (standing.predicted, standing.answers))
    bins = (predicted * BINS).long().clamp(0, BINS - 1)
    empty = predicted.new_zeros(len(predicted), BINS)
    parts = (torch.ones_like(predicted), predicted, given)
    sums = [empty.scatter_add(1, bins, part) for part in parts]
    return torch.cat(sums, -1)


def calibration(reliabilities: Tensor) -> Tensor:
    r"""(…), the expected calibration error of all B humans together.

    .. math:: \sum_g \frac{n_g}{n} \lvert \bar p_g - \bar q_g \rvert

    over bins g of all humans' answers together (Naeini, Cooper and Hauskrecht, *Obtaining well
    calibrated probabilities using Bayesian binning*, 2015), where q is how likely the human gives
    the answer. Of a single human a calibrated belief errs as well, either way: no human has a part
    of it.

    Args:
        reliabilities: (B … 3G), of :func:`reliability`.
    """
    parts = reliabilities.sum(0).unflatten(-1, (len(PARTS), BINS))
    answers, predicted, given = parts.unbind(-2)
    return (predicted - given).abs().sum(-1) / answers.sum(-1)


class Metric(NamedTuple):
    """What is measured, and how it is shown."""

    head: str
    """In tables."""
    axis: str
    """In figures."""
    measure: Callable[[Standing], Tensor]
    """(B) or (B 1), of each session; or (B 3G), of what :func:`calibration` makes one number."""


METRICS: dict[str, Metric] = {
    "alignment": Metric(
        "mean of cosines",
        "alignment (mean of cosines)",
        lambda standing: alignment(standing.samples, standing.omega),
    ),
    "alignment_of_mean": Metric(
        "cosine of mean",
        "cosine of the mean",
        lambda standing: alignment_of_mean(standing.samples, standing.omega),
    ),
    "accuracy": Metric("accuracy", "answers predicted", accuracy),
    "log_likelihood": Metric("log-likelihood", "log-likelihood of an answer, bits", log_likelihood),
    "regret": Metric("regret", "regret of the trajectory taken for best", regret),
    "rank_correlation": Metric("ranks", "rank correlation of rewards", rank_correlation),
    "calibration": Metric("calibration", "expected calibration error", reliability),
}
"""By name; the first two are measured in every evaluation."""

ALWAYS = ("alignment", "alignment_of_mean")


def make_exam(settings: Settings, task: Problem, pool: QueryPool) -> Exam | None:
    """What the settings ask to measure where questions are asked from a pool; None: nothing more.

    The questions are of the other of the task's two pools, from which nothing is asked: as many as
    ``QUESTIONS``, evenly spread over it; the trajectories are all that it has.
    """
    names = tuple(name for name in settings["evaluation"]["metrics"] if name not in ALWAYS)
    if not names:
        return None
    other = task.test if pool is task.train else task.train
    seen = weigh_steps(settings, human_of(settings, task), other)
    place = torch.linspace(0, len(other) - 1, min(QUESTIONS, len(other))).long()
    return Exam(
        queries=other.features[place],
        seen=(other.features if seen is None else task.normalizer(seen))[place],
        trajectories=other.features.flatten(0, 1),
        metrics=names,
    )


def measure(names: Sequence[str], standing: Standing) -> dict[str, Tensor]:
    """The metrics of these names, (B 1) or (B 3G) of each, in float32."""
    found = {name: METRICS[name].measure(standing).float() for name in names}
    return {name: value.view(len(value), -1) for name, value in found.items()}
