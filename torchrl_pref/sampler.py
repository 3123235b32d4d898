"""The Markov step of the belief: slice sampling on the unit sphere along great circles.

Shapes: S sessions, M samples, C = S·M chains, H answers, K options per query, D features.

A slice sampler (Neal, 2003) restricted to a great circle through the current point (Habeck,
Hasenpflug, Kodgirwar and Rudolf, *Geodesic slice sampling on the sphere*, 2023). It has no step
size to tune and works for hard answers, whose likelihood is zero on one side.
"""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.responses import ResponseModel

MAX_SHRINKS = 12
"""Shrinks of a bracket before a sample stays where it is. The same shrinks lead back from where it
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

    The posterior is left invariant if a pole is drawn independently of its sample. On that
    circle the uniform measure of the sphere has density |sin ∠(ω, pole)|^(D-2): the meridians of a
    sphere crowd at its poles.

    Args:
        samples: (S M D), unit vectors.
        poles: (S M D), of any length above zero.
        answers: (S H K-1 D), feature gaps of the answers; zero rows are ignored.
        slack: (S), by how much the return gaps of the last answer are raised.
        response_model: the likelihood.
        generator: the source of randomness, on the device of the samples.

    Returns:
        (S M D), unit vectors.
    """
    n_sessions, n_samples, n_features = samples.shape
    along = (poles * samples).sum(-1, keepdim=True)
    across = poles - along * samples
    height = across.norm(dim=-1, keepdim=True).clamp(min=1e-20)
    tangents = across / height
    pole_angle = torch.atan2(height, along).reshape(-1)

    # Chains are innermost in memory: every operation below then runs along them.
    size = (*answers.shape[1:3], n_sessions * n_samples)
    rows = answers.flatten(1, 2)
    cosine = (rows @ samples.mT).transpose(0, 1).reshape(size)
    sine = (rows @ tangents.mT).transpose(0, 1).reshape(size)
    raised = slack.repeat_interleave(n_samples)

    def log_density(angle: Tensor, circle: tuple[Tensor, ...]) -> Tensor:
        """(c), of the points at ``angle`` (c) on some circles."""
        cosine, sine, raised, pole_angle = circle
        gaps = torch.addcmul(cosine * angle.cos(), sine, angle.sin())
        gaps[-1] += raised
        meridian = (pole_angle - angle).sin().abs().clamp(min=1e-30).log()
        likelihood = response_model.joint_log_likelihood(gaps.movedim(-1, 0))
        return likelihood + (n_features - 2) * meridian

    angle = torch.zeros_like(pole_angle)
    uniform = torch.rand((2, len(angle)), generator=generator, device=angle.device)
    circle: tuple[Tensor, ...] = (cosine, sine, raised, pole_angle)
    threshold = log_density(angle, circle) + uniform[0].log()
    # Every factor of the density is at most one, so no single answer falls below the threshold.
    least = response_model.least_gap(threshold).repeat(*size[:2], 1)
    least[-1] -= raised
    low, high = bracket(cosine, sine, least, uniform[1])
    todo = torch.arange(len(angle), device=angle.device)
    for _ in range(MAX_SHRINKS):
        fraction = torch.rand(todo.shape, generator=generator, device=angle.device)
        proposal = torch.lerp(low, high, fraction)
        value = log_density(proposal, circle)
        accepted = (value >= threshold) & (value > -math.inf)
        angle[todo[accepted]] = proposal[accepted]
        left = (~accepted).nonzero().squeeze(-1)
        if left.numel() == 0:
            break
        todo, proposal, threshold = todo[left], proposal[left], threshold[left]
        circle = tuple(part.index_select(-1, left) for part in circle)
        high = torch.where(proposal > 0, proposal, high[left])
        low = torch.where(proposal > 0, low[left], proposal)
    turn = angle.view(n_sessions, n_samples, 1)
    return F.normalize(samples * turn.cos() + tangents * turn.sin(), dim=-1)


def bracket(cosine: Tensor, sine: Tensor, least: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """The stretch of each circle around angle 0 in which every gap is at least ``least``.

    A gap at angle θ is a·cos θ + b·sin θ. Where it equals g, the half angle has the cotangent
    (a + g) / (b ± √(a² + b² - g²)) = -(b ∓ √(a² + b² - g²)) / (a - g). The cotangent falls over
    (0, π), so the nearest crossing on either side is an extreme of the cotangents, and only one
    inverse per chain is needed.

    Args:
        cosine, sine: (H K-1 C), a and b of each gap.
        least: (H K-1 C) or broadcastable, g; where g exceeds a, rounding is at work.
        uniform: (C), places the bracket of a circle without crossings.

    Returns:
        Two (C): from below 0 to above 0, at most 2π apart.
    """
    root = (cosine.square() + sine.square() - least.square()).sqrt()  # NaN: no crossing
    size = sine.abs() + root
    # The same two quotients, each in the form that does not cancel.
    near = (cosine + least) / size.clamp(min=1e-30)
    far = size / (cosine - least).clamp(min=1e-30)
    rising = sine >= 0
    upper, lower = torch.where(rising, near, far), torch.where(rising, -far, -near)
    cotangent_high = upper.nan_to_num(nan=-math.inf).amax((0, 1))
    cotangent_low = lower.nan_to_num(nan=math.inf).amin((0, 1))
    one = torch.ones_like(uniform)
    high = 2 * torch.atan2(one, cotangent_high)
    low = -2 * torch.atan2(one, -cotangent_low)
    closed = torch.isinf(cotangent_high) & torch.isinf(cotangent_low)
    high = torch.where(closed, 2 * math.pi * uniform, high)
    return torch.where(closed, high - 2 * math.pi, low), high
