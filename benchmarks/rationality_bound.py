"""How much of what it costs not to know tau no belief could save.

``python benchmarks/rationality_bound.py [--humans 300] [--json FILE]``. Humans are those of
``rationality.py``: their tau is the reference times one of seven factors. A belief that infers tau
asks each of them 20 greedy questions. Then two exact beliefs, by importance sampling, hear the same
answers: one is told the human's own tau, and one is told that each of the seven is as likely. Where
the seven are as many the mean of the second is the best guess that there is of such humans' weights
by what they answered: no other, however it is made, has a higher cosine on average over the seven.

Shapes: S humans, N draws, H answers, D features, F factors, C widths.
"""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import torch
from tensordict import TensorDictBase
from torch import Generator, Tensor
from torch.nn import functional as F

from benchmarks import common
from benchmarks.rationality import FACTORS, GREEDY_BY, arguments, asked, beliefs, difference, pools
from torchrl_pref.tensors import directions

WIDTHS = (1e-4, 1e-3, 1e-2, 1e-1, 10.0)
"""What is added to the second moments of the belief's samples, so that draws come from all about
them; the last is nearly the uniform distribution."""

DRAWS = 1500
"""Of each width."""


def main() -> None:
    """Print the cosines, and what the best guess loses."""
    options = common.start(arguments(__doc__))
    table: list[common.Row] = []
    for (name, pool), how in product(pools(options.queries).items(), GREEDY_BY):
        lost: dict[str, list[Tensor]] = {"best guess": [], "inferred": []}
        for factor in FACTORS:
            belief = beliefs(factor, 0.0)["inferred"]
            done = asked(pool, belief, how, factor, options.humans, options.seed)
            cosines = guesses(done, FACTORS.index(factor))
            row: common.Row = {"pool": name, "greedy by": how, "factor": factor}
            row |= {kind: float(found.mean()) for kind, found in cosines.items()}
            for kind, every in lost.items():
                every.append(cosines[kind] - cosines["told rightly"])
                row[f"{kind} less told rightly"] = difference(every[-1])
            table.append(row)
        row = {"pool": name, "greedy by": how, "factor": "all"}
        for kind, every in lost.items():  # all factors are of the same humans
            row[f"{kind} less told rightly"] = difference(torch.stack(every).mean(0))
        table.append(row)
    title = f"Cosine of the guess after the same answers, {options.humans} humans a row"
    common.report(title, table, options.json)


def guesses(done: TensorDictBase, place: int) -> dict[str, Tensor]:
    """Cosines (S) of each belief's guess with the weights of humans whose factor has this place."""
    samples, omega = done["session", "samples"], done["human", "omega"].double()
    points, log_density = draw(samples)
    returns = points @ gaps(done).mT
    likely = [F.logsigmoid(common.TAU * factor * returns).sum(-1) for factor in FACTORS]
    log_weights = torch.stack(likely, 1) - log_density.unsqueeze(1)
    known, unknown = log_weights[:, place].softmax(-1), log_weights.flatten(1).softmax(-1)
    of = {
        "told rightly": mean(known, points),
        "best guess": mean(unknown.unflatten(1, log_weights.shape[1:]).sum(1), points),
        "inferred": directions(samples).double().mean(1),
    }
    return {kind: F.cosine_similarity(guess, omega, dim=-1) for kind, guess in of.items()}


def mean(weights: Tensor, points: Tensor) -> Tensor:
    """(S D), of points (S N D) by weights (S N)."""
    return (weights.unsqueeze(-1) * points).sum(1)


def gaps(done: TensorDictBase) -> Tensor:
    """(S H D), features of the chosen option less those of the other."""
    options, answers = (done["session", "history", key].double() for key in ("options", "answers"))
    return (options[:, :, 0] - options[:, :, 1]) * (1 - 2 * answers).unsqueeze(-1)


def draw(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Directions (S N D) about the samples (S M D) of beliefs.

    They are angular central Gaussian (Tyler, *Statistical analysis for the angular central Gaussian
    distribution on the sphere*, 1987), of several widths.

    Returns:
        The directions, and the logarithm of their density up to a number (S N).
    """
    omega = directions(samples).double()
    size = omega.shape[-1]
    widths = torch.tensor(WIDTHS, dtype=omega.dtype)[:, None, None] * torch.eye(size).double()
    moments = (omega.mT @ omega / omega.shape[1]).unsqueeze(1) + widths
    factors = torch.linalg.cholesky(moments)
    luck = Generator().manual_seed(0)
    normal = torch.randn(*factors.shape[:2], DRAWS, size, generator=luck, dtype=omega.dtype)
    points = F.normalize(normal @ factors.mT, dim=-1).flatten(1, 2)
    square = torch.einsum("snd,scde,sne->scn", points, torch.linalg.inv(moments), points)
    scale = factors.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
    return points, (-scale - size / 2 * square.log()).logsumexp(1)


if __name__ == "__main__":
    main()
