"""The belief over the reward weights ω: samples on the unit sphere, batched over sessions.

Shapes: S sessions, M samples, H answers, K options per query, D features.

The prior is uniform on the unit sphere: alignment ignores the scale of ω, and tau carries it.
After each answer the samples take a step of *resample-move* (Gilks and Berzuini, 2001): reweight by
the likelihood of the new answer, resample, then move every sample with Markov steps that leave the
new posterior invariant (see ``sampler.py``). An answer that too few samples agree with is let in by
stages, see :meth:`Belief.update`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.checks import check_finite, check_range
from torchrl_pref.errors import check_count, check_type
from torchrl_pref.responses import ResponseModel
from torchrl_pref.sampler import great_circle_step

MAX_STAGES = 12
"""Twelve stages that keep a quarter each: what no sample agrees with then is a contradiction."""

MOVED = 2**18
"""Samples that are moved at once: bounds memory whatever the number of sessions."""

MIN_SHARE = 0.25
"""Kish effective share of the samples that a reweighting must keep; below it a stage is added."""


def uniform_sphere(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw weights uniformly on the unit sphere, (… D), on the generator's device."""
    normal = torch.randn(shape, generator=generator, device=generator.device)
    return F.normalize(normal, dim=-1)


def orthonormal(n: int, shape: torch.Size, generator: Generator) -> Tensor:
    """Random unit vectors (n … D) for a shape (… D), each at right angles to those before it.

    They come in frames of D: moves along them, preconditioned, undo nothing of each other, so that
    n = D of them do what half as many again do in independent directions.
    """
    vectors = torch.randn((n, *shape), generator=generator, device=generator.device)
    for i in range(n):
        for j in range(i - i % shape[-1], i):
            vectors[i] -= (vectors[i] * vectors[j]).sum(-1, keepdim=True) * vectors[j]
        vectors[i] = F.normalize(vectors[i], dim=-1)
    return vectors


def feature_gaps(queries: Tensor, answers: Tensor) -> Tensor:
    """How the features of the chosen option exceed those of the others.

    Args:
        queries: (… K D), features of the options.
        answers: (…), index of the chosen option, or -1 where there is no answer yet.

    Returns:
        (… K-1 D). Zero where there is no answer, which makes that likelihood constant in ω.

    Raises:
        InputError: an answer is no whole number from -1 to K-1.
    """
    n_options = queries.shape[-2]
    answers = check_range("answers", answers, -1, n_options - 1, "options from 0, -1 where none")
    shifts = torch.arange(1, n_options, device=queries.device)
    others = (answers.unsqueeze(-1) + shifts) % n_options
    chosen = torch.take_along_dim(queries, answers.clamp(min=0)[..., None, None], -2)
    gaps = chosen - torch.take_along_dim(queries, others.unsqueeze(-1), -2)
    return gaps * (answers >= 0)[..., None, None]


class Update(NamedTuple):
    """What an answer makes of the belief."""

    samples: Tensor
    """(S M D), samples of the posterior."""
    ess: Tensor
    """(S), effective sample size of the mean, between 1 and M."""
    used: Tensor
    """(S) bool, False where the answer contradicts the earlier ones and was left out."""


