from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import coin, make, session_of
from reference import answer_probs
from torch import Generator
from torch.nn import functional as F

from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.objectives import OBJECTIVES, make_objective
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.response_model import ResponseModel


@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
def test_rewards_add_up_to_the_potential(kind: type, name: str, pool: QueryPool) -> None:
    free = {"skip": "free"} if kind is FeedEnv else {}
    env = make(kind, pool, objective=name, **free)
    data = env.rollout(5, coin(env), break_when_any_done=False)
    objective = make_objective(name)
    total = data["next", "reward"].sum(1)
    first, last = data["session"][:, 0], data["next", "session"][:, -1]
    gained = objective.gained(first, last, data["human"][:, 0])
    assert torch.allclose(total, gained, atol=1e-5)
    assert total.abs().min() > 1e-4 or kind is FeedEnv


@pytest.mark.parametrize("name", ["alignment", "true_alignment"])
@pytest.mark.parametrize("model", RESPONSE_MODELS, ids=str)
def test_forecast_agrees_with_brute_force(model: ResponseModel, name: str, pool: QueryPool) -> None:
    env = make(QueryEnv, pool, model, objective=name)
    session = session_of(env)
    queries = session["queries"][:, :6]
    forecast = make_objective(name).forecast(session["session"], session["human"], queries, model)
    tau = getattr(model, "tau", None)
    for b in range(4):
        samples, omega = (
            session[key][b].double().numpy() for key in ("samples", ("human", "omega"))
        )
        for c in range(6):
            options = queries[b, c].double().numpy()
            table = np.array([answer_probs(options @ sample, tau) for sample in samples])
            theirs = answer_probs(options @ omega, tau)
            value = 0.0
            for q in range(2):
                weights = table[:, q]
                if weights.sum() == 0:
                    continue
                mean = weights @ samples / weights.sum()
                if name == "alignment":
                    value += weights.mean() * mean @ mean
                else:
                    value += theirs[q] * mean @ omega
            mean = samples.mean(0)
            value -= mean @ (mean if name == "alignment" else omega)
            assert float(forecast[b, c]) == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize("name", OBJECTIVES)
def test_forecast_is_the_mean_of_what_asking_adds(name: str, pool: QueryPool) -> None:
    """Over humans drawn from the prior, by whatever they answer."""
    model = RESPONSE_MODELS[0]
    env = QueryEnv(
        pool, SimulatedHuman(model), Belief(model), 1, batch_size=(3000,), objective=name, seed=0
    )
    session = env.reset()
    session["action"] = torch.full((3000,), 7)
    known, human, asked = session["session"], session["human"], session["queries"][:, 7:8]
    forecast = make_objective(name).forecast(known, human, asked, model)
    reward = env.step(session)["next", "reward"]
    error = (reward - forecast).std() / 3000**0.5
    # Of 100 samples, both the length of the mean and the nearest distances are a little biased.
    slack = {"alignment": 0.01, "entropy": 0.1}.get(name, 0.0)
    assert float((reward - forecast).mean()) == pytest.approx(0, abs=5 * float(error) + slack)
    assert forecast.mean() > 0.02


def test_regret_costs_what_asking_would_have_gained(pool: QueryPool) -> None:
    for name in OBJECTIVES:
        env = make(FeedEnv, pool, objective=name, skip="regret")
        session = env.reset()
        asked = env.step(session.clone().set("action", torch.ones(4, dtype=torch.long)))
        skipped = env.step(session.clone().set("action", torch.zeros(4, dtype=torch.long)))
        assert torch.equal(asked["next", "reward"], -skipped["next", "reward"])
        forecast = make_objective(name).forecast(
            session["session"],
            session["human"],
            session["offer"].unsqueeze(1),
            env.belief.response_model,
        )
        assert torch.allclose(asked["next", "reward"], forecast, atol=1e-6)


