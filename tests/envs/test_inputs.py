"""Wrong values through the Python API: each is refused in one clear sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import RESPONSE_MODELS
from helpers import told
from tensordict import TensorDict
from torch import Generator

from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool, balance
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.responses import Boltzmann, Optimal

MODEL = RESPONSE_MODELS[0]

HISTORY = ("session", "history")


def env_of(kind: type, pool: QueryPool, **options: Any) -> QueryEnv | FeedEnv:
    options = {"budget": 5, "batch_size": (4,), **options}
    return kind(pool, SimulatedHuman(MODEL), Belief(MODEL, 20, 2), **options)


def refused(action: Callable[[], Any]) -> str:
    """The one line with which something is refused."""
    with pytest.raises(InputError) as error:
        action()
    line = str(error.value)
    assert "\n" not in line
    assert "expected" in line
    return line


# Answers


@pytest.mark.parametrize("answers", [[1, 2], [-2, 0], [0, 7]])
def test_answers_out_of_range_do_not_wrap_round(answers: list[int]) -> None:
    line = refused(lambda: feature_gaps(torch.rand(2, 2, 3), torch.tensor(answers)))
    assert f"answers from {min(answers)} to {max(answers)}: expected -1 to 1" in line


def test_answers_are_whole_numbers_or_truth_values() -> None:
    queries = torch.rand(3, 2, 4)
    assert "dtype torch.float32" in refused(lambda: feature_gaps(queries, torch.zeros(3)))
    assert "list" in refused(lambda: feature_gaps(queries, [0, 1, 1]))  # type: ignore[arg-type]
    expected = feature_gaps(queries, torch.tensor([0, 1, 1]))
    for kind in (torch.int32, torch.uint8, torch.bool):
        found = feature_gaps(queries, torch.tensor([0, 1, 1]).to(kind))
        assert torch.equal(found, expected)


# Actions


@pytest.mark.parametrize("action", [2, -1, 10**9])
def test_a_feed_takes_0_and_1(action: int, pool: QueryPool) -> None:
    env = env_of(FeedEnv, pool)
    session = env.reset()
    actions = torch.tensor([0, 1, action, 1])
    assert "1 to ask and 0 to skip" in refused(lambda: env.step(session.set("action", actions)))


@pytest.mark.parametrize("action", [10, -1])
def test_a_query_is_one_of_the_candidates(action: int, pool: QueryPool) -> None:
    env = env_of(QueryEnv, pool, candidates=10)
    session = env.reset().set("action", torch.tensor([0, action, 3, 9]))
    assert "expected 0 to 9, the place of a candidate" in refused(lambda: env.step(session))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.rand(4), "dtype torch.float32"),
        (torch.zeros(4, 1, dtype=torch.int64), r"shape (4, 1): expected (4,)"),
        (torch.zeros(4, 2, dtype=torch.int64), r"shape (4, 2): expected (4,)"),
    ],
)
@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
def test_an_action_is_one_whole_number_a_session(
    kind: type, action: torch.Tensor, message: str, pool: QueryPool
) -> None:
    env = env_of(kind, pool)
    session = env.reset().set("action", action)
    assert message in refused(lambda: env.step(session))


def test_a_masked_query_is_not_asked_again(pool: QueryPool) -> None:
    env = env_of(QueryEnv, QueryPool(pool.features[:6]), repeats=False, budget=2)
    session = env.reset().set("action", torch.tensor([0, 1, 2, 3]))
    after = env.step(session)["next"]
    again = after.clone().set("action", torch.tensor([1, 1, 3, 4]))
    message = refused(lambda: env.step(again))
    assert "asked before, or twice in one action, where repeats=False" in message
    ended = env.step(after.set("action", torch.tensor([1, 2, 3, 4])))["next"]
    assert ended["done"].all()
    env.step(ended.set("action", torch.tensor([1, 2, 3, 4])))  # what is over stays over


# Weights, gaps, features


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_belief_is_not_updated_by_what_is_not_finite(bad: float, generator: Generator) -> None:
    belief = Belief(MODEL, 20, 2)
    samples = belief.prior(3, 4, generator)
    ess = torch.full((3,), 20.0)
    earlier, newest = torch.zeros(3, 2, 1, 4), torch.rand(3, 1, 4)
    belief.update(samples, ess, told(earlier, newest), generator)
    for spoiled in (samples, earlier, newest):
        kept = spoiled[1].clone()
        spoiled[1].view(-1)[2] = bad
        refused(lambda: belief.update(samples, ess, told(earlier, newest), generator))
        spoiled[1] = kept


@pytest.mark.parametrize("bad", [math.nan, -math.inf])
def test_what_is_not_finite_is_refused_where_it_comes_in(bad: float, generator: Generator) -> None:
    features = torch.rand(10, 2, 3)
    human = SimulatedHuman(MODEL).draw(10, 2, 2, 3, generator)
    turn = torch.zeros(10, dtype=torch.int64)
    human["omega"][4, 1] = bad
    assert "human's returns" in refused(
        lambda: SimulatedHuman(MODEL).respond(features, human, turn)
    )
    features[7, 0, 1] = bad
    refused(lambda: Normalizer.fit(features))
    refused(lambda: balance(features))
    refused(lambda: calibrate_tau(features))


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (torch.rand(5, 2, 3).to(torch.complex64), "complex numbers"),
        (torch.rand(5, 2, 3).to_sparse(), "a sparse tensor"),
        (torch.rand(5, 2, 3, device="meta"), "without values"),
        (torch.rand(5, 2, 3).double() * 1e300, "beyond float32"),
        ((torch.rand(5, 2, 3).double() + 1) * 1e-60, "0 in float32"),
        ([[[1.0]]], "of type list"),
    ],
)
def test_features_are_numbers_that_float32_can_hold(features: Any, message: str) -> None:
    assert message in refused(lambda: QueryPool(features))


@pytest.mark.parametrize("kind", [torch.bool, torch.int64, torch.float16, torch.float64])
def test_other_real_numbers_are_taken_as_they_are(kind: torch.dtype) -> None:
    given = torch.tensor([[[0, 1], [1, 0]], [[1, 1], [0, 1]]]).to(kind)
    pool = QueryPool(given)
    assert pool.features.dtype == torch.float32
    assert torch.equal(pool.features.double(), given.double())


def test_a_pool_has_its_own_features_without_gradients(tmp_path: Path) -> None:
    learned = torch.nn.Parameter(torch.rand(50, 2, 3))
    for given in (learned, learned * 2):
        pool = QueryPool(given, trajectories=given)
        assert not pool.features.requires_grad
        pool.save(tmp_path / "pool.pt")
        assert QueryPool.load(tmp_path / "pool.pt").digest == pool.digest
    pool, before = QueryPool(learned), learned.detach().clone()
    learned.data[0] = math.nan
    assert torch.equal(pool.features, before)


def test_a_view_is_saved_without_the_rest_of_its_tensor(tmp_path: Path) -> None:
    whole, walks = torch.rand(100_000, 2, 4), torch.rand(100_000, 2, 20)
    pool = QueryPool(whole[5:10], walks[5:10])
    pool.save(tmp_path / "pool.pt")
    assert (tmp_path / "pool.pt").stat().st_size < 10_000
    loaded = QueryPool.load(tmp_path / "pool.pt")
    assert torch.equal(loaded.features, whole[5:10])
    assert torch.equal(loaded.trajectories, walks[5:10])
    QueryPool(whole[:1].expand(5, 2, 4), walks[:1].expand(5, 2, 20)).save(tmp_path / "pool.pt")
    assert len(QueryPool.load(tmp_path / "pool.pt")) == 5


@pytest.mark.parametrize(
    "shown",
    [[1], torch.zeros(5, 2).to_sparse(), torch.zeros(5, 2, dtype=torch.complex64)],
    ids=["list", "sparse", "complex"],
)
def test_trajectories_that_could_not_be_saved_are_refused(shown: Any) -> None:
    assert "trajectories" in refused(lambda: QueryPool(torch.rand(5, 2, 3), shown))


# Response models


@pytest.mark.parametrize("tolerance", [math.nan, -1, math.inf, "0", None, True])
def test_a_tolerance_is_finite_and_not_negative(tolerance: Any) -> None:
    assert "tolerance=" in refused(lambda: Optimal(tolerance))
    assert Optimal(0).tolerance == 0


@pytest.mark.parametrize("tau", [math.nan, math.inf, 0, -1, 1e31, 1e300, "2", None, True, 1j])
def test_a_tau_is_finite_above_0_and_fits_float32(tau: Any) -> None:
    assert "tau=" in refused(lambda: Boltzmann(tau))


@pytest.mark.parametrize("spread", [math.nan, 0.5, 1e7, None])
def test_a_spread_is_a_factor(spread: Any) -> None:
    refused(lambda: SimulatedHuman(MODEL, spread))


@pytest.mark.parametrize("returns", [torch.rand(3, 0), torch.rand(0, 2), torch.rand(()), [0.5]])
def test_tau_is_calibrated_on_returns_of_options(returns: Any) -> None:
    refused(lambda: calibrate_tau(returns))


@pytest.mark.parametrize("model", [0.5, None, Boltzmann, "optimal"])
def test_a_belief_and_a_human_have_a_response_model(model: Any) -> None:
    for kind in (Belief, SimulatedHuman):
        assert "expected a ResponseModel, such as Boltzmann(2.0)" in refused(
            lambda k=kind: k(model)
        )


# Environments


@pytest.mark.parametrize("kind", [QueryEnv, FeedEnv])
@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, torch.rand(9, 2, 3), "pool of type Tensor: expected a QueryPool"),
        (1, MODEL, "human of type Boltzmann: expected a HumanBase, such as SimulatedHuman"),
        (1, None, "human of type NoneType"),
        (2, MODEL, "belief of type Boltzmann: expected a Belief"),
        (2, SimulatedHuman(MODEL), "belief of type SimulatedHuman"),
    ],
)
def test_environments_say_what_they_are_made_of(
    kind: type, place: int, value: Any, message: str, pool: QueryPool
) -> None:
    arguments = [pool, SimulatedHuman(MODEL), Belief(MODEL)]
    arguments[place] = value
    assert message in refused(lambda: kind(*arguments))


@pytest.mark.parametrize(
    "options",
    [
        {"batch_size": (0,)},
        {"batch_size": (2.5,)},
        {"batch_size": 4},
        {"seed": -1},
        {"seed": "a"},
        {"budget": math.nan},
        {"objective": "regret"},
    ],
)
def test_environments_refuse_other_numbers(options: dict[str, Any], pool: QueryPool) -> None:
    refused(lambda: env_of(QueryEnv, pool, **options))


# State that is given


def humans(pool: QueryPool, **options: Any) -> TensorDict:
    return env_of(QueryEnv, pool, **options).reset().select("human")


def test_humans_of_another_session_are_refused(pool: QueryPool, generator: Generator) -> None:
    env = env_of(QueryEnv, pool)
    for given, message in (
        (humans(pool, budget=3), "human.noise of shape (4, 3, 2): expected (4, 5, 2)"),
        (humans(pool, budget=9), "human.noise of shape (4, 9, 2): expected (4, 5, 2)"),
        (humans(QueryPool(torch.rand(9, 3, 4))), "human.noise of shape (4, 5, 3)"),
        (humans(QueryPool(torch.rand(9, 2, 3))), "human.omega of shape (4, 3): expected (4, 4)"),
        (TensorDict({"humans": torch.ones(4)}, [4]), "set_state=True with none of"),
        (TensorDict({"human": torch.ones(4)}, [4]), "set_state=True with none of"),
    ):
        assert message in refused(lambda g=given: env.reset(g, set_state=True))


def spoiled(pool: QueryPool, key: Any, change: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """A session after three answers, with one part of its state changed."""
    env = env_of(FeedEnv, pool)
    state = env.reset()
    for _ in range(3):
        state = env.step_mdp(env.step(state.set("action", torch.tensor([1, 1, 1, 1]))))
    state = state.select(*env.state_spec.keys()).clone()
    env.reset(state, set_state=True)  # as it is, it is taken
    state[key] = change(state[key])
    return lambda: env.reset(state, set_state=True)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        (("human", "omega"), lambda x: x * math.nan, "human.omega: NaN"),
        (("human", "omega"), lambda x: x / 0.0, "human.omega: NaN, infinity"),
        (("human", "omega"), lambda x: x * 0, "omega of length 0"),
        (("human", "omega"), lambda x: x.to(torch.complex64), "complex"),
        (("human", "omega"), lambda x: x.double() * 1e300, "too large for float32"),
        (("human", "care"), lambda x: -x, "human.care of 0 or less"),
        (("session", "samples"), lambda x: x * 2, "samples that are not of length 1"),
        (
            ("session", "samples"),
            lambda x: x.long(),
            "samples of dtype torch.int64: expected torch.float32",
        ),
        ((*HISTORY, "answers"), lambda x: x + 1, "history.answers from 0 to 2: expected -3 to 1"),
        ((*HISTORY, "answers"), lambda x: x - 3, "history.answers from -4 to -"),
        ((*HISTORY, "index"), lambda x: x + 60, "history.index from"),
        ((*HISTORY, "index"), lambda x: x * 0, "n_asked contradict each other"),
        ((*HISTORY, "options"), lambda x: x / 0.0, "history.options: NaN"),
        (("session", "n_asked"), lambda x: x + 9, "n_asked from 12 to 12: expected 0 to 5"),
        (("session", "n_asked"), lambda x: x - 1, "n_asked contradict each other"),
        (("session", "n_offered"), lambda x: x - 9, "n_offered from -6 to -6: expected 0 to 25"),
        ("offers", lambda x: x - 60, "offers from"),
        (("session", "ess"), lambda x: x * math.nan, "session.ess: NaN"),
    ],
)
def test_an_impossible_state_is_refused(
    key: Any, change: Callable[[torch.Tensor], torch.Tensor], message: str, pool: QueryPool
) -> None:
    assert message in refused(spoiled(pool, key, change))


def test_a_history_comes_with_its_belief_and_whole(pool: QueryPool) -> None:
    env = env_of(QueryEnv, pool)
    state = env.step(env.reset().set("action", torch.tensor([1, 2, 3, 4])))["next"]
    history, n_asked, samples = (("session", key) for key in ("history", "n_asked", "samples"))
    assert "without the samples" in refused(
        lambda: env.reset(state.select(history, n_asked), set_state=True)
    )
    assert "a history in part" in refused(
        lambda: env.reset(state.select(history, samples), set_state=True)
    )


def test_given_numbers_of_another_width_are_converted(pool: QueryPool) -> None:
    given = humans(pool)
    given["human", "omega"] = uniform_sphere((4, 4), Generator().manual_seed(3)).double()
    session = env_of(QueryEnv, pool).reset(given, set_state=True)
    assert session["human", "omega"].dtype == torch.float32
    assert torch.equal(session["human", "omega"].double(), given["human", "omega"])
