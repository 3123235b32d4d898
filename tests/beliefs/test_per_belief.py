import pytest
import torch
from torch import Generator, Tensor

from torchrl_pref.beliefs.per_belief import PerBelief


def test_only_changed_beliefs_are_computed_anew(generator: Generator) -> None:
    asked: list[int] = []

    def count(samples: Tensor) -> Tensor:
        asked.append(len(samples))
        return samples.square().sum((1, 2))

    remembered = PerBelief(count)
    samples = torch.randn(5, 7, 3, generator=generator)
    first = remembered(samples)
    kept = first.clone()
    assert torch.equal(remembered(samples.clone()), first)
    samples[1], samples[4] = samples[0], samples[4] + 1
    assert torch.equal(remembered(samples), samples.square().sum((1, 2)))
    assert torch.equal(first, kept)  # what was given before stays as it was
    assert asked == [5, 2]
    # A change in place is seen too, and other sessions, more or fewer, are other beliefs.
    samples.mul_(2)
    for fewer in (samples, samples[:3], samples[2:], samples[:0]):
        assert torch.equal(remembered(fewer), fewer.square().sum((1, 2)))


def test_rows_of_one_belief_are_computed_once(generator: Generator) -> None:
    asked: list[int] = []

    def count(samples: Tensor) -> Tensor:
        asked.append(len(samples))
        return samples.square().sum(1)

    remembered = PerBelief(count)
    one = torch.randn(1, 7, 3, generator=generator)
    for rows in (4, 9):
        assert torch.equal(remembered(one.repeat(rows, 1, 1)), one.square().sum(1).repeat(rows, 1))
    assert asked == [1]
    several = torch.cat([one, one, one + 1])
    assert torch.equal(remembered(several), several.square().sum(1))


def test_gradients_pass_through(generator: Generator) -> None:
    remembered = PerBelief(lambda samples: samples.square().sum((1, 2)))
    samples = torch.randn(2, 4, 3, generator=generator)
    remembered(samples)
    learned = samples.clone().requires_grad_()
    remembered(learned).sum().backward()
    assert learned.grad is not None
    assert torch.allclose(learned.grad, 2 * samples)
    assert remembered(samples).grad_fn is None


@pytest.mark.parametrize("number", [torch.nan, torch.inf])
def test_what_is_not_a_number_is_not_remembered_as_another(number: float) -> None:
    remembered = PerBelief(lambda samples: samples.sum((1, 2)))
    samples = torch.ones(2, 3, 2)
    samples[0, 0, 0] = number
    remembered(samples)
    samples[0, 0, 0] = 1.0
    assert torch.equal(remembered(samples), torch.tensor([6.0, 6.0]))
