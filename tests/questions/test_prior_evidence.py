"""Demonstrations and corrections: the posterior, against the direct formula and by calibration."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from test_questions import InTensors
from torch import Generator, Tensor

from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import SessionState, begin, hear, tell
from torchrl_pref.errors import InputError
from torchrl_pref.humans.demonstrations import Demonstrations, different
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.prior_evidence import (
    Shown,
    check_given,
    correction,
    demonstration,
    given_digest,
    rows_of_shown,
)
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.questions.weak import Weak
from torchrl_pref.session import Session
from torchrl_pref.strategies import RandomQuery

TAU, TAU_SHOWN, TAU_CORRECTED = 2.0, 3.5, 0.8


def direct(omega: np.ndarray, shown: list[tuple[np.ndarray, np.ndarray, float]]) -> np.ndarray:
    """(n), log-probability of best (D) among it and others (J D) by tau, one after the other."""
    total = np.zeros(len(omega))
    for best, others, tau in shown:
        weights = np.exp(tau * (omega @ np.concatenate([best[None], others]).T))
        total += np.log(weights[:, 0] / weights.sum(1))
    return total


def heard(
    model: ResponseModel, given: list[Shown], sessions: int, budget: int, generator: Generator
) -> tuple[Belief, SessionState]:
    """Sessions of people who all showed the same."""
    belief = Belief(model)
    state = begin(belief.prior(sessions, 3, generator), budget, 2)
    return belief, hear(belief, state, rows_of_shown(given, sessions, 3, model), generator)


@pytest.mark.parametrize("in_tensors", [False, True], ids=["compiled", "tensors"])
@pytest.mark.parametrize("lapse", [0.0, 0.2])
@pytest.mark.parametrize("kind", ["choice", "weak"])
def test_the_posterior_is_that_of_the_formula(
    kind: str, lapse: float, in_tensors: bool, generator: Generator
) -> None:
    """A demonstration and a correction, each with a tau of its own, and two answers after them."""
    best, old = torch.randn(2, 3, generator=generator)
    others, options = torch.randn(2, 4, 3, generator=generator)
    answers, delta = (0, 1), 0.4
    model: ResponseModel = Boltzmann(TAU, Weak(delta) if kind == "weak" else None, lapse)
    if in_tensors:
        assert isinstance(model, Boltzmann)
        model = InTensors(model)
    sessions = 100 if in_tensors else 400
    given = [demonstration(best, others, TAU_SHOWN), correction(best, old, TAU_CORRECTED)]
    belief, state = heard(model, given, sessions, 2, generator)
    states = [state]
    for answer, query in zip(answers, options.view(2, 2, 3), strict=True):
        told = torch.full((sessions,), answer)
        state = tell(belief, state, query.expand(sessions, -1, -1), told, told, generator)
        states.append(state)

    rng = np.random.default_rng(0)
    omega = rng.standard_normal((200_000, 3))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    shown = [
        (best.numpy(), others.numpy(), TAU_SHOWN),
        (best.numpy(), old.numpy()[None], TAU_CORRECTED),
    ]
    log = direct(omega, shown)
    n_answers = 3 if kind == "weak" else 2
    for turn, after in enumerate(states):
        if turn:
            first, second = options.view(2, 2, 3)[turn - 1].numpy()
            logit = TAU * (omega @ (first - second)) * (1 - 2 * answers[turn - 1])
            picked = 1 / (1 + np.exp(-(logit - (delta if kind == "weak" else 0))))
            log += np.log((1 - lapse) * picked + lapse / n_answers)
        weights = np.exp(log - log.max())
        weights /= weights.sum()
        mean = weights @ omega
        assert 1 / np.square(weights).sum() > 5000
        means = after["samples"].double().mean(1).numpy()
        error = means.std(0) / math.sqrt(sessions) + 0.002
        assert (np.abs(means.mean(0) - mean) < 4 * error).all()
        spread = np.square(after["samples"].double().numpy() - mean).sum(-1).mean(1)
        expected = weights @ np.square(omega - mean).sum(1)
        assert abs(spread.mean() - expected) < 4 * (spread.std() / math.sqrt(sessions) + 0.001)
        assert after["ess"].mean() > 80


def ranks(env: QueryEnv) -> Tensor:
    """(B), of the human's third weight among the samples, after all answers."""
    data = env.rollout(env.budget, RandomQuery(1))[:, -1]
    samples, omega = data["next", "samples"], data["human", "omega"]
    return (samples[..., 2] < omega[:, None, 2]).sum(-1)