class Belief:
    """Posterior samples of ω under an assumed response model.

    Args:
        response_model: how the belief thinks the human answers. It may differ from how they do.
        samples: M, at least 2.
        moves: Markov steps after each resampling, at least 1. More moves, higher effective sample
            size, more time.

    Raises:
        InputError: there is no response model, or ``samples`` or ``moves`` is too small.
    """

    def __init__(self, response_model: ResponseModel, samples: int = 100, moves: int = 4) -> None:
        check_type("response_model", response_model, ResponseModel, "Boltzmann(2.0)")
        self.response_model = response_model
        self.n_samples = check_count("belief.samples", samples, 2)
        self.n_moves = check_count("belief.moves", moves, 1)

    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """Samples of the prior, (S M D)."""
        return uniform_sphere((n_sessions, self.n_samples, n_features), generator)

    def update(
        self, samples: Tensor, ess: Tensor, earlier: Tensor, newest: Tensor, generator: Generator
    ) -> Update:
        r"""Condition on one more answer per session.

        Reweighting by an answer that few samples agree with would leave copies of a handful; a hard
        answer could leave none. The answer is then let in by stages: its return gaps are raised by
        a slack, the smallest that keeps ``MIN_SHARE`` of the samples effective, and the stages end
        at a slack of zero, which is the exact posterior.

        The effective sample size follows the samples through it all. Resampling multiplies the
        variance of the mean by the average multiplicity :math:`\sum_i n_i^2 / M`; moves with
        correlation :math:`\rho` between a sample's place before and after leave :math:`\rho^2` of
        the excess. M divided by that inflation is the size of an independent sample as good for
        estimating the mean.

        Args:
            samples: (S M D), samples of the belief before the answer.
            ess: (S), their effective sample size.
            earlier: (S H K-1 D), :func:`feature_gaps` of the earlier answers; zero rows are
                ignored, H may be 0.
            newest: (S K-1 D), feature gaps of the answer to condition on.
            generator: the source of all randomness, on the device of the samples.

        Raises:
            InputError: a sample or a gap is not finite.
        """
        check_finite("samples or feature gaps", samples, earlier, newest)
        size = max(1, MOVED // self.n_samples)
        updates = []
        for first in range(0, max(1, len(samples)), size):
            some = slice(first, first + size)
            session = samples[some], ess[some], earlier[some], newest[some]
            updates.append(self._update(*session, generator))
        return Update(*(torch.cat(field) for field in zip(*updates, strict=True)))

    def _update(
        self, samples: Tensor, ess: Tensor, earlier: Tensor, newest: Tensor, generator: Generator
    ) -> Update:
        """:meth:`update` for as many sessions as are held in memory at once."""
        result = samples.clone()
        inflation = self.n_samples / ess
        slack = torch.full_like(ess, math.inf)
        todo = torch.arange(len(samples), device=samples.device)
        for stage in range(MAX_STAGES):
            if todo.numel() == 0:
                break
            gaps = torch.einsum("smd,skd->smk", result[todo], newest[todo])
            log_now = self._log_likelihood(gaps, slack[todo])
            next_slack = self._next_slack(gaps, slack[todo], log_now)
            if stage == MAX_STAGES - 1:
                # Better a few copies than no answer: only an impossible one is left out.
                possible = self._log_likelihood(gaps, torch.zeros_like(next_slack)) > -math.inf
                next_slack = torch.where(possible.any(1), 0.0, next_slack)
            slack[todo] = next_slack
            log_weights = self._log_likelihood(gaps, slack[todo]) - log_now
            answers = torch.cat([earlier[todo], newest[todo].unsqueeze(1)], 1)
            result[todo], inflation[todo] = self._resample_move(
                result[todo], inflation[todo], log_weights, answers, slack[todo], generator
            )
            todo = todo[slack[todo] > 0]
        used = slack == 0
        return Update(
            torch.where(used[:, None, None], result, samples),
            torch.where(used, self.n_samples / inflation, ess),
            used,
        )

    def _log_likelihood(self, gaps: Tensor, slack: Tensor) -> Tensor:
        """(S M), of one answer with gaps (S M K-1) raised by slack (S); infinite slack gives 0."""
        raised = gaps + slack.nan_to_num(posinf=0.0)[:, None, None]
        log_likelihood = self.response_model.log_likelihood(raised)
        return log_likelihood.masked_fill(slack.isinf()[:, None], 0.0)

    def _next_slack(self, gaps: Tensor, slack: Tensor, log_now: Tensor) -> Tensor:
        """(S), the smallest slack that keeps enough of the samples effective, by bisection."""

        def keeps_enough(candidate: Tensor) -> Tensor:
            log_weights = self._log_likelihood(gaps, candidate) - log_now
            return kish_share(log_weights) >= MIN_SHARE

        low = torch.zeros_like(slack)
        enough = keeps_enough(low)
        if enough.all():
            return low
        # At this slack every sample agrees, so the weights differ by a factor of at most K.
        high = torch.minimum(slack, (-gaps).amax((1, 2)).clamp(min=0))
        for _ in range(25):
            middle = (low + high) / 2
            fits = keeps_enough(middle)
            low, high = torch.where(fits, low, middle), torch.where(fits, middle, high)
        return torch.where(enough, 0.0, high)

    def _resample_move(
        self,
        samples: Tensor,
        inflation: Tensor,
        log_weights: Tensor,
        answers: Tensor,
        slack: Tensor,
        generator: Generator,
    ) -> tuple[Tensor, Tensor]:
        """New samples (S M D) and the inflation (S) of the variance of their mean."""
        chosen = systematic_resample(log_weights, generator)
        copies = torch.zeros_like(log_weights).scatter_add_(1, chosen, torch.ones_like(log_weights))
        inflation = inflation * copies.square().mean(1)
        start = samples.gather(1, chosen.unsqueeze(-1).expand_as(samples))
        # Circles are turned to where the samples spread. Each sample is 1/M of that spread:
        # adaptive, and exact only as M grows. The floor keeps every direction possible.
        covariance = covariance_of(start)
        floor = 1e-6 * covariance.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-12)
        covariance.diagonal(dim1=-2, dim2=-1).add_(floor.unsqueeze(-1))
        scale = torch.linalg.cholesky_ex(covariance).L
        moved = start
        for directions in orthonormal(self.n_moves, start.shape, generator):
            # As long as a Gaussian with this covariance is wide in the direction of the pole.
            poles = directions @ scale.mT
            moved = great_circle_step(moved, poles, answers, slack, self.response_model, generator)
        kept = _correlation(start, moved).clamp(min=0).square()
        return moved, (1 + kept * (inflation - 1)).clamp(max=self.n_samples)


