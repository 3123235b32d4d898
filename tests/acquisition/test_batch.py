"""Batches against direct searches: determinants, naive loops, and all combinations of answers."""

from __future__ import annotations

import itertools
import math
import sys

import pytest
import torch
from torch import Generator, Tensor

from torchrl_pref.acquisition import batch
from torchrl_pref.acquisition.batch import (
    BATCHES,
    OF_PAIRS,
    Shortlist,
    distances,
    dpp,
    dpp_kernel,
    hull_vertices,
    joint,
)
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import predict_answers
from torchrl_pref.beliefs.sampled import uniform_sphere
from torchrl_pref.errors import InputError
from torchrl_pref.questions.approve import Approve
from torchrl_pref.questions.ranking import Ranking
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies.batches import threshold_of

MODEL = Boltzmann(2.0)


def shortlist(
    size: int = 40,
    n_options: int = 2,
    samples: int = 30,
    model: ResponseModel = MODEL,
    seed: int = 0,
) -> Shortlist:
    generator = Generator().manual_seed(seed)
    queries = torch.randn(1, size, n_options, 3, generator=generator)
    belief = uniform_sphere((1, samples, 3), generator)
    predicted = predict_answers(belief, queries, model)
    values = information_gain(predicted, belief)[0]
    order = values.argsort(descending=True)
    return Shortlist(values[order], queries[0, order], predicted.probs[0, order])


def entropy(probs: Tensor) -> float:
    return float(-sum(p * math.log(p) for p in probs.flatten().tolist() if p > 0))


def information_of(probs: Tensor) -> float:
    """Of the answers to questions with probs (n M R) together, over every combination."""
    n, n_samples, n_answers = probs.shape
    together = torch.stack(
        [
            torch.stack([probs[i, :, a] for i, a in enumerate(answers)]).prod(0)
            for answers in itertools.product(range(n_answers), repeat=n)
        ]
    )  # (R^n M)
    of_each = sum(entropy(together[:, m]) for m in range(n_samples)) / n_samples
    return entropy(together.mean(1)) - of_each


@pytest.mark.parametrize("name", BATCHES)
@pytest.mark.parametrize("size", [5, 6, 40])
def test_batches_are_of_different_candidates_and_of_no_luck(name: str, size: int) -> None:
    best = shortlist(size)
    chosen = BATCHES[name](best, 5)
    assert chosen.dtype == torch.long
    assert len(set(chosen.tolist())) == len(chosen) == 5
    assert 0 <= int(chosen.min()) <= int(chosen.max()) < size
    torch.manual_seed(5)
    assert torch.equal(BATCHES[name](best, 5), chosen)


@pytest.mark.parametrize("name", BATCHES)
def test_the_order_of_the_options_makes_no_difference(name: str) -> None:
    best = shortlist()
    swapped = torch.arange(40) % 3 == 0
    queries = torch.where(swapped[:, None, None], best.queries.flip(1), best.queries)
    probs = torch.where(swapped[:, None, None], best.probs.flip(2), best.probs)
    other = Shortlist(best.values, queries, probs)
    assert torch.equal(BATCHES[name](best, 6), BATCHES[name](other, 6))


@pytest.mark.parametrize("name", BATCHES)
def test_questions_that_are_all_the_same_still_make_a_batch(name: str) -> None:
    best = shortlist(1)
    same = Shortlist(*(part.repeat(12, *(1,) * (part.ndim - 1)) for part in best[:3]))
    assert len(set(BATCHES[name](same, 4).tolist())) == 4
    nothing = Shortlist(*(torch.zeros_like(part) for part in same[:2]), same.probs)
    assert len(set(BATCHES[name](nothing, 4).tolist())) == 4


def test_one_option_and_its_mirror_image_are_one_question_only_where_the_threshold_is_0() -> None:
    """Is it good? Who says so of one, says no of the other; but few may please who is strict."""
    best = shortlist(20, 1, model=Boltzmann(2.0, Approve()))
    mirrored = best._replace(queries=torch.cat([best.queries, -best.queries]))
    assert distances(mirrored.psi).diagonal(20).abs().max() < 1e-9
    strict = mirrored._replace(threshold=0.5)
    assert torch.allclose(distances(strict.psi).diagonal(20), torch.ones(()).double())
    apart = distances(strict.psi)[:20, :20]
    assert (apart >= distances(mirrored.psi)[:20, :20] - 1e-9).all()
    assert threshold_of(Boltzmann(2.0, Approve(-1.0))) == 0.5  # in units of the return


