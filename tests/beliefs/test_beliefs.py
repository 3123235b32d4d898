"""What every belief keeps to: the package's, and one written outside of it."""

from collections.abc import Callable

import my_belief
import pytest
import torch
from torch import Generator

from torchrl_pref.beliefs import BELIEFS
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.laplace import LaplaceBelief
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.errors import InputError
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.tensors import directions

MAKE = [*BELIEFS.values(), my_belief.Weighted]
SOFT = (RationalityBelief, LaplaceBelief)
"""Those that are for humans who err."""
MODELS = [Boltzmann(2.0), Optimal(), Boltzmann(2.0, Weak(0.3), lapse=0.1)]


def answered(belief: BeliefBase, sessions: int, generator: Generator) -> tuple[torch.Tensor, ...]:
    """Samples and their size after six answers of which one is no answer, and the humans, who are
    as the belief expects them."""
    omega = belief.prior(sessions, 3, generator)[:, 0]
    samples = belief.prior(sessions, 3, generator)
    ess = torch.full((sessions,), float(belief.n_samples))
    options = torch.randn(sessions, 6, 2, 3, generator=generator)
    returns = (options @ omega[:, None, :, None]).squeeze(-1)
    answers = belief.response_model(returns).exp().flatten(0, 1)
    answers = answers.multinomial(1, generator=generator).view(sessions, 6)
    answers[:, 2] = -1
    for h in (1, 2, 4, 5, 6):
        evidence = belief.response_model.evidence(options[:, :h], answers[:, :h])
        update = belief.update(samples, ess, evidence, generator)
        assert update.used.dtype == torch.bool
        samples, ess = update.samples, update.ess
    return samples, ess, omega


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("make", MAKE)
def test_what_a_belief_gives(
    make: Callable[[ResponseModel], BeliefBase], model: ResponseModel, generator: Generator
) -> None:
    if make in SOFT and isinstance(model, Optimal):
        with pytest.raises(InputError, match="expected"):
            make(model)
        return
    belief = make(model)
    assert belief.response_model is model
    samples, ess, omega = answered(belief, 300, generator)
    assert samples.shape == (300, belief.n_samples, 3)
    samples, omega = directions(samples), directions(omega)
    assert torch.allclose(samples.norm(dim=-1), torch.ones(1), atol=1e-4)
    assert ((ess >= 1) & (ess <= belief.n_samples)).all()
    # Calibrated: what it expects of its alignment is what it has.
    expected = samples.mean(1).square().sum(-1)
    found = torch.einsum("smd,sd->sm", samples, omega).mean(1)
    error = (found - expected).std() / 300**0.5
    allowed = 0.03 if make is LaplaceBelief else 0.0  # which is an approximation
    assert (found - expected).mean().abs() < 4 * error + allowed
    assert found.mean() > 0.2


@pytest.mark.parametrize("make", MAKE)
def test_a_generator_fixes_it(make: Callable[[ResponseModel], BeliefBase]) -> None:
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first, again = (answered(make(MODELS[0]), 5, Generator().manual_seed(1)) for _ in range(2))
    assert all(map(torch.equal, first, again))
    assert torch.equal(torch.get_rng_state(), state)