def kish_share(log_weights: Tensor) -> Tensor:
    """Kish's effective share of weighted samples, (Σw)² / (M Σw²), for log-weights (… M)."""
    highest = log_weights.amax(-1, keepdim=True)
    weights = (log_weights - highest.nan_to_num(neginf=0.0)).exp()
    total, square = weights.sum(-1).square(), weights.square().sum(-1)
    return total / (square * log_weights.shape[-1]).clamp(min=1e-30)


def systematic_resample(log_weights: Tensor, generator: Generator) -> Tensor:
    """Indices (S M) of samples drawn in proportion to their weights (S M) with one uniform each."""
    n_samples = log_weights.shape[-1]
    cumulative = log_weights.softmax(-1).cumsum(-1, dtype=torch.float64)
    offset = torch.rand((len(log_weights), 1), generator=generator, device=log_weights.device)
    steps = torch.arange(n_samples, device=log_weights.device)
    points = (steps + offset.double()) / n_samples * cumulative[:, -1:]
    return torch.searchsorted(cumulative, points).clamp(max=n_samples - 1)


def covariance_of(samples: Tensor) -> Tensor:
    """Covariance (… D D) of belief samples (… M D)."""
    centred = samples - samples.mean(-2, keepdim=True)
    return centred.mT @ centred / samples.shape[-2]


def _correlation(before: Tensor, after: Tensor) -> Tensor:
    """(S), correlation of the samples' places, summed over features."""
    before = before - before.mean(1, keepdim=True)
    after = after - after.mean(1, keepdim=True)
    spread = before.square().sum((1, 2)) * after.square().sum((1, 2))
    return (before * after).sum((1, 2)) / spread.sqrt().clamp(min=1e-20)
