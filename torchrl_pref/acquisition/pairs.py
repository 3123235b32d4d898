"""What two samples that prefer different options have at stake: max regret and disagreement.

Both are defined in the literature for options that are free: a planner makes the best trajectory of
each of two samples, and the query is the two. Here the queries are there already, so a sample's
best option takes the place of its best trajectory, and a query is worth what the pair of samples is
worth that differs most about it. Samples are drawn from the posterior: each is as likely as any
other, and what the literature weighs by probability is weighed by being drawn.

Shapes: C candidate queries, M belief samples, K options per query, D features, P pairs, ``…`` any
leading dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_pref.questions.response_model import Prediction
from torchrl_pref.tensors import ROUNDING, directions, lengths

BELOW = 2.0**-25
"""Times a number: less than any digit that it has in single precision."""


def max_regret(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""The most that two samples would lose if each had the option that the other prefers.

    .. math:: \max_{\omega, \omega'} \; [\omega^\top \varphi_a - \omega^\top \varphi_b]
        + [\omega'^\top \varphi_b - \omega'^\top \varphi_a], \qquad
        a = \arg\max_k \omega^\top \varphi_k, \; b = \arg\max_k \omega'^\top \varphi_k

    Wilde, Kulić and Smith, *Active preference learning using maximum regret*, 2020, whose regret is
    a quotient of costs above zero; rewards may be zero or below, so it is a difference here. ω is
    the direction of a sample. The maximum over pairs is one maximum for each two options, as the
    two losses are of different samples. How carefully the human answers makes no difference.

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples.

    Returns:
        (… C), in units of the return; 0 where all samples prefer the same option, and where the
        options are alike.
    """
    losses = _losses(predicted, samples)
    best = _best(losses)
    # (… C K K): the most that a sample whose best option is a loses by b.
    most = torch.where(best.unsqueeze(-1), losses.unsqueeze(-2), -torch.inf).amax(-3)
    return (most + most.mT).amax((-2, -1)).clamp(min=0)


def disagreement(predicted: Prediction, samples: Tensor) -> Tensor:
    r"""How far apart two samples are, at most, that prefer different options.

    .. math:: \max_{\omega, \omega'} \; \lVert \omega - \omega' \rVert \quad \text{where} \quad
        \arg\max_k \omega^\top \varphi_k \neq \arg\max_k \omega'^\top \varphi_k

    Katz, Le Bihan and Kochenderfer, *Learning an urban air mobility encounter model from expert
    preferences*, 2019. ω is the direction of a sample. How carefully the human answers makes no
    difference, and there are no gradients by the options: it changes in steps.

    Most candidates have the same two samples in common. Of these that one is worth most in which
    the two have most at stake (the difference of :func:`max_regret`, of these two alone): the
    literature would plan the best trajectory of each, and this is the nearest that is there.

    Args:
        predicted: of the answers to C candidates, under M samples.
        samples: (… M D), the belief samples.

    Returns:
        (… C), from 0 to 2, in double precision: what is at stake shows in digits beyond those of
        the distance, and decides only between distances that are equal. 0 where all samples prefer
        the same option, and where the options are alike.
    """
    losses = _losses(predicted, samples).detach()
    best = _best(losses)
    apart, first, second = _farthest_first(directions(samples))
    found = torch.full(best.shape[:-2], -1, device=best.device)
    step = samples.shape[-2]
    for start in range(0, apart.shape[-1], step):
        block = slice(start, start + step)
        one, other = (
            torch.take_along_dim(best, which[..., None, block, None], -2)
            for which in (first, second)
        )
        differ = ~(one & other).any(-1)
        place = torch.where(differ.any(-1), start + differ.byte().argmax(-1), -1)
        found = torch.where(found < 0, place, found)
        # Pairs that are further apart come first: whoever has found one is done.
        if ((found >= 0) | best.all(-2).any(-1)).all():
            break
    pair = found.clamp(min=0)
    distance = apart.take_along_dim(pair, -1).double() * (found >= 0)
    stake = _stake(losses, best, first.take_along_dim(pair, -1), second.take_along_dim(pair, -1))
    return distance * (1 + BELOW * stake / (1 + stake))


def _stake(losses: Tensor, best: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """What two samples (… C) would lose (… C), in double precision, if each had the option that the
    other prefers, from losses and best options (… C M K)."""
    lost = torch.zeros_like(losses[..., 0, 0], dtype=torch.double)
    for one, other in ((first, second), (second, first)):
        mine = losses.take_along_dim(one[..., None, None], -2)
        theirs = best.take_along_dim(other[..., None, None], -2)
        lost += mine.masked_fill(~theirs, 0).amax((-2, -1))
    return lost


def _losses(predicted: Prediction, samples: Tensor) -> Tensor:
    """What each sample's direction loses (… C M K) by each option, against its best one."""
    returns = predicted.returns / lengths(samples).clamp(min=1e-30).unsqueeze(-3)
    return returns.amax(-1, keepdim=True) - returns


def _best(losses: Tensor) -> Tensor:
    """Which options (… C M K) are best for each sample: more than one where they tie but for
    rounding, so that no two samples differ about options that are alike."""
    return losses <= ROUNDING * losses.detach().amax((-2, -1), keepdim=True)


def _farthest_first(units: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs (… P) of unit vectors (… M D): their distances, falling, and who they are."""
    size = units.shape[-2]
    first, second = torch.triu_indices(size, size, 1, device=units.device)
    # Not by a product of matrices, which would lose small distances in rounding.
    exact = "donot_use_mm_for_euclid_dist"
    distances = torch.cdist(units, units, compute_mode=exact)[..., first, second]
    apart, order = distances.sort(-1, descending=True)
    return apart, first[order], second[order]
