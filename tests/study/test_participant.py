"""People in a study: what they said is kept, taken back, checked, and rebuilt from the log."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from study_helpers import answer_all, careful, client_of, materials_of, study_of
from tensordict import TensorDictBase
from torch import Generator
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.per_second import Cost, PerSecond
from torchrl_pref.asking import draw_questions, make_env, strategy_of
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.envs.transition import begin
from torchrl_pref.errors import InputError
from torchrl_pref.groups import make
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions.base import reordered
from torchrl_pref.session import PRIME
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.shown import ATTENTION, QUESTION, REPEAT
from torchrl_pref.study.state import doubtful_answers, label_of, possible_answers, state_of
from torchrl_pref.study.study import Study

OMEGA = torch.tensor([0.5, -0.5, 0.5, 0.5])
KINDS = [
    ("choice", 2),
    ("choice", 4),
    ("weak", 2),
    ("ranking", 3),
    ("best_worst", 4),
    ("approve", 1),
]


def person_of(study: Study, code: str = "P1") -> Participant:
    person = study.join(code)
    assert person is not None
    person.go_to_next()
    return person


def same(one: Participant, other: Participant) -> bool:
    """Whether two are the same person, to the last bit."""
    known, too = one.session.to_dict(), other.session.to_dict()
    if one.shown is None or one.shown.purpose != QUESTION:
        for content in (known, too):  # the next question may have been thought out already
            del content["asked"], content["offered"]
    return (
        torch.equal(one.session.samples, other.session.samples)
        and one.said == other.said
        and one.shown == other.shown
        and one.ended == other.ended
        and one.n_shown == other.n_shown
        and known == too
    )


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize("foreseen", [False, True])
def test_a_whole_study_is_rebuilt_from_its_log(tmp_path: Path, setup: str, foreseen: bool) -> None:
    """After each event, whatever happens next: what a kill at that moment leaves."""
    typed = (f"setup={setup}", "study.attention=1", "study.repeats=1")
    study = study_of(tmp_path, *typed)
    person, choose = person_of(study), careful(OMEGA)
    materials = materials_of(*typed)
    for turn in range(12):
        if foreseen:
            while person.foresee():
                pass
        rebuilt = Participant("P1", materials, study.log, study._common)
        rebuilt.replay(study.log.events("P1"))
        rebuilt.go_to_next()
        assert same(rebuilt, person)
        if turn == 4:
            person.undo(person.said[1].shown.key)
        elif turn == 7:
            person.stop()
        elif person.ended == "stopped":
            person.go_on()
        elif person.shown is not None:
            said = None if turn == 2 else choose(person)
            person.answer(person.shown.key, said, 1.0, turn)
    assert person.ended == "budget"
    assert len(person.said) == 8
    study.close()


@pytest.mark.parametrize(("kind", "n_options"), KINDS)
def test_who_sees_the_options_in_another_order_is_understood(
    tmp_path: Path, kind: str, n_options: int
) -> None:
    study = study_of(tmp_path, f"question={kind}", f"pool.options={n_options}")
    person = person_of(study)
    orders = set()

    def best_first(person: Participant) -> int:
        """By the labels that are shown, and by what is seen behind them."""
        assert person.shown is not None
        orders.add(person.shown.order)
        seen = person.session.pool.features[person.shown.query][list(person.shown.order)] @ OMEGA
        places = seen.argsort(descending=True).tolist()
        wanted = {
            "choice": places[:1],
            "weak": places[:1],
            "ranking": places,
            "best_worst": [places[0], places[-1]],
            "approve": [0] if seen[0] > 0 else [],
        }[kind]
        found = [each for each in possible_answers(study.materials) if each["places"] == wanted]
        return int(found[0]["answer"])

    answer_all(person, best_first)
    if n_options > 1:
        assert len(orders) > 1
    # What the belief was told is what was meant, whatever the order was.
    for one in person.said:
        returns = person.session.pool.features[one.shown.query] @ OMEGA
        told = study.materials.question.places(n_options)
        assert told is not None
        assert one.answer is not None
        pointed = told[one.answer]
        if kind == "approve":
            assert bool(pointed) == bool(returns[0] > 0)
        else:
            assert pointed[0] == int(returns.argmax())
        if kind in ("ranking", "best_worst"):
            assert pointed[-1] == int(returns.argmin())
    assert torch.cosine_similarity(person.session.weights.mean, OMEGA, dim=0) > 0.3
    study.close()


def env_of(study: Study, setup: str, seed: int) -> tuple[QueryEnv | FeedEnv, TensorDictBase]:
    """The batched environment with a person who answers as the study thinks, about to be asked what
    the study asks a participant with this seed."""
    materials = study.materials
    section, model = materials.settings["belief"], materials.response_model
    belief = make("belief", section, model, without=("lapse",))
    budget = materials.settings["setup"]["budget"]
    env = make_env(
        materials.pool, belief, setup, 1, seed, budget=budget, repeats=False, offers=None
    )
    questions = draw_questions(env, 1, repeats=False)
    frame = env.reset()
    samples = belief.prior(1, 4, Generator().manual_seed(seed))
    for key, value in begin(samples, budget, 2).items():
        frame["session", key] = value
    frame["samples"], frame["mean"] = samples, frame["session", "mean"]
    for key, value in questions.items():
        frame[key] = value
        frame["offer"] = materials.pool.features[value[:, 0]]
    return env, frame


@pytest.mark.parametrize("setup", ["query", "feed"])
@pytest.mark.parametrize(("strategy", "lapse"), [("alignment_gain", 0), ("policy", 0.05)])
def test_the_study_is_the_environment_bit_for_bit(
    tmp_path: Path, setup: str, strategy: str, lapse: float
) -> None:
    """A Boltzmann person who answers over HTTP, and the same one in the batched environment, with
    the same luck: the same questions, the same answers, the same belief."""
    typed = f"setup={setup}", "setup.budget=12", f"belief.lapse={lapse}", f"strategy={strategy}"
    study = study_of(tmp_path, *typed)
    materials, client = study.materials, client_of(study)
    person = client.post("/api/join", json={"code": "P1"}).json()
    seed = study.people["P1"].seed
    env, frame = env_of(study, setup, seed)
    asks = strategy_of(strategy, env)
    who = {key: value.clone() for key, value in frame["human"].items()}
    for turn in range(12):
        asked, shown = study.people["P1"].session.ask(), study.people["P1"].shown
        assert shown is not None
        answer = int(env.human.respond(asked.features.unsqueeze(0), who, torch.tensor([turn])))
        meant = reordered(materials.question, shown.order)
        assert meant is not None
        body = {"code": "P1", "key": person["question"]["key"], "answer": meant.index(answer)}
        person = client.post("/api/answer", json={**body, "seconds": 1, "replays": 0}).json()
        while int(frame["session", "n_asked"]) == turn:
            with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
                frame = asks(frame)
            env.generator.manual_seed(seed * PRIME + turn)
            frame = env.step_mdp(env.step(frame))
        assert int(frame["session", "history", "index"][0, turn]) == int(asked.query)
        assert int(frame["session", "history", "answers"][0, turn]) == answer
        assert torch.equal(frame["samples"][0], study.people["P1"].session.samples)
    assert person["phase"] == "end"
    study.close()


def test_an_answer_is_taken_once(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    person = person_of(study)
    assert person.shown is not None
    key = person.shown.key
    assert person.answer(key, 1, 1.0, 0)
    assert person.answer(key, 1, 1.0, 0)  # sent again, as after a lost reply
    assert not person.answer(key, 0, 1.0, 0)
    assert not person.answer("another", 0, 1.0, 0)
    assert len(person.said) == person.session.n_answered == 1
    with pytest.raises(InputError, match="answer=2"):
        person.answer(person.shown.key, 2, 1.0, 0)
    assert sum(event.kind == "answer" for event in study.log.events()) == 1
    study.close()


def test_every_answer_can_be_changed(tmp_path: Path) -> None:
    study = study_of(tmp_path, "setup.budget=5")
    person = person_of(study)
    answer_all(person, careful(OMEGA))
    for place in (0, 2, 4):
        before = person.said[place]
        assert person.undo(before.shown.key)
        assert not person.undo(before.shown.key)
        assert person.shown is not None
        assert person.shown.again
        assert (person.shown.query, person.shown.order) == (before.shown.query, before.shown.order)
        assert person.shown.key != before.shown.key
        assert not person.answer(before.shown.key, 0, 1.0, 0)  # the old page
        assert before.said is not None
        person.answer(person.shown.key, 1 - before.said, 1.0, 0)
        assert person.ended == "budget"
        assert len(person.said) == 5
        assert before not in person.said
    study.close()


def test_checks_are_spread_and_tell_the_belief_nothing(tmp_path: Path) -> None:
    study = study_of(tmp_path, "setup.budget=10", "study.attention=2", "study.repeats=3")
    person = person_of(study)
    choose = careful(OMEGA)

    def attentive(person: Participant) -> int:
        assert person.shown is not None
        return choose(person) if person.shown.wanted is None else person.shown.wanted

    answer_all(person, attentive)
    purposes = [one.shown.purpose for one in person.said]
    assert {name: purposes.count(name) for name in (QUESTION, REPEAT, ATTENTION)} == {
        QUESTION: 10,
        REPEAT: 3,
        ATTENTION: 2,
    }
    assert len(person.said) == study.materials.n_questions == 15
    assert person.session.n_answered == 10
    assert [one.passed for one in person.said if one.shown.purpose == ATTENTION] == [True, True]
    first = {one.shown.key: one for one in person.said}
    for one in person.said:
        if one.shown.purpose == REPEAT:
            assert one.shown.of is not None
            before = first[one.shown.of]
            assert before.shown.query == one.shown.query
            assert before.shown.order == one.shown.order[::-1]
            assert before.answer == one.answer  # said of the same, in another order
            assert person.said.index(one) - person.said.index(before) > 2
    note = state_of(person, study.materials, study.scenes)
    assert note["phase"] == "end"
    study.close()


def test_two_people_do_not_see_the_same_and_do_not_disturb_each_other(tmp_path: Path) -> None:
    together, alone = tmp_path / "together", tmp_path / "alone"
    together.mkdir()
    alone.mkdir()
    study, other = study_of(together), study_of(alone)
    people = [person_of(study, code) for code in ("ann", "bob")]
    choose = careful(OMEGA)
    for _ in range(6):
        for person in people:
            assert person.shown is not None
            person.answer(person.shown.key, choose(person), 1.0, 0)
    bob = person_of(other, "bob")
    answer_all(bob, choose)
    assert torch.equal(bob.session.samples, people[1].session.samples)
    assert people[0].session.to_dict()["queries"] != people[1].session.to_dict()["queries"]
    assert study.join("ann") is people[0]
    for bad in ("", "a b", "x" * 33, "é", "../x"):
        assert study.join(bad) is None
    study.close()
    other.close()
    named = study_of(tmp_path, "study.participants=[P1,P2]")
    assert named.join("P3") is None
    assert named.join("P2") is not None
    named.close()


def test_answers_that_fit_the_others_badly_are_shown(tmp_path: Path) -> None:
    study = study_of(tmp_path, "setup.budget=15", "strategy=random")
    person = person_of(study)
    choose = careful(OMEGA)
    slips = []

    def slip_once(person: Participant) -> int:
        best = choose(person)
        features = person.session.pool.features[person.shown.query] @ OMEGA  # type: ignore[union-attr]
        if len(person.said) > 10 and not slips and (features[0] - features[1]).abs() > 1.5:
            slips.append(person.shown.key)  # type: ignore[union-attr]
            return 1 - best
        return best

    answer_all(person, slip_once)
    assert slips
    assert set(doubtful_answers(person)) == set(slips)
    state = state_of(person, study.materials, study.scenes)
    assert [one["key"] for one in state["answers"] if one["doubtful"]] == slips
    assert [one["key"] for one in state["learned"]["doubtful"]] == slips
    assert torch.cosine_similarity(person.session.weights.mean, OMEGA, dim=0) > 0.5
    study.close()


def test_labels_are_what_is_seen() -> None:
    weak = materials_of("question=weak")
    assert [label_of(weak, said) for said in (0, 1, 2, None)] == [
        "A",
        "B",
        "about equal",
        "cannot say",
    ]
    keys = {
        kind: [
            each["key"]
            for each in possible_answers(materials_of(f"question={kind}", f"pool.options={k}"))
        ]
        for kind, k in KINDS[1:]
    }
    assert keys["choice"] == ["a", "b", "c", "d"]
    assert keys["weak"] == ["a", "b", "="]
    assert keys["approve"] == ["n", "y"]
    assert set(keys["ranking"]) == {None}
    assert label_of(materials_of("question=ranking", "pool.options=3"), 1) == "A > C > B"


def test_another_pool_is_refused(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    study.close()
    with pytest.raises(InputError, match="asked about another pool"):
        study_of(tmp_path, "pool.seed=1")


def test_a_log_whose_events_do_not_follow_is_refused(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    person = person_of(study)
    study.log.append("P1", "answer", {"key": "other", "answer": 0, "said": 0})
    study.close()
    assert person.shown is not None
    with pytest.raises(InputError, match="does not follow from those before it"):
        study_of(tmp_path)


@pytest.mark.parametrize("setup", ["query", "feed"])
def test_several_answers_taken_back_in_a_row_are_all_asked_again(
    tmp_path: Path, setup: str
) -> None:
    study = study_of(tmp_path, f"setup={setup}")
    person = person_of(study)
    answer_all(person, careful(OMEGA))
    taken = [one.shown for one in person.said[1:4]]
    for shown in taken:
        person.undo(shown.key)
    assert same(person, study_of(tmp_path, f"setup={setup}").people["P1"])
    for shown in reversed(taken):
        assert person.shown is not None
        assert (person.shown.query, person.shown.order) == (shown.query, shown.order)
        assert person.shown.again
        person.answer(person.shown.key, 0, 1.0, 0)
    assert person.ended == "budget"
    assert len(person.said) == 6
    study.close()


def test_nobody_is_asked_twice_in_a_feed(tmp_path: Path) -> None:
    study = study_of(tmp_path, "setup=feed", "setup.budget=12")
    for code in ("P1", "P2", "P3", "P4"):
        person = person_of(study, code)
        answer_all(person, careful(OMEGA))
        asked = [one.shown.query for one in person.said]
        assert len(set(asked)) == len(asked)
    study.close()


def test_a_study_counts_the_seconds_that_were_typed() -> None:
    made = materials_of("strategy=information_per_second", "cost.watch=7", "cost.decide=3")
    env = QueryEnv(made.pool, SimulatedHuman(made.response_model), Belief(made.response_model))
    assert callable(made.strategy)
    acquisition = made.strategy(env).acquisition
    assert acquisition == PerSecond(information_gain, Cost(watch=7, decide=3))


@pytest.mark.parametrize(
    "typed", ["seed=7", "tau=2", "question=weak", "belief=sampled", "cost.watch=7"]
)
def test_a_study_goes_on_with_its_own_settings_alone(tmp_path: Path, typed: str) -> None:
    study = study_of(tmp_path)
    person_of(study)
    study.close()
    study_of(tmp_path, "study.title=Another").close()  # which decides nothing
    with pytest.raises(InputError, match=rf"people were asked with {re.split('[.=]', typed)[0]}="):
        study_of(tmp_path, typed)
