"""The moves of the belief: compiled and in tensors, and what they leave as it is."""

import math

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import told
from torch import Generator, Tensor

from torchrl_pref.beliefs.resampling import (
    FRAMES,
    GROUPS,
    agreement,
    explained_share,
    frames_of,
    group_of,
    kish_share,
    poles_of,
    resample,
    spread_of_others,
    tensor_poles,
    tensor_resample,
    tensor_share,
)
from torchrl_pref.beliefs.resampling_cpu import compiled_resample
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.beliefs.slice import ARC, MAX_SHRINKS, Target, compiled_moves, tensor_moves
from torchrl_pref.questions.choice import evidence_of_gaps, feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, compiled_constants


@pytest.mark.parametrize("power", [1.0, 0.3])
@pytest.mark.parametrize(("n_options", "n_features"), [(2, 4), (4, 4), (2, 2), (3, 9)])
@pytest.mark.parametrize("model", [*RESPONSE_MODELS, Boltzmann(300.0)], ids=str)
def test_compiled_moves_go_where_those_in_tensors_do(
    model: ResponseModel, n_options: int, n_features: int, power: float, generator: Generator
) -> None:
    sessions = 20
    belief = Belief(model)
    samples, ess = belief.prior(sessions, n_features, generator), torch.full((sessions,), 100.0)
    omega = uniform_sphere((sessions, n_features, 1), generator)
    gaps = torch.zeros(sessions, 9, n_options - 1, n_features)
    for h in range(9):
        queries = torch.randn(sessions, n_options, n_features, generator=generator)
        answers = model((queries @ omega).squeeze(-1)).exp().multinomial(1, generator=generator)
        newest = feature_gaps(queries, answers.squeeze(-1))
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        gaps[:, h] = newest  # until then a row of zeros
        if h in (0, 4, 8):
            normal = torch.randn(sessions, FRAMES, 1, n_features, generator=generator)
            poles = poles_of(samples, normal)
            uniform = torch.rand(1, sessions, 100, 2 + MAX_SHRINKS, generator=generator)
            slack = torch.rand(sessions, generator=generator) / 10
            answers = evidence_of_gaps(gaps)
            target = Target(answers, slack, torch.full((sessions,), power), model)
            constants = compiled_constants(model)
            assert constants is not None
            evidence = answers.rows, answers.offsets, answers.floor, torch.ones(sessions, 2, 100)
            given = *evidence, *target[1:3], ARC, *constants
            compiled = compiled_moves(samples, poles, uniform, *given)
            close = (compiled - tensor_moves(samples, poles, uniform, target)).norm(dim=-1) < 1e-3
            # A proposal at the very edge of its slice may be judged differently.
            assert close.float().mean() > 0.99
            moved = (compiled - samples).norm(dim=-1)
            assert (moved > 1e-3 * samples.std(1).norm()).float().mean() > 0.8
            lengths = poles.norm(dim=-1, keepdim=True)
            difference = (poles - tensor_poles(samples, normal)) / lengths
            assert difference.norm(dim=-1).median() < 1e-3
            shares = explained_share(samples, compiled), tensor_share(samples, compiled)
            assert torch.allclose(*shares, atol=1e-3)


@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_moves_in_tensors_stay_on_their_device(model: ResponseModel) -> None:
    """``meta`` stands for a GPU: nothing is computed, but devices must not be mixed."""
    shapes = (5, 30, 4), (5, FRAMES, 6, 4), (6, 5, 30, 2 + MAX_SHRINKS), (5, 7, 1, 4), (5,), (5,)
    samples, normal, uniform, gaps, *rest = (torch.empty(shape, device="meta") for shape in shapes)
    poles = poles_of(samples, normal)
    moved = tensor_moves(samples, poles, uniform, Target(evidence_of_gaps(gaps), *rest, model))
    assert explained_share(samples, moved).device.type == "meta"
    assert moved.device.type == "meta"
    assert moved.shape == shapes[0]


@pytest.mark.parametrize("n", [3, 4, 7])
def test_directions_come_in_orthonormal_frames(n: int, generator: Generator) -> None:
    normal = torch.randn(5, n, 3, generator=generator)
    vectors = frames_of(normal)
    assert torch.allclose(vectors[:, 0], torch.nn.functional.normalize(normal[:, 0], dim=-1))
    for frame in vectors.split(3, 1):
        assert torch.allclose(frame @ frame.mT, torch.eye(frame.shape[1]), atol=1e-3)


def test_directions_do_not_depend_on_the_samples_that_they_move(generator: Generator) -> None:
    samples = torch.randn(2, 25, 3, generator=generator)
    group = group_of(25, GROUPS, samples.device)
    spread = spread_of_others(samples)
    assert spread.shape == (2, GROUPS, 3, 3)
    for p in range(GROUPS):
        others = samples[:, group != p].double().numpy()
        for factor, rest in zip(spread[:, p], others, strict=True):
            expected = np.cov(rest.T, ddof=0)
            assert np.allclose(factor @ factor.T, expected, atol=1e-4)


