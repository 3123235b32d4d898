"""A belief that infers how careful a person is, beside what they want.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, U
uniforms of a move.

A person's tau is never known. Here it is s times the response model's, with ln s normal and
independent of ω, and a sample is the vector s ω. Its return gaps are then s times
those of ω, so that the response model needs no change, and a threshold in logits stays what it is.
The samples move as those of ``sampled.Belief`` do, each on the sphere of its own length, and then
along their rays: by slice sampling (Neal, 2003) of ln s, given ω and all answers. Where the
response model has a lapse rate, that is inferred too: see ``lapses.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Generator, Tensor

from torchrl_pref.beliefs.lapses import LapseRates
from torchrl_pref.beliefs.lengths_cpu import stretch_sessions
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.beliefs.slice import MAX_SHRINKS, Target, slice_sample
from torchrl_pref.compiled import over_sessions
from torchrl_pref.errors import InputError, check_positive
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Optimal, compiled_constants
from torchrl_pref.tensors import directions, lengths

FARTHEST = 4.0
"""Standard deviations of ln s that are thought possible."""


class RationalityBelief(Belief):
    """Posterior samples of tau and ω together.

    Args:
        response_model: how the belief thinks that people answer; its tau is the middle of what is
            believed of theirs, and its lapse rate the mean; 0 is believed for certain.
        spread: the factor by which people's tau differs from the model's, either way: two in three
            are within it, and 19 in 20 within its square.
        samples: M, see :class:`Belief`; more than of ω alone, as each is of tau, too. With 100 the
            cosine of the mean after 20 answers was .006 to .009 lower on the Gridworld, on average
            over how careful people are (docs/beliefs.md).
        moves: of ω after each resampling, see :class:`Belief`; one of tau follows.

    Raises:
        InputError: there is no response model, or one of a human who never errs; or a number is
            out of its range, as is a lapse rate of a quarter or more.
    """

    def __init__(
        self,
        response_model: ResponseModel,
        spread: float = 3.0,
        samples: int = 300,
        moves: int | None = None,
    ) -> None:
        super().__init__(response_model, samples, moves)
        if isinstance(response_model, Optimal):
            raise InputError(
                "belief=rationality with a human who never errs: there is no tau to infer; "
                "expected tau=noisy or a number, or belief=sampled"
            )
        self.spread = check_positive("belief.spread", spread)
        if not 1 <= spread <= 1e6:
            raise InputError(
                f"belief.spread={spread}: expected a factor of at least 1, and at most 1e6; 1 is a "
                "tau that is known"
            )
        self._rates = LapseRates(response_model) if response_model.lapse else None

    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """Samples of the prior, (S M D)."""
        omega = super().prior(n_sessions, n_features, generator)
        normal = torch.randn(
            (n_sessions, self.n_samples, 1), generator=generator, device=generator.device
        )
        return omega * self.spread ** normal.clamp(-FARTHEST, FARTHEST)

    def _foreseen(self, samples: Tensor, answers: Evidence, likelihood: Tensor) -> Tensor:
        """See :meth:`Belief._foreseen`."""
        if self._rates is None:
            return likelihood
        return self._rates.raised(samples, answers)(samples.new_zeros(len(samples)))

    def _raised(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor], Tensor]:
        """See :meth:`Belief._raised`."""
        if self._rates is None:
            return super()._raised(samples, answers)
        return self._rates.raised(samples, answers)

    def _tempered(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor, Tensor], Tensor]:
        """See :meth:`Belief._tempered`."""
        if self._rates is None:
            return super()._tempered(samples, answers)
        return self._rates.tempered(samples, answers)

    def _move(self, samples: Tensor, target: Target, generator: Generator) -> Tensor:
        """See :meth:`Belief._move`; and along the rays, all with a lapse rate for each sample."""
        length = lengths(samples).squeeze(-1)
        odds = torch.ones_like(length)
        if self._rates is not None:
            odds = self._rates.draw(samples, target, generator)
        target = target._replace(scales=torch.stack([length, odds], 1))
        omega = super()._move(directions(samples), target, generator)
        size = (*length.shape, 1 + MAX_SHRINKS)
        uniform = torch.rand(size, generator=generator, device=length.device)
        return omega * move_lengths(omega, uniform, target, math.log(self.spread))


def move_lengths(omega: Tensor, uniform: Tensor, target: Target, deviation: float) -> Tensor:
    """One move of each sample along its ray, which leaves the target invariant.

    Args:
        omega: (S M D), the samples' directions.
        uniform: (S M U), in [0, 1): one, and one for each shrink.
        target: the likelihood, with the lengths that the samples have.
        deviation: of log-lengths before any answer.

    Returns:
        (S M 1), the lengths that they get.
    """
    deviation = max(deviation, 1e-6)
    constants = compiled_constants(target.response_model)
    if omega.is_cpu and constants is not None:
        return compiled_lengths(omega, uniform, target, deviation, constants[0])
    return tensor_lengths(omega, uniform, target, deviation)


def compiled_lengths(
    omega: Tensor, uniform: Tensor, target: Target, deviation: float, tau: float
) -> Tensor:
    """:func:`move_lengths` for Boltzmann humans on the CPU."""
    answers, slack, power, _, scales = target
    assert scales is not None
    moved = torch.empty_like(omega[..., 0], memory_format=torch.contiguous_format)
    evidence = answers.rows, answers.offsets, answers.floor, scales
    given = omega, uniform, *evidence, slack, power, moved
    arrays = (t.contiguous().numpy() for t in given)
    end = FARTHEST * deviation
    over_sessions(stretch_sessions, len(omega), *arrays, deviation, end, tau)
    return moved.unsqueeze(-1)


def tensor_lengths(omega: Tensor, uniform: Tensor, target: Target, deviation: float) -> Tensor:
    """:func:`move_lengths` in tensors."""
    assert target.scales is not None
    gaps, floor = target.returns(omega), target.floor()
    raised = target.raised(gaps)

    def log_density(log_length: Tensor) -> Tensor:
        """(S M), at log-lengths (S M)."""
        given = torch.addcmul(raised, gaps, log_length.exp()).permute(3, 4, 0, 1, 2)
        likelihood = target.response_model.joint_log_likelihood(given, floor)
        prior = -(log_length / deviation).square() / 2
        return prior + target.power.unsqueeze(-1) * likelihood

    end = FARTHEST * deviation
    level, *fractions = uniform.unbind(-1)
    here = target.scales[:, 0].log().clamp(-end, end)
    ends = torch.full_like(here, -end), torch.full_like(here, end)
    return slice_sample(log_density, here, *ends, level, fractions).exp().unsqueeze(-1)
