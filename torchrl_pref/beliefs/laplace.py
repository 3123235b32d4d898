"""A Gaussian approximation of the belief, for hundreds of features.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features, G
rows of all answers: of the H F J those that are there in some session.

The uniform prior of the sphere is taken to be a Gaussian with covariance I/D, whose draws are of
length 1 but for a deviation of 1/√2D. The posterior is taken to be a Gaussian about its mode, with
the curvature there (Laplace's approximation), and samples of it are stretched to length 1. Of a
skewed posterior the mode lies nearer to zero than the mean. The centre is therefore put out along
it to where the samples' mean squared length is 1, as the sphere demands: its own squared length is
then the number of *well-determined parameters* (MacKay, 1992) over D.

The mode is a sum of the answers' rows, so that Newton's steps take place in G numbers and not in D
(Rasmussen and Williams, *Gaussian processes for machine learning*, 2006, algorithm 3.1), and
samples are corrected draws of the prior (Matheron's rule; Wilson and others, *Pathwise
conditioning of Gaussian processes*, 2021). No matrix is D times D: an update costs O(G² D + G³).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.beliefs.base import BeliefBase, Update
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.config.memory import LAPLACE_HELD, LEAST_SAMPLES, laplace_numbers
from torchrl_pref.errors import InputError, check_count, check_type
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.tensors import check_finite

STEPS = 30
"""Of Newton's method at most; six are the rule."""

SHARES = (1.0, 0.5, 0.25, 0.125, 0.03125, 0.0)
"""Of a Newton step that are tried; the best is taken."""

GAIN = 1e-9
"""Newton's method ends where no step adds more to the log-posterior."""


class LaplaceBelief(BeliefBase):
    """Samples of a Gaussian about the likeliest ω.

    Every update begins with all answers and nothing else, so that nothing is forgotten and the
    samples are independent.

    Args:
        response_model: how the belief thinks that people answer.
        samples: M, at least 8.

    Raises:
        InputError: the response model is not ``Boltzmann``, or ``samples`` is too small.
    """

    def __init__(self, response_model: ResponseModel, samples: int = 100) -> None:
        check_type("response_model", response_model, ResponseModel, "Boltzmann(2.0)")
        if not isinstance(response_model, Boltzmann):
            raise InputError(
                f"belief=laplace with {response_model!r}: its likelihood has no curvature that is "
                "known; expected Boltzmann (tau=noisy or a number), or belief=sampled"
            )
        self.response_model: Boltzmann = response_model
        self.n_samples = check_count("belief.samples", samples, LEAST_SAMPLES)

    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """Samples of the uniform prior, (S M D)."""
        return uniform_sphere((n_sessions, self.n_samples, n_features), generator)

    def update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, generator: Generator
    ) -> Update:
        """See :meth:`BeliefBase.update`."""
        check_finite("samples or features of the answers", samples, answers.rows)
        there = rows_there(answers)
        size = LAPLACE_HELD // laplace_numbers(self.n_samples, len(there), samples.shape[-1])
        updates = []
        for some in torch.arange(len(samples), device=samples.device).split(max(1, size)):
            given = samples[some], ess[some], answers[some]
            updates.append(self._update(*given, there, generator))
        return Update(*(torch.cat(field) for field in zip(*updates, strict=True)))

    def _update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, there: Tensor, generator: Generator
    ) -> Update:
        """:meth:`update` for as many sessions as are held in memory at once, by the rows that
        :func:`rows_there` finds."""
        size, n_features = len(samples), samples.shape[-1]
        rows = answers.rows.flatten(1, -2)[:, there].double()
        found = find_mode(rows, there, answers, self.response_model)
        shape = (size, self.n_samples, n_features)
        draws = torch.randn(shape, generator=generator, device=samples.device).to(rows)
        shape = (size, self.n_samples, rows.shape[1])
        noise = torch.randn(shape, generator=generator, device=samples.device).to(rows)
        draws = draws / n_features**0.5
        # Answers as they would be measured, in units of their noise; the draws have others.
        seen = found.roots.mT @ rows
        inner = seen @ seen.mT / n_features + torch.eye(rows.shape[1]).to(rows)
        factor = torch.linalg.cholesky(inner)
        missing = torch.cholesky_solve((noise - draws @ seen.mT).mT, factor)
        # Of the variance of the prior this is gone, so that so much of the length 1 is known.
        gone = 1 - torch.cholesky_inverse(factor).diagonal(dim1=1, dim2=2)
        length = (gone.sum(1, keepdim=True) / n_features).clamp(0, 1).sqrt()
        centre = F.normalize(found.mode, dim=-1) * length
        after = centre.unsqueeze(1) + draws + missing.mT @ seen / n_features
        used = torch.ones(size, dtype=torch.bool, device=samples.device)
        after = F.normalize(after, dim=-1).to(samples)
        return Update(after, torch.full_like(ess, float(self.n_samples)), used)