@pytest.mark.parametrize(("count", "alternatives"), [(2, 5), (1, 1)])
def test_beliefs_are_calibrated(count: int, alternatives: int) -> None:
    """ω from the prior, demonstrations and then three answers by the model: ω's rank is uniform."""
    pool = QueryPool(torch.randn(200, 2, 3, generator=Generator().manual_seed(5)))
    model, sessions, samples = Boltzmann(TAU), 1500, 99
    shown = Demonstrations(count, alternatives, TAU_SHOWN)
    env = QueryEnv(
        pool,
        SimulatedHuman(model),
        Belief(model, samples),
        3,
        batch_size=(sessions,),
        seed=0,
        demonstrations=shown,
    )
    counts = torch.bincount(ranks(env) // 10, minlength=10).double()
    expected = sessions / 10
    assert ((counts - expected).square() / expected).sum() < 27.9  # one in a thousand, 9 degrees


def test_demonstrations_are_drawn_by_a_boltzmann_human(generator: Generator) -> None:
    """How often each of three trajectories is shown, where they are all that there are."""
    features = torch.randn(3, 2, generator=generator)
    omega = uniform_sphere((2,), generator)
    shown = Demonstrations(1, 1, TAU_SHOWN)
    with pytest.raises(InputError, match="alternatives=3 of 3 trajectories"):
        Demonstrations(1, 3).draw(features, features, omega[None], Optimal(), generator)
    rows = shown.draw(features, features, omega.expand(60_000, 2), Boltzmann(1.0), generator)
    for one in range(3):
        for other in range(one):
            forth, back = (
                int(((rows[:, 0, 0] - gap).abs() < 1e-6).all(-1).sum())
                for gap in (features[one] - features[other], features[other] - features[one])
            )
            share = forth / (forth + back)
            expected = torch.sigmoid(TAU_SHOWN * (features[one] - features[other]) @ omega)
            assert share == pytest.approx(float(expected), abs=5 * 0.5 / math.sqrt(forth + back))


def test_alternatives_are_different_and_all_as_likely(generator: Generator) -> None:
    sets = different((24_000, 3), 5, generator).sort(-1).values
    assert (sets.diff(dim=-1) > 0).all()
    _, counts = sets.unique(dim=0, return_counts=True)
    assert len(counts) == 10
    assert ((counts - 2400).abs() < 5 * 2400**0.5).all()


@pytest.mark.parametrize("alternatives", [1, 4])
def test_who_never_errs_shows_the_best(alternatives: int, generator: Generator) -> None:
    """Their belief is uniform on what is left; what cannot be is left out, and hurts nothing."""
    features = torch.randn(20, 3, generator=generator)
    omega = uniform_sphere((200, 3), generator)
    shown = Demonstrations(3, alternatives)
    rows = shown.draw(features, features, omega, Optimal(), generator)
    assert ((rows @ omega[:, None, :, None]) >= -1e-6).all()
    belief = Belief(Optimal())
    state = begin(belief.prior(200, 3, generator), 2, 2)
    given = torch.cat([rows, -rows[:, :1]], 1)
    after = hear(
        belief, state, {"rows": given, "offsets": torch.zeros_like(given[..., 0])}, generator
    )
    returns = (after["samples"][:, :, None, None] * rows[:, None]).sum(-1)
    assert (returns > -1e-5).all()
    left_out = after["given"]["offsets"].isinf().all(-1)
    assert not left_out[:, :3].any()
    assert left_out[:, 3].float().mean() > 0.99
    query, answer = torch.randn(200, 2, 3, generator=generator), torch.zeros(200).long()
    again = tell(belief, after, query, answer, answer, generator)
    returns = (again["samples"][:, :, None, None] * rows[:, None]).sum(-1)
    assert (returns > -1e-5).all()


def test_a_demonstration_without_a_tau_is_as_careful_as_an_answer(generator: Generator) -> None:
    best, other = torch.randn(2, 3, generator=generator)
    rows = rows_of_shown([correction(best, other)], 1, 3, Boltzmann(TAU))["rows"]
    assert torch.equal(rows[0, 0, 0], best - other)
    found = rows_of_shown([correction(best, other, TAU)], 1, 3, Boltzmann(TAU))["rows"]
    assert torch.allclose(found, rows)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64])
