r"""Batches: which n of the best candidates to ask at once, when no answer will be known in between.

Shapes: P candidates of one session that are worth most, best first, K options per query, M belief
samples, R possible answers, D features, n questions asked at once.

Several questions that are each worth much may all ask the same. Bıyık and Sadigh, *Batch active
preference-based learning of reward functions*, 2018, therefore keep the best candidates and choose
among these such as differ in :math:`\psi = \varphi_1 - \varphi_2`. Here ψ and -ψ are one question,
as its two options may be named in either order: all distances are the shorter of both.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchrl_pref.errors import InputError

CONFIGURATIONS = 1024
"""Combinations of answers that :func:`joint` follows: all of them for 10 questions of 2 answers."""

HELD = 2_000_000
"""Probabilities (R g P) that it holds at once: bounds memory where there are many answers."""


class Shortlist(NamedTuple):
    """The candidates of one session that are worth most, best first."""

    values: Tensor
    """(P), what each is worth by itself."""
    queries: Tensor
    """(P K D), features of the options."""
    probs: Tensor
    """(P M R), probability of each answer under each sample."""
    threshold: float = 0.0
    """Of questions about one option: the return above which it is good."""

    @property
    def psi(self) -> Tensor:
        """(P D), ψ in double precision. A single option is held against the threshold: its features
        (P D+1), and the threshold as one more, which -ψ has with the other sign.

        Raises:
            InputError: a question is about more than two.
        """
        if self.queries.shape[1] > 2:
            raise InputError(
                f"batches by features of questions about {self.queries.shape[1]} options: expected "
                "2, as what they differ in is told of pairs; choose a batch by top or joint"
            )
        first, last = self.queries[:, 0].double(), self.queries[:, -1].double()
        if self.queries.shape[1] == 1:
            return F.pad(first, (0, 1), value=self.threshold)
        return first - last


Select = Callable[[Shortlist, int], Tensor]
"""From a shortlist to n different places in it (n); P is at least n."""


def top(best: Shortlist, n: int) -> Tensor:
    """The n that are worth most: "greedy" in Bıyık and Sadigh, 2018."""
    return torch.arange(n, device=best.values.device)


def medoids(best: Shortlist, n: int) -> Tensor:
    """The centres of n clusters of ψ (k-medoids; Bıyık and Sadigh, 2018, section 4.2)."""
    return _medoids_among(best, torch.arange(len(best.values)), n)


def boundary_medoids(best: Shortlist, n: int) -> Tensor:
    """The same of those on the boundary of the convex hull of ψ and -ψ, as these differ most."""
    return _medoids_among(best, hull_vertices(best.psi), n)


def _medoids_among(best: Shortlist, places: Tensor, n: int) -> Tensor:
    """The medoids of some places, and the best others where these are fewer than n."""
    chosen = places.tolist()
    if len(chosen) > n:
        apart = distances(best.psi.cpu()[places]).numpy()
        # From a start that depends on no luck (BUILD), the best swap until none is left.
        found = of_extra("kmedoids").fastpam1(apart, n, init="build").medoids
        chosen = places[torch.as_tensor(found, dtype=torch.long)].tolist()
    kept = list(dict.fromkeys(chosen))
    kept += [place for place in range(len(best.values)) if place not in kept][: n - len(kept)]
    return torch.tensor(kept, device=best.values.device)


def successive_elimination(best: Shortlist, n: int) -> Tensor:
    """What is left when of the two that are nearest in ψ the one that is worth less is dropped,
    until there are n (Bıyık and Sadigh, 2018, algorithm 3)."""
    apart = distances(best.psi).fill_diagonal_(math.inf)
    left = torch.ones_like(best.values, dtype=torch.bool)
    for _ in range(len(best.values) - n):
        first, second = divmod(int(apart.argmin()), len(apart))
        worse = max(first, second)  # as the best come first
        left[worse] = False
        apart[worse], apart[:, worse] = math.inf, math.inf
    return left.nonzero().squeeze(-1)


def dpp(best: Shortlist, n: int) -> Tensor:
    r"""The mode of a determinantal point process, found greedily: worth much, and unlike.

    Bıyık, Wang, Anari and Sadigh, *Batch active learning using determinantal point processes*,
    2019, with :math:`\gamma = 1`: of a set S that is :math:`\prod_{i \in S} s_i \, \det k_S`, s
    being what a candidate is worth, and k a Gaussian kernel of ψ. The next candidate is the one
    that multiplies the determinant most, by the row updates of its Cholesky factor of Chen, Zhang
    and Zhou, *Fast greedy MAP inference for determinantal point process*, 2018.
    """
    kernel = dpp_kernel(best, n)
    left = kernel.diagonal().clone()
    rows = kernel.new_zeros(n, len(kernel))
    chosen: list[int] = []
    for k in range(n):
        left[chosen] = -math.inf
        j = int(left.argmax())
        chosen.append(j)
        pivot = left[j].clamp(min=1e-300).sqrt()
        rows[k] = (kernel[j] - rows[:k, j] @ rows[:k]) / pivot
        left = (left - rows[k].square()).clamp(min=0)
    return torch.tensor(chosen, device=best.values.device)


def dpp_kernel(best: Shortlist, n: int) -> Tensor:
    r"""The kernel (P P) of :func:`dpp`, in double precision.

    .. math:: L_{ij} = \sqrt{s_i s_j} \, k_{ij} / \sqrt{k_{ii} k_{jj}}, \qquad k_{ij} =
        e^{-\lVert \psi_i - \psi_j \rVert^2 / 2 \sigma^2} +
        e^{-\lVert \psi_i + \psi_j \rVert^2 / 2 \sigma^2}

    The second term makes ψ and -ψ one. :math:`\sigma^D` is half the box around ψ and -ψ over 2n, as
    in the authors' code.
    """
    psi = best.psi
    sides = 2 * psi.abs().amax(0)
    sides = sides[sides > 0]
    sigma = torch.exp((sides.log().sum() - math.log(4 * n)) / max(1, len(sides)))
    same, mirrored = _apart(psi, psi), _apart(psi, -psi)
    kernel = torch.exp(-same.square() / (2 * sigma**2))
    kernel = kernel + torch.exp(-mirrored.square() / (2 * sigma**2))
    weight = (best.values.double().clamp(min=0) / kernel.diagonal()).sqrt()
    return weight.unsqueeze(1) * kernel * weight


def joint(best: Shortlist, n: int) -> Tensor:
    r"""Greedily what adds most to the information of all n answers together.

    .. math:: I(y_1 \dots y_k; \omega) = H(y_1 \dots y_k) - \sum_i E_\omega H(y_i \mid \omega)

    Kirsch, van Amersfoort and Gal, *BatchBALD*, 2019. What the next answer adds is its entropy
    given the earlier ones, averaged over all of these, less its entropy given ω. Each combination
    of earlier answers is followed; where they are more than ``CONFIGURATIONS``, as many as that are
    drawn in proportion to their probability, at even steps and without luck.
    """
    probs = best.probs.double()
    noise = torch.special.entr(probs).sum(-1).mean(-1)
    share = probs.new_ones(1)  # (G), probability of each combination of earlier answers
    likely = probs.new_full((1, probs.shape[1]), 1 / probs.shape[1])  # (G M), samples after it
    chosen: list[int] = []
    step = max(1, HELD // noise.numel() // probs.shape[-1])
    for _ in range(n):
        gain = torch.zeros_like(noise)
        for some, weight in zip(likely.split(step), share.split(step), strict=True):
            later = torch.einsum("gm,pmr->rgp", some, probs)
            gain += weight @ torch.special.entr(later).sum(0)
        gain -= noise
        gain[chosen] = -math.inf
        chosen.append(int(gain.argmax()))
        share, likely = _followed(share, likely, probs[chosen[-1]])
    return torch.tensor(chosen, device=best.values.device)


def _followed(share: Tensor, likely: Tensor, probs: Tensor) -> tuple[Tensor, Tensor]:
    """Combinations of answers (G) with samples (G M), after one more answer of probs (M R)."""
    share = (share.unsqueeze(1) * (likely @ probs)).flatten()
    kept = torch.arange(len(share), device=share.device)
    if len(share) > CONFIGURATIONS:
        steps = (torch.arange(CONFIGURATIONS).to(share) + 0.5) / CONFIGURATIONS
        kept = torch.searchsorted(share.cumsum(0) / share.sum(), steps).clamp(max=len(share) - 1)
        share = torch.full_like(steps, 1 / CONFIGURATIONS)
    n_answers = probs.shape[-1]
    told = likely[kept // n_answers] * probs.mT[kept % n_answers]  # of those alone that are kept
    return share, told / told.sum(-1, keepdim=True).clamp(min=1e-300)


BATCHES: dict[str, Select] = {
    "top": top,
    "medoids": medoids,
    "boundary_medoids": boundary_medoids,
    "successive_elimination": successive_elimination,
    "dpp": dpp,
    "joint": joint,
}
"""Ways to choose n of the best candidates, by name."""

OF_PAIRS = ("medoids", "boundary_medoids", "successive_elimination", "dpp")
"""Those that look at ψ, which is of two options."""


def distances(psi: Tensor) -> Tensor:
    """(P P), how far questions are apart: ψ from ψ or from -ψ, whichever is nearer."""
    return torch.minimum(_apart(psi, psi), _apart(psi, -psi))


def _apart(first: Tensor, second: Tensor) -> Tensor:
    """Distances (P P), exactly 0 of points that are the same."""
    return torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")


def hull_vertices(psi: Tensor) -> Tensor:
    """Places of the points that are no mixture of the others and of all their mirror images; of
    points that are the same, the first.

    Whether non-negative weights of the others give a point is one small least-squares problem each.
    The facets of the hull would be quicker to find with few features, but their number explodes
    with D, and there are none of points in a plane.
    """
    nnls = of_extra("scipy.optimize").nnls
    points = psi.cpu() / psi.abs().max().clamp(min=1e-30).cpu()
    first = (distances(points) < 1e-9).byte().argmax(1)
    places = (first == torch.arange(len(points))).nonzero().squeeze(-1)
    points = points[places]
    both = torch.cat([points, -points]).mT  # (D 2P)
    system = torch.cat([both, torch.ones_like(both[:1])]).numpy()  # weights sum to 1
    outside = []
    for place, point in zip(range(len(points)), points.numpy(), strict=True):
        others = system.copy()
        # Neither the point nor its image; in its place 0, which is a mixture of every such pair.
        others[:-1, [place, place + len(points)]] = 0
        if nnls(others, [*point, 1.0])[1] > 1e-7:
            outside.append(place)
    return places[outside]


def of_extra(module: str) -> Any:
    """A module that only some batches need.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise InputError(
            f"batches by medoids: {module.partition('.')[0]} is not installed; install it by "
            "pip install -c constraints.txt -e '.[batch]'"
        ) from None