@pytest.mark.parametrize("draw", [compiled_resample, tensor_resample])
def test_resampling_follows_the_weights(draw: object, generator: Generator) -> None:
    log_weights = torch.tensor([[0.0, math.log(2), -math.inf, 0.0]]).expand(2000, 4)
    samples = torch.eye(4).expand(2000, 4, 4)
    offset = torch.rand(2000, generator=generator)
    order = torch.arange(4)
    copies, factor = draw(samples, log_weights, offset, order)  # type: ignore[operator]
    assert copies.mean(0).sum(0).tolist() == pytest.approx([1, 2, 0, 1], abs=0.05)
    assert (factor >= 1).all()
    assert (factor <= 2).all()
    # Shares that are no whole numbers: whether a sample comes once more is up to the offset.
    shares = torch.tensor([0.3, 0.7, 1.2, 1.8])
    offset = torch.rand(20_000, generator=generator)
    many = samples[:1].expand(20_000, 4, 4)
    copies, _ = draw(many, shares.log().expand(20_000, 4), offset, order)  # type: ignore[operator]
    assert copies.mean(0).sum(0).tolist() == pytest.approx(shares.tolist(), abs=0.02)
    assert float(kish_share(log_weights[0])) == pytest.approx(16 / (4 * 6))
    assert float(kish_share(torch.full((4,), -math.inf))) == 0


def test_samples_agree_with_an_answer_as_in_tensors(generator: Generator) -> None:
    """Some hold it likely, some nearly or quite impossible, and of one session all do."""
    likelihood = -torch.rand(6, 50, generator=generator) * torch.logspace(-6, 2, 6).unsqueeze(1)
    likelihood[3, ::2] = -math.inf
    likelihood[5] = -math.inf
    share, mean = agreement(likelihood)
    assert torch.allclose(share, kish_share(likelihood), rtol=1e-5)
    assert torch.allclose(mean, likelihood.exp().mean(1), rtol=1e-5)
    assert float(share[5]) == float(mean[5]) == 0
    assert agreement(likelihood.to("meta"))[0].device.type == "meta"


def test_the_luck_of_resampling_favours_no_sample(generator: Generator) -> None:
    shares = torch.tensor([0.3, 0.7, 1.2, 1.8])
    samples, log_weights = torch.eye(4).expand(20_000, 4, 4), shares.log().expand(20_000, 4)
    copies, _ = resample(samples, log_weights, generator)
    assert copies.mean(0).sum(0).tolist() == pytest.approx(shares.tolist(), abs=0.02)


def test_resampling_is_the_same_compiled_and_in_tensors(generator: Generator) -> None:
    samples = torch.randn(50, 30, 3, generator=generator)
    log_weights = 3 * torch.randn(50, 30, generator=generator)
    offset = torch.rand(50, generator=generator)
    order = torch.randperm(30, generator=generator)
    compiled, factor = compiled_resample(samples, log_weights, offset, order)
    copies, expected = tensor_resample(samples, log_weights, offset, order)
    # A weight that ends at the very place of a draw may be judged differently.
    assert (compiled == copies).float().mean() > 0.999
    assert torch.allclose(factor, expected, rtol=0.02)


def test_equal_weights_leave_every_sample(generator: Generator) -> None:
    samples = torch.randn(7, 40, 3, generator=generator)
    copies, factor = resample(samples, torch.zeros(7, 40), generator)
    rows = (torch.take_along_dim(t, t[..., :1].argsort(1), 1) for t in (copies, samples))
    assert torch.equal(*rows)
    assert torch.allclose(factor, torch.ones(7))


@pytest.mark.parametrize("n_samples", [2, 7, 20, 33, 64, 100, 101])
def test_copies_share_a_group_and_no_directions(n_samples: int, generator: Generator) -> None:
    """A direction must not depend on a copy of what moves along it, nor be that of the copy."""
    samples = torch.arange(float(n_samples)).reshape(1, n_samples, 1).expand(5, -1, 2)
    copies, _ = resample(samples, torch.zeros(5, n_samples), generator)
    places = copies[0, :, 0].argsort()  # of the first to the last of the copies in a row
    n_groups = min(GROUPS, n_samples)
    group = group_of(n_samples, n_groups, samples.device)
    assert torch.equal(group[places], group)
    directions = group_of(n_samples, n_groups * FRAMES, samples.device)[places]
    neighbours_in_a_group = group[1:] == group[:-1]
    assert (directions[1:] != directions[:-1])[neighbours_in_a_group].all()


def test_what_earlier_places_explain(generator: Generator) -> None:
    before = torch.randn(500, 100, 5, generator=generator)
    noise = torch.randn(500, 100, 5, generator=generator)

    def share(after: Tensor) -> float:
        return float(explained_share(before, after).mean())

    assert share(noise) == pytest.approx(0, abs=0.02)
    assert share(before) == pytest.approx(1, abs=1e-3)
    assert share(0.6 * before + 0.8 * noise) == pytest.approx(0.36, abs=0.02)
    # One direction that is remembered among four that are not.
    assert share(torch.cat([before[..., :1], noise[..., 1:]], -1)) == pytest.approx(0.2, abs=0.02)