def test_features_of_any_type_can_be_shown(kind: torch.dtype) -> None:
    given = [demonstration(torch.tensor([1, 2, 3]).to(kind), torch.ones(2, 3, dtype=kind))]
    session = Session(torch.rand(30, 2, 3), Boltzmann(2.0), given=given)
    assert session.weights.mean[2] > 0


def test_what_cannot_be_shown_is_refused() -> None:
    one, many = torch.ones(3), torch.ones(4, 3)
    model = Boltzmann(1.0)
    for make, words in (
        (lambda: demonstration(one, one), r"expected \(… D\) and \(… J D\)"),
        (lambda: demonstration(torch.ones(2), many), r"shown of shape \(2,\)"),
        (lambda: demonstration(one, many[:0]), "at least one"),
        (lambda: demonstration(one * math.nan, many), "shown: NaN"),
        (lambda: demonstration(one, many, 0), "tau=0: expected a finite number above 0"),
        (lambda: correction([1.0], one), "shown of type list"),  # type: ignore[arg-type]
        (lambda: rows_of_shown([correction(one, one)], 1, 4, model), "with D=4"),
        (lambda: rows_of_shown([correction(many, many)], 2, 3, model), "of each of 2"),
        (lambda: rows_of_shown([correction(one, one, 2.0)], 1, 3, Optimal()), "never errs"),
        (lambda: check_given(demonstration(one, many)), "given of type Shown: expected a list"),
        (lambda: check_given(None), "given of type NoneType: expected a list"),
        (lambda: check_given({}), "given of type dict: expected a list"),
        (lambda: check_given([3]), "given of type list: expected a list of what"),
        (lambda: Session(torch.rand(30, 2, 3), model, given=0), "given of type int"),
        (lambda: correction(one, [1.0]), "before of type list"),  # type: ignore[arg-type]
        (lambda: correction(one, torch.tensor(1.0)), r"before of shape \(\)"),
        (lambda: correction(one.double() * 1e300, one), "too large for float32"),
        (lambda: Shown([1.0]), "rows of type list"),  # type: ignore[arg-type]
        (lambda: Shown(torch.ones(3)), r"rows of shape \(3,\): expected \(… J D\)"),
        (lambda: Shown(torch.ones(1, 3), "x"), "tau='x': expected a finite number"),
        (lambda: Demonstrations(-1), "demonstrations.count=-1"),
        (lambda: Demonstrations(1, 0), "demonstrations.alternatives=0"),
        (lambda: Demonstrations(1, tau=-1.0), "tau=-1"),
    ):
        with pytest.raises(InputError, match=words):
            make()  # type: ignore[no-untyped-call]


def test_gradients_and_doubles_make_no_difference() -> None:
    rows = torch.tensor([[1.0, 2.0, 3.0]])
    plain = Session(torch.rand(30, 2, 3), Boltzmann(2.0), given=[Shown(rows)])
    for other in (rows.double(), rows.clone().requires_grad_()):
        same = Session(plain.pool, Boltzmann(2.0), given=[Shown(other)])
        assert same.to_dict() == plain.to_dict()
        assert torch.equal(same.samples, plain.samples)


def test_digests_tell_what_was_given(generator: Generator) -> None:
    best, other = torch.randn(2, 3, generator=generator)
    kinds = [(), (correction(best, other),), (correction(best, other, 2.0),)]
    kinds += [(correction(other, best),), (correction(best, other), correction(best, other))]
    assert len({given_digest(kind) for kind in kinds}) == len(kinds)
    assert given_digest(()) is None