def test_many_answers_take_no_more_memory_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    best, largest = shortlist(20, 4, 10, Boltzmann(2.0, Ranking())), []
    whole, entr = joint(best, 4), torch.special.entr

    def watched(numbers: Tensor) -> Tensor:
        largest.append(numbers.numel())
        return entr(numbers)

    monkeypatch.setattr(batch, "HELD", 24 * 20 * 10)
    monkeypatch.setattr(torch.special, "entr", watched)
    assert torch.equal(joint(best, 4), whole)
    assert max(largest) <= 24 * 20 * 10


def test_top_is_what_is_worth_most() -> None:
    assert BATCHES["top"](shortlist(), 3).tolist() == [0, 1, 2]


@pytest.mark.parametrize(("n_options", "model"), [(2, MODEL), (3, Boltzmann(2.0, Ranking()))])
def test_joint_adds_what_brute_force_finds_most_informative(
    n_options: int, model: ResponseModel
) -> None:
    best = shortlist(8, n_options, 6, model)
    probs, chosen = best.probs.double(), []
    for _ in range(3 if n_options == 3 else 4):
        rest = [place for place in range(8) if place not in chosen]
        chosen.append(max(rest, key=lambda place: information_of(probs[[*chosen, place]])))
    assert joint(best, len(chosen)).tolist() == chosen


def test_joint_is_near_the_best_of_all_batches() -> None:
    """Greedy is within 1 - 1/e of the best for such sums, and here nearly the best."""
    for seed in range(3):
        best = shortlist(9, samples=8, seed=seed)
        probs = best.probs.double()
        every = {
            batch: information_of(probs[list(batch)])
            for batch in itertools.combinations(range(9), 3)
        }
        found = every[tuple(sorted(joint(best, 3).tolist()))]
        assert found >= 0.97 * max(every.values())


def test_joint_goes_on_where_combinations_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    best = shortlist(30, samples=20)
    exact = joint(best, 7)
    monkeypatch.setattr(batch, "CONFIGURATIONS", 64)
    drawn = joint(best, 7)
    assert torch.equal(drawn[:6], exact[:6])  # 2^6 combinations are all followed
    values = [information_of(best.probs.double()[each]) for each in (exact, drawn)]
    assert values[1] == pytest.approx(values[0], rel=0.02)
    monkeypatch.setattr(batch, "CONFIGURATIONS", 8)
    few = information_of(best.probs.double()[joint(best, 7)])
    assert few >= 0.9 * values[0]


def test_combinations_that_are_drawn_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """On average over the answers a belief is what it was before them."""
    monkeypatch.setattr(batch, "CONFIGURATIONS", 256)
    probs = shortlist(12, samples=10).probs.double()
    share, likely = torch.ones(1).double(), torch.full((1, 10), 0.1).double()
    for answers in probs:
        share, likely = batch._followed(share, likely, answers)
    assert len(share) == 256
    assert float(share.sum()) == pytest.approx(1)
    assert torch.allclose(likely.sum(1), torch.ones(256).double())
    assert torch.allclose(share @ likely, torch.full((10,), 0.1).double(), atol=0.02)
    assert likely.std(0).min() > 0.05


def test_successive_elimination_is_the_naive_loop() -> None:
    for seed in range(3):
        best = shortlist(25, seed=seed)
        psi, left = best.psi, list(range(25))
        while len(left) > 6:
            pairs = itertools.combinations(left, 2)
            i, j = min(
                pairs,
                key=lambda p: min((psi[p[0]] - psi[p[1]]).norm(), (psi[p[0]] + psi[p[1]]).norm()),
            )
            left.remove(i if best.values[i] < best.values[j] else j)
        assert BATCHES["successive_elimination"](best, 6).tolist() == left