class Mode(NamedTuple):
    """Where the posterior is highest, and how it falls from there."""

    mode: Tensor
    """(S D)."""
    roots: Tensor
    """(S G G), whose product with their own transpose is the curvature in the rows' returns."""


def rows_there(answers: Evidence) -> Tensor:
    """(G), which of the H F J rows of answers (S H) are there in some session: the others pad
    answers of fewer factors or rows, and would cost as much as any."""
    return answers.offsets.flatten(1).isfinite().any(0).nonzero().squeeze(-1)


def find_mode(rows: Tensor, there: Tensor, answers: Evidence, model: Boltzmann) -> Mode:
    """The mode of the posterior under the Gaussian prior, by Newton's method.

    Args:
        rows: (S G D) float64, those of the answers that are there.
        there: (G), see :func:`rows_there`.
        answers: (S H).
        model: the likelihood.
    """
    kernel = rows @ rows.mT / rows.shape[-1]
    eye = torch.eye(rows.shape[1]).to(rows)
    weights = rows.new_zeros(rows.shape[:2])  # the mode is their sum of the rows, over D
    shares = rows.new_tensor(SHARES)[:, None, None]
    best = _height(kernel, weights, there, answers, model)
    for _ in range(STEPS):
        returns = (kernel @ weights.unsqueeze(-1)).squeeze(-1)
        slope, roots = curvature(returns, there, answers, model)
        aim = (roots @ (roots.mT @ returns.unsqueeze(-1))).squeeze(-1) + slope
        inner = roots.mT @ kernel @ roots + eye
        pull = roots.mT @ (kernel @ aim.unsqueeze(-1))
        pull = roots @ torch.cholesky_solve(pull, torch.linalg.cholesky(inner))
        tried = weights + shares * (aim - pull.squeeze(-1) - weights)
        heights = torch.stack([_height(kernel, each, there, answers, model) for each in tried])
        highest, which = heights.max(0)
        weights = tried[which, torch.arange(len(weights), device=weights.device)]
        if ((highest - best) <= GAIN * best.abs().clamp(min=1)).all():
            break
        best = highest
    _, roots = curvature((kernel @ weights.unsqueeze(-1)).squeeze(-1), there, answers, model)
    mode = (weights.unsqueeze(1) @ rows).squeeze(1) / rows.shape[-1]
    return Mode(mode, roots)


def _gaps(returns: Tensor, there: Tensor, answers: Evidence) -> Tensor:
    """(S H F J), of answers whose rows have returns (S G)."""
    offsets = answers.offsets.flatten(1).to(returns)
    return offsets.index_add(1, there, returns).view(answers.offsets.shape)


def _height(
    kernel: Tensor, weights: Tensor, there: Tensor, answers: Evidence, model: Boltzmann
) -> Tensor:
    """(S), the log-posterior at weights (S G)."""
    returns = (kernel @ weights.unsqueeze(-1)).squeeze(-1)
    gaps = _gaps(returns, there, answers)
    likelihood = model.answer_log_likelihood(gaps, answers.floor.to(gaps)).sum(-1)
    return likelihood - (weights * returns).sum(-1) / 2


def curvature(
    returns: Tensor, there: Tensor, answers: Evidence, model: Boltzmann
) -> tuple[Tensor, Tensor]:
    """How the log-likelihood changes with the rows' returns (S G).

    Where answers may be lapses it is not concave; of its curvature the part that always is one is
    kept (that of the answer where it is none, by the probability that it is none).

    Returns:
        Slope (S G), and a root (S G G) of the negative curvature.
    """
    gaps = _gaps(returns, there, answers)
    # Of the preferred and of each other: what a softmax gives them.
    shares = F.softmax(F.pad(-model.tau * gaps, (1, 0)), -1)
    first, others = shares[..., :1], shares[..., 1:]
    sincere = torch.ones_like(answers.floor, dtype=gaps.dtype)
    if model.lapse:
        product = model.log_likelihood(gaps).sum(-1)
        sincere = torch.sigmoid(product - answers.floor.to(gaps).log())
    sincere = sincere[..., None, None]
    slope = model.tau * others * sincere
    # diag(q) - q qᵀ is the square of diag(√q) (I - √q √qᵀ / (1 + √p)), with p = 1 - Σq.
    root = others.sqrt()
    blocks = torch.diag_embed(root) - (others / (1 + first.sqrt())).unsqueeze(-1) * root.unsqueeze(
        -2
    )
    blocks = model.tau * sincere.sqrt().unsqueeze(-1) * blocks
    # Rows of different factors have nothing to do with each other.
    factor, place = there // gaps.shape[-1], there % gaps.shape[-1]
    row, column = (factor.unsqueeze(1) == factor).nonzero().unbind(1)
    roots = blocks.new_zeros(len(blocks), len(there), len(there))
    roots[:, row, column] = blocks.flatten(1, 2)[:, factor[row], place[row], place[column]]
    return slope.flatten(1)[:, there], roots
