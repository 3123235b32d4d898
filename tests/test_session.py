"""Ask and tell, as somebody uses it who knows neither TorchRL nor the environments."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref import (
    Boltzmann,
    FeedEnv,
    Normalizer,
    Optimal,
    QueryPool,
    Session,
    Weak,
    gridworld_pool,
)
from torchrl_pref.asking import NothingToAsk
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.transition import begin, tell
from torchrl_pref.errors import InputError
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pretrained import pretrained_policy
from torchrl_pref.questions.prior_evidence import correction, demonstration
from torchrl_pref.strategies import FEED_STRATEGIES, STRATEGIES, RandomQuery

MODEL = Boltzmann(3.0)


def converse(session: Session, omega: torch.Tensor, turns: int) -> list[int]:
    """Ask, and answer by the higher reward; the queries that were asked."""
    asked = []
    for _ in range(turns):
        question = session.ask()
        asked.append(int(question.query))
        session.tell(int((question.features @ omega).argmax()))
    return asked


@pytest.mark.parametrize("strategy", [*STRATEGIES, "policy", lambda env: RandomQuery(7)])
@pytest.mark.parametrize("model", [MODEL, Optimal()], ids=str)
def test_what_a_person_wants_is_found(strategy: Any, model: Any, generator: Generator) -> None:
    features = torch.randn(300, 2, 4, generator=generator)
    session = Session(features, model, strategy, budget=10)
    omega = torch.tensor([0.5, -0.5, 0.5, 0.5])
    converse(session, omega, 10)
    assert session.n_answered == 10
    weights = session.weights
    assert weights.mean.shape == (4,)
    assert (weights.low < weights.mean).all()
    assert (weights.mean < weights.high).all()
    assert torch.cosine_similarity(weights.mean, omega, dim=0) > 0.7
    mean, sd = session.score(features[:50, 0])
    assert torch.corrcoef(torch.stack([mean, features[:50, 0] @ omega]))[0, 1] > 0.7
    assert (sd > 0).all()
    with pytest.raises(InputError, match="budget=10: all questions are answered"):
        session.ask()


@pytest.mark.parametrize("strategy", ["alignment_gain", "random", "policy"])
@pytest.mark.parametrize("at", [0, 3, 6])
def test_it_goes_on_bit_for_bit_from_json(strategy: str, at: int, generator: Generator) -> None:
    pool = QueryPool(torch.randn(100, 2, 5, generator=generator))
    omega = torch.randn(5, generator=generator)
    whole = Session(pool, MODEL, strategy, budget=9, seed=4)
    asked = converse(whole, omega, 9)
    first = Session(pool, MODEL, strategy, budget=9, seed=4)
    assert converse(first, omega, at) == asked[:at]
    if at:
        first.ask()  # a question that is open
    text = json.dumps(first.to_dict())
    second = Session.from_dict(json.loads(text), pool, MODEL, strategy)
    assert converse(second, omega, 9 - at) == asked[at:]
    assert torch.equal(second.samples, whole.samples)
    assert second.to_dict() == whole.to_dict()


def test_what_was_given_first_is_known_and_goes_on(generator: Generator) -> None:
    """A demonstration and a correction, of one person and of two, through JSON; not of others."""
    pool = QueryPool(torch.randn(100, 2, 4, generator=generator))
    omega = torch.tensor([0.6, 0.0, -0.8, 0.0])
    others = torch.randn(40, 4, generator=generator)
    best = others[(others @ omega).argmax()]
    given = [demonstration(best, others, 5.0), correction(best, others[0])]
    plain, session = Session(pool, MODEL, seed=4), Session(pool, MODEL, seed=4, given=given)
    cosines = [torch.cosine_similarity(one.weights.mean, omega, dim=0) for one in (plain, session)]
    assert cosines[1] > max(0.6, float(cosines[0]))
    converse(session, omega, 3)
    content = json.loads(json.dumps(session.to_dict()))
    again = Session.from_dict(content, pool, MODEL, given=given)
    assert torch.equal(again.samples, session.samples)
    assert converse(again, omega, 2) == converse(session, omega, 2)
    for wrong in ((), given[:1], given[::-1]):
        with pytest.raises(InputError, match="given: the session was made with"):
            Session.from_dict(content, pool, MODEL, given=wrong)
    with pytest.raises(InputError, match="given of a session"):
        Session.from_dict({**content, "given": 3}, pool, MODEL, given=given)
    old = plain.to_dict()
    del old["given"]  # as before there was such a thing
    assert torch.equal(Session.from_dict(old, pool, MODEL).samples, plain.samples)
    while session.n_answered:
        session.undo()
    assert torch.equal(session.samples, Session(pool, MODEL, seed=4, given=given).samples)
    two = torch.stack([best, -best])
    side_by_side = Session(pool, MODEL, people=2, given=[correction(two, -two, 5.0)])
    assert (side_by_side.weights.mean @ best * torch.tensor([1.0, -1.0]) > 0).all()


def test_undo_takes_back_and_asks_again(generator: Generator) -> None:
    features = torch.randn(60, 2, 4, generator=generator)
    session, straight = (Session(features, MODEL, seed=2) for _ in range(2))
    omega = torch.tensor([1.0, 0.0, 0.0, 0.0])
    converse(session, omega, 3)
    before = session.samples
    question = session.ask()
    slip = int((question.features @ omega).argmin())
    session.tell(slip)
    session.undo()
    assert torch.equal(session.samples, before)
    assert session.ask().query == question.query
    converse(session, omega, 2)
    converse(straight, omega, 5)
    assert torch.equal(session.samples, straight.samples)
    for _ in range(5):
        session.undo()
    with pytest.raises(InputError, match="nothing to undo"):
        session.undo()


def test_people_side_by_side_are_as_each_alone(generator: Generator) -> None:
    """Their questions and answers, that is; their luck is not the same."""
    features = torch.randn(50, 2, 3, generator=generator)
    session = Session(features, MODEL, "volume_removal", people=3, budget=6)
    for turn in range(6):
        question = session.ask()
        assert question.features.shape == (3, 2, 3)
        session.tell([0, 1, None if turn == 2 else 0])
    assert session.weights.mean.shape == (3, 3)
    assert session.score(features[:7, 0])[0].shape == (3, 7)
    session.undo()
    with pytest.raises(InputError, match="a list, one for each person"):
        session.tell(0)


def test_no_answer_teaches_nothing(generator: Generator) -> None:
    session = Session(torch.randn(50, 2, 3, generator=generator), MODEL)
    before = session.samples
    session.ask()
    session.tell(None)
    assert session.n_answered == 1
    assert torch.equal(session.samples, before)


def test_what_a_person_would_not_answer_is_not_asked_again(generator: Generator) -> None:
    session = Session(torch.randn(50, 2, 3, generator=generator), MODEL, budget=6)
    asked = []
    for _ in range(6):
        asked.append(int(session.ask().query))
        session.tell(None)
    assert len(set(asked)) == 6


def test_each_turn_has_luck_of_its_own(generator: Generator) -> None:
    features = torch.randn(50, 2, 3, generator=generator)
    session = Session(features, MODEL, "random", budget=6, repeats=True)
    assert len(set(converse(session, torch.ones(3), 6))) > 3


def test_parts_that_contradict_each_other_are_refused(generator: Generator) -> None:
    features = torch.randn(50, 2, 3, generator=generator)
    for given, words in (
        ({"belief": Belief(Boltzmann(1.0))}, "expected the same"),
        ({"belief": 3}, "belief of type int"),
        ({"normalizer": 3}, "normalizer of type int"),
        ({"strategy": lambda env: 3}, "what strategy makes"),
        ({"strategy": "greedy"}, "strategy='greedy': expected one of random"),
        ({"budget": 51}, "candidates"),
        ({"people": 0}, "people=0"),
    ):
        with pytest.raises(InputError, match=words):
            Session(features, MODEL, **given)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="features"):
        Session(features, MODEL).score(torch.full((2, 3), torch.nan))


def test_models_tell_themselves_apart() -> None:
    assert repr(Boltzmann(2.0)) == "Boltzmann(tau=2)"
    assert repr(Boltzmann(2.0000001)) != repr(Boltzmann(2.0))
    assert repr(Optimal(0.5)) != repr(Optimal())


def test_other_kinds_of_question(generator: Generator) -> None:
    session = Session(torch.randn(50, 2, 3, generator=generator), Boltzmann(3.0, Weak(0.5)))
    session.ask()
    session.tell(2)  # about equal
    session.ask()
    with pytest.raises(InputError, match="answer=3: expected a whole number from 0 to 2"):
        session.tell(3)


@pytest.mark.parametrize("whole", [int, np.int64, torch.tensor])
def test_whole_numbers_of_any_library_will_do(whole: Any, generator: Generator) -> None:
    features = torch.randn(50, 2, 3, generator=generator)
    plain, other = (Session(features, MODEL) for _ in range(2))
    plain.put(7)
    other.put(whole(7))
    plain.tell(1)
    other.tell(whole(1))
    assert torch.equal(plain.samples, other.samples)
    other.put(other.ask().query)
    both = Session(features, MODEL, people=2)
    both.put(np.array([3, 4]))
    assert both.ask().query.tolist() == [3, 4]
    both.tell(torch.tensor([0, 1]))
    assert both.n_answered == 1


@pytest.mark.parametrize("query", [1.5, None, "3", [1.5], True, 50, -1, [1, 2]])
def test_what_is_no_query_changes_nothing(query: Any, generator: Generator) -> None:
    session = Session(torch.randn(50, 2, 3, generator=generator), MODEL)
    question = session.ask()
    with pytest.raises(InputError, match="each a whole number from 0 to 49"):
        session.put(query)
    assert session.ask().query == question.query
    feed = Session(torch.randn(50, 2, 3, generator=generator), MODEL, setup="feed", budget=4)
    with pytest.raises(InputError, match="at most the 20 offers"):
        feed.put(1, n_offered=21)


def test_nothing_of_a_session_is_in_the_hands_of_others(generator: Generator) -> None:
    features = torch.randn(50, 2, 3, generator=generator)
    state = torch.get_rng_state()
    session = Session(features, MODEL, "policy")
    session.ask()
    session.tell(0)
    assert torch.equal(torch.get_rng_state(), state)
    kept = session.samples
    session.samples.zero_()
    assert torch.equal(session.samples, kept)


def test_features_whose_squares_are_infinite_are_no_policy_s() -> None:
    with pytest.raises(InputError, match="normalise the pool"):
        Session(1e20 * torch.rand(30, 2, 3), MODEL, "policy")


@pytest.mark.parametrize("answer", [2, -1, 0.0, True, "0", [0], torch.tensor(2), np.True_])
def test_what_is_no_answer_changes_nothing(answer: Any, generator: Generator) -> None:
    session = Session(torch.randn(50, 2, 3, generator=generator), MODEL)
    with pytest.raises(InputError, match=r"expected ask\(\) before tell\(\)"):
        session.tell(0)
    question, before = session.ask(), session.samples
    with pytest.raises(InputError):
        session.tell(answer)
    assert session.ask().query == question.query
    assert torch.equal(session.samples, before)
    assert session.n_answered == 0


@pytest.mark.parametrize(
    "spoil",
    [
        {"format": 2},
        {"answers": [[0], [7]]},
        {"answers": [[0]]},
        {"queries": [[1], [99]]},
        {"queries": [[1, 2], [3, 4]]},
        {"queries": "import os"},
        {"gone": []},
        {"offered": [1, 2]},
        {"offered": [-1]},
        {"people": 2**70},
        {"budget": 10**8},
        {"seed": "0"},
        {"budget": 1},
        {"pool": "0" * 64},
        {"belief": "Belief(n_samples=50, n_moves=None)"},
        {"strategy": "random"},
        {"answers": [[0], [10**30]]},
        {"answers": [[0, 1], [0]]},
        {"repeats": 0},
        {"response_model": "Boltzmann(tau=4)"},
        {"asked": [50]},
        {"answer": [[0], [1]]},
        {"budget": 2, "asked": [3]},
    ],
)
def test_spoiled_sessions_are_refused(spoil: dict[str, Any], generator: Generator) -> None:
    features = torch.randn(50, 2, 3, generator=generator)
    session = Session(features, MODEL)
    converse(session, torch.ones(3), 2)
    with pytest.raises(InputError) as error:
        Session.from_dict({**session.to_dict(), **spoil}, features, MODEL)
    assert "\n" not in str(error.value)


def test_what_a_page_makes_of_an_index_is_not_the_session_s(generator: Generator) -> None:
    session = Session(torch.randn(20, 2, 3, generator=generator), MODEL)
    index = session.ask().query
    before = int(index)
    index += 1
    session.tell(0)
    assert session.to_dict()["queries"] == [[before]]


def test_returns_whose_squares_are_too_large_have_a_deviation(generator: Generator) -> None:
    session = Session(torch.randn(20, 2, 3, generator=generator), MODEL)
    mean, deviation = session.score(torch.tensor([[1e38, 1e38, -1e38]]))
    assert mean.isfinite().all()
    assert 0 < float(deviation) < 2e38


def test_raw_features_are_normalised_where_the_session_knows_how() -> None:
    raw = gridworld_pool(40)
    normalizer = Normalizer.fit(raw.features)
    pool = raw.map_features(normalizer)
    told = Session(pool, MODEL, normalizer=normalizer)
    assert told.ask().trajectories is not None
    plain = Session(pool, MODEL)
    found, _ = told.score(raw.features[:, 0])
    expected, _ = plain.score(pool.features[:, 0])
    assert torch.allclose(found, expected, atol=1e-5)


def test_gradients_of_features_end_where_they_are_given() -> None:
    raw = torch.rand(30, 2, 3, generator=Generator().manual_seed(0), requires_grad=True)
    normalizer = Normalizer.fit(raw)
    pool = QueryPool(raw).map_features(normalizer)
    for given in (None, normalizer):
        session = Session(pool, MODEL, normalizer=given)
        session.ask()
        session.tell(0)
        found = [*session.score(raw[:, 0]), session.weights.mean, normalizer.mean, normalizer.std]
        assert not any(one.requires_grad for one in found)
        assert torch.equal(found[0], session.score(raw[:, 0].detach())[0])


@pytest.mark.parametrize("shape", [(), (3,), (2, 4), (1, 2, 3)])
@pytest.mark.parametrize("normalized", [False, True])
def test_only_rows_of_features_are_scored(shape: tuple[int, ...], normalized: bool) -> None:
    features = torch.rand(30, 2, 3, generator=Generator().manual_seed(0))
    normalizer = Normalizer.fit(features) if normalized else None
    session = Session(features, MODEL, normalizer=normalizer)
    with pytest.raises(InputError, match=r"expected \(n, 3\)"):
        session.score(torch.ones(shape))


def test_it_aligns_as_the_environment_does(generator: Generator) -> None:
    """Thirty simulated people at once, as well as thirty in an environment would."""
    features = torch.randn(200, 2, 4, generator=generator)
    people, human = 30, SimulatedHuman(MODEL)
    drawn = human.draw(people, 12, 2, 4, generator)
    session = Session(features, MODEL, people=people, budget=12, belief=Belief(MODEL, 60))
    for turn in range(12):
        answers = human.respond(session.ask().features, drawn, torch.full((people,), turn))
        session.tell(answers.tolist())
    cosines = torch.einsum("bmd,bd->bm", session.samples, drawn["omega"])
    assert 0.8 < float(cosines.mean()) < 0.97


def test_importing_it_takes_neither_collectors_nor_plotting() -> None:
    heavy = ("torchrl.collectors", "matplotlib", "hydra", "tensorboard")
    code = "import sys; from torchrl_pref import Session; "
    code += f"print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("strategy", ["random", "alignment_gain", "policy"])
def test_a_feed_shows_what_the_environment_would(strategy: str) -> None:
    """Against the environment itself, on the same offers and with the same answers."""
    pool, omega = gridworld_pool(300), torch.tensor([0.5, -0.5, 0.5, 0.5])
    pool = pool.map_features(Normalizer.fit(pool.features))
    session = Session(pool, MODEL, strategy, budget=6, setup="feed", offers=25, seed=3)
    env = FeedEnv(
        pool, SimulatedHuman(MODEL), Belief(MODEL), 6, 25, skip="free", batch_size=(1,), seed=3
    )
    if strategy == "policy":
        module = pretrained_policy(env).strategy
    else:
        module = FEED_STRATEGIES[strategy](env)
    keys = torch.rand(1, 300, generator=Generator().manual_seed(3))
    stream = keys.argsort(-1)[:, :25]  # so that nothing streams by twice
    luck = Generator().manual_seed(3)
    state = begin(Belief(MODEL).prior(1, 4, luck), 6, 2)
    place, n_told = 0, 0
    while n_told < 6:
        state["n_offered"] = torch.tensor([[place]])
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            asks = int(module(env.show(state, {"offers": stream}))["action"])
        index = stream[:, place]
        place += 1
        if asks:
            assert int(session.ask().query) == int(index)
            answer = (pool.features[index] @ omega).argmax(-1)
            session.tell(int(answer))
            luck = Generator().manual_seed(3 * 1_000_003 + n_told)
            state = tell(Belief(MODEL), state, pool.features[index], answer, index, luck)
            n_told += 1
            assert torch.equal(session.samples, state["samples"][0])
    if strategy == "random":
        assert place == 6
    again = Session.from_dict(session.to_dict(), pool, MODEL, strategy)
    assert again.to_dict() == session.to_dict()


def test_a_question_of_a_feed_that_is_only_looked_at_does_not_go_by() -> None:
    pool = torch.rand(300, 2, 4, generator=Generator().manual_seed(0))
    session = Session(pool, MODEL, "alignment_gain", budget=6, setup="feed", seed=3)
    for _ in range(3):
        session.ask()
        session.tell(0)
    looked = session.branch()
    looked.ask()
    restored = Session.from_dict(looked.to_dict(), pool, MODEL, "alignment_gain")
    assert restored.n_offered == looked.n_offered > session.n_offered
    for one in (session, looked, restored):
        one.undo(1)
        one.ask()
        one.tell(1)
        one.ask()
    assert session.to_dict() == looked.to_dict() == restored.to_dict()


def test_what_counts_the_offers_sees_one_after_the_other() -> None:
    class EveryThird(TensorDictModuleBase):
        in_keys, out_keys, seen = ["offer"], ["action"], 0

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            self.seen += 1
            return tensordict.set("action", torch.tensor([int(self.seen % 3 == 0)]))

    session = Session(gridworld_pool(50), MODEL, lambda env: EveryThird(), setup="feed", seed=3)
    for answered in range(4):
        session.ask()
        assert session.n_offered == 3 * (answered + 1)
        session.tell(0)


def test_a_feed_ends_with_its_offers() -> None:
    class Never(TensorDictModuleBase):
        in_keys, out_keys = ["offer"], ["action"]
        decisions = 0

        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            Never.decisions += 1
            return tensordict.set("action", torch.zeros(1, dtype=torch.long))

    pool = gridworld_pool(50)
    session = Session(pool, MODEL, lambda env: Never(), budget=3, setup="feed", offers=7)
    for _ in range(3):  # nobody decides about the same offers again
        with pytest.raises(NothingToAsk, match="offers=7: all went by"):
            session.ask()
        session = session.branch()
    assert Never.decisions == 7


def test_an_earlier_answer_is_taken_back_and_the_others_stay(generator: Generator) -> None:
    """As though its question had been put off to the end."""
    pool = QueryPool(torch.randn(60, 2, 3, generator=generator))
    session = Session(pool, MODEL, budget=6, seed=2)
    asked = converse(session, torch.ones(3), 5)
    answers = [turn[0] for turn in session.to_dict()["answers"]]
    session.undo(1)
    assert session.n_answered == 4
    assert int(session.ask().query) == asked[1]
    session.tell(1 - answers[1])
    content = session.to_dict()
    assert [query[0] for query in content["queries"]] == [asked[0], *asked[2:], asked[1]]
    again = Session(pool, MODEL, budget=6, seed=2)
    again = Session.from_dict({**again.to_dict(), **content}, pool, MODEL)
    assert torch.equal(again.samples, session.samples)
    for bad in (5, -6, 1.0, True, "0"):
        with pytest.raises(InputError, match="nothing to undo"):
            session.undo(bad)  # type: ignore[arg-type]


def test_a_branch_goes_its_own_way(generator: Generator) -> None:
    pool = QueryPool(torch.randn(60, 2, 3, generator=generator))
    session = Session(pool, MODEL, budget=6, seed=2)
    converse(session, torch.ones(3), 2)
    session.ask()
    before, samples = session.to_dict(), session.samples.clone()
    branches = [session.branch() for _ in range(2)]
    for answer, branch in enumerate(branches):
        branch.tell(answer)
        branch.ask()
    assert session.to_dict() == before
    assert torch.equal(session.samples, samples)
    session.tell(1)
    session.ask()
    assert session.to_dict() == branches[1].to_dict() != branches[0].to_dict()


def test_what_is_known_is_told_as_counted_by_hand(generator: Generator) -> None:
    features = torch.randn(60, 2, 3, generator=generator)
    session = Session(features, Boltzmann(2.0), budget=6, seed=2)
    converse(session, torch.ones(3), 3)
    session.ask()
    session.tell(None)
    samples = session.samples.double()
    content = session.to_dict()
    fits = []
    for (query,), (answer,) in zip(content["queries"], content["answers"], strict=True):
        gap = 2.0 * samples @ (features[query, 0] - features[query, 1]).double()
        sign = 1 if answer == 0 else -1
        fits.append(1.0 if answer < 0 else float((1 / (1 + (-sign * gap).exp())).mean()))
    assert session.likelihoods.tolist() == pytest.approx(fits, abs=1e-5)
    alignment = session.expected_alignment
    assert len(alignment) == 5
    cosines = samples @ samples.mT
    others = float((cosines.sum() - cosines.trace()) / (len(samples) * (len(samples) - 1)))
    length = float(samples.mean(0).norm())
    assert float(alignment[-1]) == pytest.approx(others / length, abs=1e-5)
    assert 0 <= float(alignment[0]) < 0.1  # nothing was known
    assert alignment[-1] == alignment[-2]  # nothing was said
    options = session.ask().features.double()
    first = 1 / (1 + (-2.0 * samples @ (options[0] - options[1])).exp())
    expected = 0.0
    for probability in (first, 1 - first):
        mean = (probability[:, None] * samples).mean(0) / probability.mean()
        expected += float(probability.mean() * mean.square().sum())
    before, after = (
        (square - (1 - square) / (len(samples) - 1)) / square**0.5
        for square in (length**2, expected)
    )
    assert float(session.expected_gain) == pytest.approx(after - before, abs=1e-5)
