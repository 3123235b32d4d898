"""The Markov step of the belief: slice sampling on the unit sphere along great circles.

Shapes: S sessions, M samples, H answers, K options per query, D features, U uniforms of a step.

A slice sampler (Neal, 2003) restricted to a great circle through the current point (Habeck,
Hasenpflug, Kodgirwar and Rudolf, *Geodesic slice sampling on the sphere*, 2023). It has no step
size that must be right, and works for hard answers, whose likelihood is zero on one side.

The step is here twice: in tensors, for any response model on any device, and in ``sampler_cpu.py``
as a compiled loop, for the models of this package on the CPU. Given the same uniforms both move a
sample to the same place, but for rounding at the very edge of a slice.
"""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.responses import Boltzmann, Optimal, ResponseModel
from torchrl_pref.sampler_cpu import compiled_step

ARC = 32.0
"""Length of the arc that is searched, in standard deviations of the posterior along it. A short
one slows the mixing, a long one costs a shrink for each doubling."""

MAX_SHRINKS = 16
"""Shrinks of an arc before a sample stays where it is. The same shrinks lead back from where it
would have gone, so that giving up leaves the posterior invariant too."""


def great_circle_step(
    samples: Tensor,
    poles: Tensor,
    answers: Tensor,
    slack: Tensor,
    response_model: ResponseModel,
    generator: Generator,
) -> Tensor:
    """Move every sample once, along the great circle through it and its pole.

    The posterior is left invariant if a pole does not depend on its sample. On that circle the
    uniform measure of the sphere has density |sin ∠(ω, pole)|^(D-2): the meridians of a sphere
    crowd at its poles.

    Args:
        samples: (S M D), unit vectors.
        poles: (S M D), as long as the posterior is wide in their direction, above zero.
        answers: (S H K-1 D), feature gaps of at least one answer; zero rows are ignored.
        slack: (S), by how much the return gaps of the last answer are raised.
        response_model: the likelihood.
        generator: the source of randomness, on the device of the samples.

    Returns:
        (S M D), unit vectors.
    """
    size = (*samples.shape[:2], 2 + MAX_SHRINKS)
    uniform = torch.rand(size, generator=generator, dtype=samples.dtype, device=samples.device)
    given = samples, poles, answers, slack, uniform
    constants = compiled_constants(response_model)
    if samples.is_cpu and constants is not None:
        return compiled_step(*given, ARC, *constants)
    return tensor_step(*given, response_model)


def compiled_constants(response_model: ResponseModel) -> tuple[float, float] | None:
    """What ``sampler_cpu.compiled_step`` knows a model by: tau and tolerance; None for others."""
    if isinstance(response_model, Boltzmann):
        return response_model.tau, 0.0
    if isinstance(response_model, Optimal):
        return math.inf, response_model.tolerance
    return None


def tensor_step(
    samples: Tensor,
    poles: Tensor,
    answers: Tensor,
    slack: Tensor,
    uniform: Tensor,
    response_model: ResponseModel,
) -> Tensor:
    """:func:`great_circle_step` in tensors, with its uniforms (S M U) in [0, 1) given.

    Every sample goes through all shrinks, also when it has found its place, so that nothing has
    to be counted and no device is waited for.
    """
    power = samples.shape[-1] - 2
    along = (poles * samples).sum(-1, keepdim=True)
    across = poles - along * samples
    height = across.norm(dim=-1, keepdim=True).clamp(min=1e-20)
    tangents = across / height
    pole_angle = torch.atan2(height, along).squeeze(-1)
    # Samples are innermost in memory: every operation below then runs along them.
    size = (*answers.shape[:3], samples.shape[1])
    rows = answers.flatten(1, 2)
    cosine = (rows @ samples.mT).view(size).permute(1, 2, 0, 3).contiguous()
    sine = (rows @ tangents.mT).view(size).permute(1, 2, 0, 3).contiguous()

    def log_density(angle: Tensor) -> Tensor:
        """(S M), of the points at an angle (S M) on their circles."""
        gaps = torch.addcmul(cosine * angle.cos(), sine, angle.sin())
        gaps[-1] += slack.unsqueeze(-1)
        meridian = (pole_angle - angle).sin().abs().clamp(min=1e-30).log()
        return response_model.joint_log_likelihood(gaps.permute(2, 3, 0, 1)) + power * meridian

    place, level, *fractions = uniform.unbind(-1)
    angle = torch.zeros_like(pole_angle)
    threshold = log_density(angle) + torch.log1p(-level)
    threshold = threshold.clamp(min=torch.finfo(threshold.dtype).min)  # the impossible stays below
    arc = (ARC * poles.norm(dim=-1)).clamp(max=2 * math.pi)
    high = place * arc
    low = high - arc
    found = torch.zeros_like(angle, dtype=torch.bool)
    for fraction in fractions:
        proposal = torch.lerp(low, high, fraction)
        accepted = log_density(proposal) >= threshold
        angle = torch.where(accepted & ~found, proposal, angle)
        found |= accepted
        ahead = proposal > 0
        low, high = torch.where(ahead, low, proposal), torch.where(ahead, proposal, high)
    angle = angle.unsqueeze(-1)
    return F.normalize(samples * angle.cos() + tangents * angle.sin(), dim=-1)
