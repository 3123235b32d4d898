"""The Markov moves of the belief: slice sampling on the unit sphere along great circles.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, V
moves, P sets of samples that share a pole, U uniforms of a move.

A slice sampler (Neal, 2003) restricted to a great circle through the current point (Habeck,
Hasenpflug, Kodgirwar and Rudolf, *Geodesic slice sampling on the sphere*, 2023). It has no step
size that must be right, and works for hard answers, whose likelihood is zero on one side.

The move is here twice: in tensors, for any response model on any device, and in ``slice_cpu.py``
as a compiled loop, for the models of this package on the CPU. Given the same uniforms both move a
sample to the same place, but for rounding at the very edge of a slice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.beliefs.resampling import FRAMES, group_of, poles_of
from torchrl_pref.beliefs.slice_cpu import move_sessions
from torchrl_pref.compiled import over_sessions
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import compiled_constants

ARC = 32.0
"""Length of the arc that is searched, in standard deviations of the posterior along it. A short
one slows the mixing, a long one costs a shrink for each doubling."""

MAX_SHRINKS = 16
"""Shrinks of an arc before a sample stays where it is. The same shrinks lead back from where it
would have gone, so that giving up leaves the posterior invariant too."""


class Target(NamedTuple):
    """A density on the sphere: a power of the likelihood of all answers, the last one eased."""

    answers: Evidence
    """(S H), of at least one answer."""
    slack: Tensor
    """(S), by how much the return gaps of the last answer are raised further."""
    power: Tensor
    """(S), to which the likelihood is raised."""
    response_model: ResponseModel
    """The likelihood."""
    scales: Tensor | None = None
    """(S 2 M), by what each sample multiplies the returns of its direction, and the answers'
    floors, which are for lapses; None: 1."""

    def floor(self) -> Tensor:
        """(S M H) or (S 1 H), of the answers."""
        floor = self.answers.floor.unsqueeze(1)
        return floor if self.scales is None else floor * self.scales[:, 1].unsqueeze(-1)

    def returns(self, vectors: Tensor) -> Tensor:
        """(H F J S M), of the answers' rows under vectors (S M D).

        Samples are innermost in memory: what is computed of them then runs along them.
        """
        rows = self.answers.rows
        flat = (rows.flatten(1, -2) @ vectors.mT).view(*rows.shape[:-1], vectors.shape[1])
        return flat.permute(1, 2, 3, 0, 4).contiguous()

    def raised(self, returns: Tensor) -> Tensor:
        """By what the returns (H F J S M) are raised: the offsets, and the slack of the last."""
        offsets = self.answers.offsets.permute(1, 2, 3, 0).unsqueeze(-1)
        raised = offsets.expand_as(returns).clone()
        raised[-1] += self.slack.unsqueeze(-1)
        return raised

    def of(self, sessions: Tensor) -> Target:
        """The same for some of the sessions."""
        scales = None if self.scales is None else self.scales[sessions]
        some = self.answers[sessions], self.slack[sessions], self.power[sessions]
        return Target(*some, self.response_model, scales)


def round_of_moves(
    samples: Tensor,
    n_moves: int,
    target: Target,
    generator: Generator,
) -> Tensor:
    """Move every sample V times, each time along the great circle through it and a pole.

    The posterior is left invariant if a pole does not depend on the samples that move towards it:
    it is drawn from the spread of the other groups. On a circle the uniform measure of the sphere
    has density |sin ∠(ω, pole)|^(D-2): the meridians of a sphere crowd at its poles.

    Args:
        samples: (S M D).
        n_moves: V.
        target: what the moves leave invariant.
        generator: the source of randomness, on the device of the samples.

    Returns:
        (S M D), unit vectors.
    """
    n_sessions, n_samples, n_features = samples.shape
    device = samples.device
    shape = (n_sessions, FRAMES, n_moves, n_features)
    normal = torch.randn(shape, generator=generator, device=device)
    size = (n_moves, n_sessions, n_samples, 2 + MAX_SHRINKS)
    uniform = torch.rand(size, generator=generator, device=device)
    poles = poles_of(samples, normal)
    constants = compiled_constants(target.response_model)
    if samples.is_cpu and constants is not None:
        answers, slack, power, _, scales = target
        scales = samples.new_ones(n_sessions, 2, n_samples) if scales is None else scales
        evidence = answers.rows, answers.offsets, answers.floor, scales
        return compiled_moves(samples, poles, uniform, *evidence, slack, power, ARC, *constants)
    return tensor_moves(samples, poles, uniform, target)


def tensor_moves(samples: Tensor, poles: Tensor, uniform: Tensor, target: Target) -> Tensor:
    """:func:`round_of_moves` in tensors, with poles (V S P D) and uniforms (V S M U) given.

    Returns:
        (S M D), unit vectors.
    """
    group = group_of(samples.shape[1], poles.shape[2], samples.device)
    for ahead, luck in zip(poles, uniform, strict=True):
        samples = _tensor_move(samples, ahead[:, group], luck, target)
    return samples


def _tensor_move(samples: Tensor, poles: Tensor, uniform: Tensor, target: Target) -> Tensor:
    """One move of samples (S M D) towards a pole each (S M D), with uniforms (S M U).

    Every sample goes through all shrinks, also when it has found its place, so that nothing has
    to be counted and no device is waited for.
    """
    meridians = samples.shape[-1] - 2
    along = (poles * samples).sum(-1, keepdim=True)
    across = poles - along * samples
    height = across.norm(dim=-1, keepdim=True).clamp(min=1e-20)
    tangents = across / height
    pole_angle = torch.atan2(height, along).squeeze(-1)
    # Samples are innermost in memory: every operation below then runs along them.
    cosine, sine = target.returns(samples), target.returns(tangents)
    raised = target.raised(cosine)
    if target.scales is not None:
        cosine, sine = cosine * target.scales[:, 0], sine * target.scales[:, 0]
    floor = target.floor()

    def log_density(angle: Tensor) -> Tensor:
        """(S M), of the points at an angle (S M) on their circles."""
        gaps = torch.addcmul(cosine * angle.cos(), sine, angle.sin()) + raised
        model = target.response_model
        likelihood = model.joint_log_likelihood(gaps.permute(3, 4, 0, 1, 2), floor)
        meridian = (pole_angle - angle).sin().abs().clamp(min=1e-30).log()
        return target.power.unsqueeze(-1) * likelihood + meridians * meridian

    place, level, *fractions = uniform.unbind(-1)
    # Of two features there is but one circle, and going round it reaches every mode.
    arc = (ARC * poles.norm(dim=-1)).clamp(min=0 if meridians else 2 * math.pi, max=2 * math.pi)
    high = place * arc
    # Where the answers are possible is the same seen from each place there.
    circles = (part.flatten(0, 2) for part in (cosine, sine, raised))
    first, last = target.response_model.possible_arc(*circles)
    low, high = torch.maximum(high - arc, first), torch.minimum(high, last)
    here = torch.zeros_like(pole_angle)
    angle = slice_sample(log_density, here, low, high, level, fractions).unsqueeze(-1)
    return F.normalize(samples * angle.cos() + tangents * angle.sin(), dim=-1)


def slice_sample(
    log_density: Callable[[Tensor], Tensor],
    here: Tensor,
    low: Tensor,
    high: Tensor,
    level: Tensor,
    fractions: Sequence[Tensor],
) -> Tensor:
    """New places (S M) in the slices of a density, from an interval that shrinks to each proposal
    that is refused.

    Args:
        log_density: from places (S M) to its logarithm (S M).
        here: (S M), where the samples are; they stay where no proposal is in the slice.
        low, high: (S M), ends of the interval, about ``here``.
        level: (S M), in [0, 1), of the slice.
        fractions: (S M) each, in [0, 1), one for each proposal.
    """
    threshold = log_density(here) + torch.log1p(-level)
    threshold = threshold.clamp(min=torch.finfo(threshold.dtype).min)  # the impossible stays below
    place, found = here, torch.zeros_like(here, dtype=torch.bool)
    for fraction in fractions:
        proposal = torch.lerp(low, high, fraction)
        accepted = log_density(proposal) >= threshold
        place = torch.where(accepted & ~found, proposal, place)
        found |= accepted
        ahead = proposal > here
        low, high = torch.where(ahead, low, proposal), torch.where(ahead, proposal, high)
    return place


def compiled_moves(
    samples: Tensor,
    poles: Tensor,
    uniform: Tensor,
    rows: Tensor,
    offsets: Tensor,
    floor: Tensor,
    scales: Tensor,
    slack: Tensor,
    power: Tensor,
    arc: float,
    tau: float,
    tolerance: float,
) -> Tensor:
    """:func:`tensor_moves` for Boltzmann and optimal humans.

    Args:
        samples: (S M D).
        poles: (V S P D).
        uniform: (V S M U), in [0, 1): two, and one for each shrink.
        rows, offsets, floor: (S H F J D), (S H F J) and (S H), see ``questions.base.Evidence``.
        scales, slack, power: (S 2 M), (S) and (S), see :class:`Target`.
        arc: length of the arc that is searched, in lengths of the pole.
        tau: what the gaps are multiplied by; infinite for answers without error.
        tolerance: of answers without error: gaps this small are ties.

    Returns:
        (S M D), unit vectors.
    """
    moved = torch.empty_like(samples, memory_format=torch.contiguous_format)
    given = samples, poles, uniform, rows, offsets, floor, scales, slack, power, moved
    arrays = (t.contiguous().numpy() for t in given)
    over_sessions(move_sessions, len(samples), *arrays, arc, tau, tolerance)
    return moved