def test_dpp_multiplies_the_determinant_most_at_every_step() -> None:
    for seed in range(3):
        best = shortlist(25, seed=seed)
        kernel, chosen = dpp_kernel(best, 6), []
        for _ in range(6):
            rest = [place for place in range(25) if place not in chosen]
            sets = torch.tensor([[*chosen, place] for place in rest])
            blocks = kernel[sets.unsqueeze(-1), sets.unsqueeze(-2)]
            chosen.append(rest[int(torch.linalg.det(blocks).argmax())])
        assert dpp(best, 6).tolist() == chosen


def test_the_kernel_of_the_dpp_is_one_and_has_the_scores_on_its_diagonal() -> None:
    best = shortlist()
    kernel = dpp_kernel(best, 5)
    assert torch.linalg.eigvalsh(kernel).min() > -1e-9
    assert torch.allclose(kernel.diagonal(), best.values.double())
    mirrored = dpp_kernel(best._replace(queries=best.queries.flip(1)), 5)
    assert torch.allclose(kernel, mirrored)


def test_the_kernel_of_the_dpp_is_as_wide_as_its_authors_say() -> None:
    """To the power of D: half the box around ψ and -ψ, over 2n."""
    best, n = shortlist(6), 5
    psi = (best.queries[:, 0] - best.queries[:, 1]).double()
    box = math.prod(2 * side for side in psi.abs().amax(0).tolist())
    twice = 2 * (box / 2 / (2 * n)) ** (2 / 3)

    def near(i: int, j: int) -> float:
        apart = (float((psi[i] - sign * psi[j]).square().sum()) for sign in (1, -1))
        return sum(math.exp(-square / twice) for square in apart)

    kernel = dpp_kernel(best, n)
    for i, j in itertools.combinations(range(6), 2):
        expected = near(i, j) * math.sqrt(best.values[i] * best.values[j])
        expected /= math.sqrt(near(i, i) * near(j, j))
        assert float(kernel[i, j]) == pytest.approx(expected, rel=1e-5)


def test_hull_vertices_are_those_of_qhull() -> None:
    from scipy.spatial import ConvexHull

    generator = Generator().manual_seed(0)
    for size, dimension in ((30, 2), (60, 3), (60, 4)):
        points = torch.randn(size, dimension, generator=generator).double()
        hull = ConvexHull(torch.cat([points, -points]).numpy())
        expected = sorted({int(vertex) % size for vertex in hull.vertices})
        assert hull_vertices(points).tolist() == expected
    flat = torch.cat([points, points[:, :1]], 1)  # in a plane, where Qhull finds none
    assert hull_vertices(flat).tolist() == expected
    twice = torch.cat([points, -points])
    assert hull_vertices(twice).tolist() == expected
    assert hull_vertices(torch.tensor([[1.0], [-3.0], [2.0]]).double()).tolist() == [1]


def test_boundary_medoids_lie_on_the_boundary() -> None:
    best = shortlist(60)
    vertices = set(hull_vertices(best.psi).tolist())
    assert len(vertices) > 6
    assert set(BATCHES["boundary_medoids"](best, 6).tolist()) <= vertices
    assert not set(BATCHES["medoids"](best, 6).tolist()) <= vertices
    n = len(vertices) + 3
    more = BATCHES["boundary_medoids"](best, n).tolist()
    assert len(set(more)) == n
    assert vertices <= set(more)


def test_medoids_cannot_be_bettered_by_a_swap() -> None:
    best = shortlist(30)
    apart, chosen = distances(best.psi), BATCHES["medoids"](best, 4).tolist()

    def cost(medoids: list[int]) -> float:
        return float(apart[medoids].amin(0).sum())

    swaps = itertools.product(range(4), range(30))
    swapped = ([*chosen[:i], j, *chosen[i + 1 :]] for i, j in swaps if j not in chosen)
    assert cost(chosen) <= min(map(cost, swapped)) + 1e-9


@pytest.mark.parametrize("name", BATCHES)
def test_what_looks_at_pairs_refuses_questions_about_more(name: str) -> None:
    best = shortlist(20, 3)
    if name in OF_PAIRS:
        with pytest.raises(InputError, match="of questions about 3 options: expected 2"):
            BATCHES[name](best, 4)
    else:
        assert len(set(BATCHES[name](best, 4).tolist())) == 4


def test_the_extra_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kmedoids", None)
    with pytest.raises(InputError, match=r"kmedoids is not installed; .* '\.\[batch\]'"):
        BATCHES["medoids"](shortlist(), 4)