def test_skips_are_free_and_offers_run_out(pool: QueryPool) -> None:
    env = make(FeedEnv, pool, objective="alignment", skip="free")
    session = env.reset()
    for _ in range(25):
        session["action"] = torch.zeros(4, dtype=torch.long)
        session = env.step(session)["next"]
        assert (session["reward"] == 0).all()
    assert session["terminated"].all()
    assert not session["truncated"].any()


@pytest.mark.parametrize("on_skip", ["new", "repeat"])
def test_running_out_of_free_offers_is_an_end_and_no_interruption(
    on_skip: str, pool: QueryPool
) -> None:
    """An interruption would tell the critic to add what might have come after the last offer."""
    env = make(FeedEnv, pool, batch=60, offers=9, skip="free", on_skip=on_skip)
    data = env.rollout(9, coin(env, 1), break_when_any_done=False)
    assert data.shape == (60, 9)
    ended = data["next", "done"].squeeze(-1)
    out_of_offers = (data["next", "n_offered"] == 9).squeeze(-1)
    full = (data["next", "n_asked"] == 5).squeeze(-1)
    assert torch.equal(ended, out_of_offers | full)
    assert (out_of_offers & ~full).any()
    assert (full & ~out_of_offers).any()
    assert torch.equal(data["next", "terminated"], data["next", "done"])
    assert not data["next", "truncated"].any()


def test_entropy_falls_by_a_bit_for_a_halved_interval() -> None:
    """On the circle: D - 1 = 1 direction. A belief half as wide has lost one bit."""
    potentials = []
    for width in (0.4, 0.2):
        angles = torch.linspace(-width, width, 400)
        samples = torch.stack([angles.cos(), angles.sin()], -1).unsqueeze(0)
        potentials.append(make_objective("entropy").potential({"samples": samples}, {}))  # type: ignore[arg-type]
    assert float(potentials[1] - potentials[0]) == pytest.approx(1, abs=0.02)


def test_entropy_is_told_by_the_distance_to_the_third_nearest(generator: Generator) -> None:
    samples = F.normalize(torch.randn(2, 30, 4, generator=generator), dim=-1)
    expected = []
    for each in samples.double().numpy():
        distances = np.linalg.norm(each[:, None] - each, axis=-1)
        third = np.sort(distances, axis=1)[:, 3]  # the nearest of all is the sample itself
        expected.append(-3 * np.log2(third).mean())
    samples = 3 * samples  # their lengths are no part of ω
    potential = make_objective("entropy").potential({"samples": samples}, {})  # type: ignore[arg-type]
    assert potential.squeeze(-1).tolist() == pytest.approx(expected, abs=1e-4)
    with pytest.raises(InputError, match="objective=entropy with 3 samples"):
        make_objective("entropy").potential({"samples": samples[:, :3]}, {})  # type: ignore[arg-type]


def test_unknown_objective_is_refused() -> None:
    with pytest.raises(InputError, match="objective='fun'"):
        make_objective("fun")


def test_humans_of_a_spread_differ_in_care(pool: QueryPool) -> None:
    model = RESPONSE_MODELS[0]
    human = SimulatedHuman(model, spread=4.0)
    drawn = human.draw(4000, 1, 2, 4, torch.Generator().manual_seed(0))
    assert drawn["care"].min() >= 0.25
    assert drawn["care"].max() <= 4
    assert float(drawn["care"].log().mean()) == pytest.approx(0, abs=0.07)
    queries = pool.features[:1].expand(4000, -1, -1)
    returns = (queries @ drawn["omega"].unsqueeze(-1)).squeeze(-1)
    right = human.respond(queries, drawn, torch.zeros(4000, dtype=torch.long)) == returns.argmax(-1)
    careful = drawn["care"].squeeze(-1) > 1
    assert right[careful].float().mean() > right[~careful].float().mean() + 0.05
    with pytest.raises(InputError, match=r"spread=0.5"):
        SimulatedHuman(model, spread=0.5)
