"""A person in the terminal: what they type, what it does, and that the log holds it."""

from __future__ import annotations

import io
import os
import pty
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from select import select
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image
from scripts import TIMEOUT, start_in_terminal
from study_helpers import SMALL, answer_all, careful, materials_of, study_of, write_table

from torchrl_pref.errors import InputError
from torchrl_pref.study.log import Log, LogError
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.shown import ATTENTION
from torchrl_pref.study.state import possible_answers
from torchrl_pref.study.study import Study
from torchrl_pref.study.terminal import conversation, converse, player
from torchrl_pref.study.terminal.files import QuestionFiles
from torchrl_pref.study.terminal.lines import COMMANDS, Typed, hint, keys_of, understood
from torchrl_pref.study.terminal.options import Room
from torchrl_pref.tasks import drawing
from torchrl_pref.tasks.drawing import save_animation
from torchrl_pref.tasks.scene import Disc, Scene

OMEGA = torch.tensor([0.5, -0.5, 0.5, 0.5])

ALL = [one.key for one in COMMANDS]


class Typing:
    """Somebody at the terminal, who has lines to type; then the input ends."""

    def __init__(self, lines: Iterable[str | BaseException]) -> None:
        self.lines: Iterator[str | BaseException] = iter(lines)
        self.prompts: list[str] = []

    def __call__(self, prompt: str = "") -> str:
        self.prompts.append(prompt)
        line = next(self.lines, EOFError())
        if isinstance(line, BaseException):
            raise line
        return line


Types = Callable[..., Typing]


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> Types:
    """What sets the lines that are typed. Nothing sleeps meanwhile, and animations are empty."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("LINES", "50")
    monkeypatch.setattr(Study, "think_ahead", lambda study: None)
    monkeypatch.setattr(drawing, "save_animation", lambda scene, path: path.touch())

    def given(*lines: str | BaseException, then: Iterable[str] = ()) -> Typing:
        typing = Typing(chain(lines, then))
        monkeypatch.setattr("builtins.input", typing)
        return typing

    return given


def answering(study: Study, choose: Callable[[Participant], int | None]) -> Iterator[str]:
    """Lines of somebody who answers what is open."""
    keys = {number: typed for typed, number in keys_of(possible_answers(study.materials)).items()}
    while (person := study.people["P1"]).shown is not None:
        said = choose(person)
        yield "?" if said is None else keys[said]


def events_of(study: Study) -> list[tuple[str, str, dict[str, Any]]]:
    """The log, but for the clock's part."""
    return [
        (one.participant, one.kind, {k: v for k, v in one.content.items() if k != "seconds"})
        for one in study.log.events()
    ]


STUDIES = {
    "gridworld": [],
    "driver": ["task=driver"],
    "feed": ["setup=feed"],
    "checks": ["study.attention=1", "study.repeats=1"],
    "weak": ["question=weak"],
    "ranking": ["question=ranking", "pool.options=3"],
    "best_worst": ["question=best_worst", "pool.options=3"],
    "approve": ["question=approve", "pool.options=1"],
    "features": ["task=files", "task.path={tmp}/runs.csv", "task.columns=[speed,comfort,energy]"],
    "images": ["task=files", "task.path={tmp}/runs.csv", "task.images=picture"],
}


@pytest.mark.parametrize("name", STUDIES)
def test_a_whole_study_by_keys_is_the_one_of_the_participant(
    name: str, tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    write_table(tmp_path)
    typed = [one.format(tmp=tmp_path) for one in STUDIES[name]]
    studies = []
    for place in ("typed", "called"):
        (tmp_path / place).mkdir()
        studies.append(study_of(tmp_path / place, *typed, "setup.budget=4"))
    one, other = studies

    def choose(person: Participant) -> int | None:
        """Any answer, each in its turn; and now and then none."""
        assert person.shown is not None
        if person.shown.wanted is not None:
            return person.shown.wanted
        turn = len(person.said)
        return None if turn == 2 else (3 * turn + 1) % len(person.session.answers)

    types(then=answering(one, choose))
    converse(one, "P1")
    person = other.join("P1")
    assert person is not None
    person.go_to_next()
    while person.shown is not None:
        person.answer(person.shown.key, choose(person), 0.0, 0)
    assert person.ended == one.people["P1"].ended == "budget"
    assert events_of(one) == events_of(other)
    assert torch.equal(one.people["P1"].session.samples, person.session.samples)
    out = capsys.readouterr().out
    assert out.count("── Question ") == len(person.said)
    assert "That was the last question" in out
    assert one.materials.question.prompt in out
    for study in studies:
        study.close()


@pytest.mark.parametrize("kind", ["choice", "weak", "ranking", "best_worst"])
def test_letters_mean_what_is_seen(kind: str, tmp_path: Path, types: Types) -> None:
    """Whatever the order is in which the options are shown."""
    n_options = 2 if kind in ("choice", "weak") else 3
    study = study_of(tmp_path, f"question={kind}", f"pool.options={n_options}")

    def lines() -> Iterator[str]:
        while (person := study.people["P1"]).shown is not None:
            options = person.session.pool.features[person.shown.query][list(person.shown.order)]
            best_first = ["abc"[place] for place in (options @ OMEGA).argsort(descending=True)]
            in_order = best_first if kind == "ranking" else [best_first[0], best_first[-1]]
            yield {"ranking": " > ".join, "best_worst": ", ".join}.get(
                kind, lambda letters: letters[0].upper()
            )(in_order)

    types(then=lines())
    converse(study, "P1")
    person = study.people["P1"]
    assert person.ended == "budget"
    for one in person.said:
        returns = person.session.pool.features[one.shown.query] @ OMEGA
        told = study.materials.question.places(n_options)
        assert told is not None
        assert one.answer is not None
        assert told[one.answer][0] == int(returns.argmax())
        if n_options == 3:
            assert told[one.answer][-1] == int(returns.argmin())
    study.close()


def test_yes_and_no_and_about_equal(tmp_path: Path, types: Types) -> None:
    for name, lines, meant in (
        ("approve", ["y", "N", "n"], ["yes", "no", "no"]),
        ("weak", ["=", "B", " a "], ["about equal", "the second", "the first"]),
    ):
        (tmp_path / name).mkdir()
        options = 1 if name == "approve" else 2
        study = study_of(tmp_path / name, f"question={name}", f"pool.options={options}")
        types(*lines)
        converse(study, "P1")
        labels = study.materials.question.answers(options).labels
        assert [labels[one.said] for one in study.people["P1"].said] == meant  # type: ignore[index]
        study.close()


def test_any_answer_is_taken_back(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path)
    typing = types(
        "u", "a", "b", "a", "u 2", "a", "u", "9", "u", "x", "u 4", "u", "", "b", "u", "1"
    )
    converse(study, "P1")
    out = capsys.readouterr().out
    person = study.people["P1"]
    # The second was answered anew, and so was the last; then the first was taken back.
    assert [one.said for one in person.said] == [0, 1]
    assert person.shown is not None
    assert person.shown.again
    kinds = [event.kind for event in study.log.events()]
    assert kinds.count("undo") == 3
    answered = [event.content["key"] for event in study.log.events() if event.kind == "answer"]
    undone = [event.content["key"] for event in study.log.events() if event.kind == "undo"]
    assert undone == [answered[1], answered[3], answered[0]]
    assert kinds.count("answer") == 5
    assert "There is no answer yet." in out
    assert out.count("No answer was taken back: expected a number from 1 to 3.") == 3
    assert out.count("You took back your answer to this one") == 3
    assert re.search(r" {3}1 {2}A {3}\d", out)
    assert sum(prompt.startswith("Which one?") for prompt in typing.prompts) == 4
    study.close()


def test_at_the_end_answers_can_still_be_changed(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path, "setup.budget=2")
    types("a", "a", "a", "r", "?", "h", "w", "u 1", "b", "")
    converse(study, "P1")
    person = study.people["P1"]
    assert sorted(one.said for one in person.said) == [0, 1]  # type: ignore[type-var]
    assert person.ended == "budget"
    out = capsys.readouterr().out
    assert out.count("That was the last question. Thank you!") == 2
    for line in ("a", "r", "?"):
        assert f"{line} is none of these: u undo" in out
    assert "stop" not in [event.kind for event in study.log.events()]
    study.close()


@pytest.mark.parametrize("end", [EOFError(), KeyboardInterrupt()])
def test_the_end_of_the_input_loses_nothing(
    end: BaseException, tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path)
    types("a", "b", end)
    converse(study, "P1")
    study.close()
    again = study_of(tmp_path)
    types("a", "u", end)
    converse(again, "P1")
    assert [one.said for one in again.people["P1"].said] == [0, 1, 0]
    assert again.people["P1"].ended is None
    capsys.readouterr()
    types(end)
    converse(again, "P1")
    assert "Question 4 of at most 6" in capsys.readouterr().out
    again.close()


def test_what_ends_the_program_ends_it(tmp_path: Path, types: Types) -> None:
    class Terminated(KeyboardInterrupt):
        pass

    study = study_of(tmp_path)
    types("a", Terminated())
    with pytest.raises(Terminated):
        converse(study, "P1")
    study.close()


def test_who_stops_goes_on_with_the_same_question(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path)
    types("a", "q")
    converse(study, "P1")
    person = study.people["P1"]
    assert person.ended == "stopped"
    before = events_of(study)[-2][2]
    study.close()
    again = study_of(tmp_path)
    typing = types("quit")
    converse(again, "P1")
    shown = events_of(again)[-2][2]
    kinds = [kind for _, kind, _ in events_of(again)]
    assert kinds[-6:] == ["answer", "shown", "stop", "go_on", "shown", "stop"]
    assert (shown["query"], shown["order"]) == (before["query"], before["order"])
    assert "at most 6 questions" not in capsys.readouterr().out.split("Question 2")[-1]
    assert len(typing.prompts) == 1
    again.close()


def test_unknown_lines_change_nothing_and_say_what_can_be_typed(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path)
    lines = (
        "c",
        "ab",
        "1",
        "a b",
        "yes",
        "u -1",
        "r 2",
        "; drop table event",
        "\x1b[2J",
        "é" * 500,
    )
    types(*lines)
    converse(study, "P1")
    out = capsys.readouterr().out
    can_be = "a, b · r replay · ? cannot say · u undo · w learned so far · h help · q stop"
    assert out.count("is none of these:") == len(lines)
    assert " ".join(out.split()).count(f"is none of these: {can_be}") == len(lines)
    assert "\x1b" not in out
    assert len(study.people["P1"].said) == 0
    assert [kind for _, kind, _ in events_of(study)] == ["study", "joined", "shown"]
    study.close()


def test_enter_shows_the_question_again(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path)
    types("", "  ")
    converse(study, "P1")
    first, second, third = capsys.readouterr().out.split("── Question 1")[1:]
    assert first.strip() == second.strip() == third.strip()
    assert study.people["P1"].n_shown == 1
    study.close()


def test_time_and_replays_are_the_open_questions(
    tmp_path: Path, types: Types, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=100.0)

    def later(seconds: float, line: str) -> str:
        clock.now += seconds
        return line

    def lines() -> Iterator[str]:
        yield later(2.0, "r")
        yield later(1.0, "x")
        yield later(1.0, "")
        yield later(3.0, "replay")
        yield later(0.5, "a")
        yield later(4.0, "s")
        yield later(5.0, "u 1")
        yield later(6.0, "b")

    monkeypatch.setattr(conversation, "time", SimpleNamespace(monotonic=lambda: clock.now))
    study = study_of(tmp_path)
    types(then=lines())
    converse(study, "P1")
    said = [(one.said, one.seconds, one.replays) for one in study.people["P1"].said]
    assert said == [(None, 4.0, 0), (1, 6.0, 0)]
    first = next(event for event in study.log.events() if event.kind == "answer").content
    assert (first["said"], first["seconds"], first["replays"]) == (0, 7.5, 2)
    study.close()


def test_what_cannot_be_saved_is_asked_again(
    tmp_path: Path,
    types: Types,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study, full = study_of(tmp_path), []
    append = Log.append

    def fails(log: Log, who: str, kind: str, *rest: Any) -> str | None:
        if kind in full:
            full.remove(kind)
            raise LogError("This could not be saved (disk full).")
        return append(log, who, kind, *rest)

    monkeypatch.setattr(Log, "append", fails)

    def lines() -> Iterator[str]:
        yield ""  # joined could not be written
        yield ""  # nor the first question
        full.append("answer")
        yield "a"
        yield "a"
        full.append("shown")  # after the answer, which is there
        yield "b"
        full.append("undo")
        yield "u 1"
        yield "u 1"
        full.append("stop")
        yield "q"

    full += ["joined", "shown"]
    types(then=lines())
    converse(study, "P1")
    assert capsys.readouterr().out.count("This could not be saved (disk full).") == 5
    assert [one.said for one in study.people["P1"].said] == [1]
    kinds = [kind for _, kind, _ in events_of(study)]
    assert kinds == [
        "study",
        "joined",
        "shown",
        "answer",
        "shown",
        "answer",
        "shown",
        "undo",
        "shown",
    ]
    study.close()


def test_only_who_is_expected_is_asked(tmp_path: Path, types: Types) -> None:
    study = study_of(tmp_path, "study.participants=[P1,P2]")
    typing = types("a")
    with pytest.raises(InputError, match=r"participant=P3: expected one of P1, P2"):
        converse(study, "P3")
    study.close()
    (tmp_path / "open").mkdir()
    study = study_of(tmp_path / "open")
    with pytest.raises(InputError, match="participant=a b: expected a code"):
        converse(study, "a b")
    assert not study.people
    assert not typing.prompts
    study.close()
    with pytest.raises(InputError, match="participant=P3: expected one of P1, P2"):
        materials_of("ui=terminal", "participant=P3", "study.participants=[P1,P2]")


def test_people_read_first_and_agree(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "read.md"
    text.write_text("# Robots\n\nLook at *both*.\n\n- one\n- two\n")
    typed = (f"study.instructions={text}", "study.consent=true", "study.title=Arms")
    study = study_of(tmp_path, *typed)
    types("what?", "N")
    converse(study, "P1")
    assert not study.people
    assert [event.kind for event in study.log.events()] == ["study"]
    out = capsys.readouterr().out
    assert "Arms" in out
    assert "ROBOTS\n\nLook at both.\n\n- one\n- two\n" in out
    assert "there are at most 6" in out
    assert "── Question" not in out
    types("Yes", "a")
    converse(study, "P1")
    assert "── Question 2" in capsys.readouterr().out
    typing = types("h")
    converse(study, "P1")  # who was there has read it, and can read it again
    before, after = capsys.readouterr().out.split("── Question 2")
    assert "ROBOTS" not in before
    assert "ROBOTS" in after
    assert typing.prompts == ["> ", "> "]
    study.close()


def test_checks_say_what_they_are(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path, "study.attention=1", "setup.budget=4")

    def choose(person: Participant) -> int | None:
        assert person.shown is not None
        return person.shown.wanted or 0

    types(then=answering(study, choose))
    converse(study, "P1")
    said = study.people["P1"].said
    assert [one.passed for one in said if one.shown.purpose == ATTENTION] == [True]
    assert "This one checks that you are reading" in capsys.readouterr().out
    study.close()


def test_what_has_been_learned_is_told(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path, "setup.budget=15", "strategy=random")
    person, choose, slips = study.join("P1"), careful(OMEGA), []
    assert person is not None

    def slip_once(person: Participant) -> int:
        assert person.shown is not None
        features = person.session.pool.features[person.shown.query] @ OMEGA
        if len(person.said) > 10 and not slips and (features[0] - features[1]).abs() > 1.5:
            slips.append(len(person.said) + 1)
            return 1 - choose(person)
        return choose(person)

    answer_all(person, slip_once)
    types("u", "w")
    converse(study, "P1")
    out = capsys.readouterr().out
    for name, mean in zip(person.session.weights.names, person.session.weights.mean, strict=True):
        shown = re.escape(f"{mean:+.2f}")
        assert re.search(rf"  {name} +{shown} +[+-]\d.\d\d … [+-]\d.\d\d .*●", out)
    assert "Learned from 15 answers. How well you are known: " in out
    assert "Your care is put at" in out
    assert f"Answer {slips[0]} fits badly with the others" in out
    assert f"u {slips[0]} takes it back" in out.replace("\n", " ")
    assert "The best of the pool is now thought to be option" in out
    assert re.search(rf"{slips[0]}  [AB]   1.5 s   fits badly with the others", out)
    study.close()


@pytest.mark.parametrize("worth", [0.0, 1.0])
def test_that_asking_on_is_hardly_worth_it_is_said_once(
    worth: float, tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    study = study_of(tmp_path, f"study.worth={worth}")
    types("a", "a", "w", "a")
    converse(study, "P1")
    out = " ".join(capsys.readouterr().out.split())
    assert out.count("expected to teach next to nothing: you can stop here by q") == worth
    assert "Your next answer is expected to add" in out
    study.close()


def test_the_question_is_there_as_pictures(
    tmp_path: Path,
    types: Types,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(drawing, "save_animation", save_animation)
    study = study_of(tmp_path)
    types("a")
    converse(study, "P1")
    assert f"as pictures: {tmp_path / 'question'}: A.gif, B.gif" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "question").iterdir()) == ["A.gif", "B.gif"]
    with Image.open(tmp_path / "question" / "A.gif") as image:
        assert image.n_frames > 1  # type: ignore[attr-defined]
    study.close()
    for folder in ("features", "images"):
        (tmp_path / folder).mkdir()
        write_table(tmp_path)
        typed = [one.format(tmp=tmp_path) for one in STUDIES[folder]]
        study = study_of(tmp_path / folder, *typed)
        types("r", "a")
        converse(study, "P1")
        out = capsys.readouterr().out
        assert "as pictures" not in out
        assert "r is none of these: a, b · ? cannot say" in out
        assert ("speed: " in out) == (folder == "features")
        assert (".png" in out) == (folder == "images")
        assert not (tmp_path / folder / "question").exists()
        study.close()


def test_each_letter_is_the_option_that_is_answered(
    tmp_path: Path, types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    write_table(tmp_path)
    study = study_of(tmp_path, *(one.format(tmp=tmp_path) for one in STUDIES["images"]))
    orders = set()

    def lines() -> Iterator[str]:
        while (person := study.people["P1"]).shown is not None:
            orders.add(person.shown.order)
            out, raw = capsys.readouterr().out, study.materials.raw.trajectories
            assert raw is not None
            files = re.findall(r"  ([AB])  .*/(\d+)\.png", out)
            options = [int(raw[person.shown.query, option]) for option in person.shown.order]
            assert files == list(zip("AB", map(str, options), strict=True))
            yield "b"

    types(then=lines())
    converse(study, "P1")
    assert len(orders) == 2
    for one in study.people["P1"].said:
        assert one.answer == one.shown.order[1]
    study.close()


def test_files_are_of_the_open_question_alone(tmp_path: Path) -> None:
    def scene(colour: str, n_frames: int) -> Scene:
        frames = tuple((Disc((5.0 + step, 5.0), 4.0, colour),) for step in range(n_frames))
        return Scene((0.0, 0.0), (10.0, 10.0), (), frames)

    files = QuestionFiles(tmp_path / "question")
    for _ in range(3):
        paths = files.show([scene("#ff0000", 3), scene("#00ff00", 1)])
    assert [path.name for path in paths] == ["A.gif", "B.png"]
    assert files._work is not None
    files._work.result()
    assert [path.exists() for path in paths] == [True, True]
    files.show([scene("#0000ff", 1)])
    files.close()
    assert [path.name for path in (tmp_path / "question").iterdir()] == ["A.png"]
    with Image.open(tmp_path / "question" / "A.png") as image:
        assert image.convert("RGB").getpixel((image.width // 2, image.height // 2)) == (0, 0, 255)
    (tmp_path / "file").touch()
    broken = QuestionFiles(tmp_path / "file")
    broken.show([scene("#0000ff", 1)])
    broken.close()
    assert broken.problem is not None
    assert "file" in broken.problem


def test_a_replay_is_drawn_over_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = tuple((Disc((1.0 + step, 5.0), 0.5),) for step in range(5))
    scenes = [Scene((0.0, 0.0), (10.0, 10.0), (), frames)] * 2
    slept: list[float] = []
    monkeypatch.setattr(player.time, "sleep", slept.append)
    player.play(scenes, Room(80, 50, 0), "AB")
    printed = capsys.readouterr().out
    assert re.findall(r"moment (\d) of 5", printed) == ["1", "2", "4", "5"]
    assert "\x1b" not in printed
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    player.play(scenes, Room(80, 50, 0), "AB")
    rows = capsys.readouterr().out
    high = rows.split("\x1b")[0].count("\n")
    assert rows.count(f"\x1b[{high}A") == rows.count("\x1b") == 4
    assert len(slept) == 5
    player.play(scenes, Room(30, 24, 0), "AB")  # one after the other
    rows = capsys.readouterr().out
    assert rows.count("─ A ─") == rows.count("─ B ─") == 5
    assert rows.index("─ B ─") > rows.rindex("─ A ─")
    player.play(scenes, Room(30, 5, 0), "AB")  # nothing fits
    assert "\x1b" not in capsys.readouterr().out


def test_letters_of_options_come_before_those_of_commands() -> None:
    answers = possible_answers(materials_of("pool.options=24"))
    keys = keys_of(answers)
    for letter in "hqruw":
        assert understood(letter, keys, ALL) == Typed("answer", ord(letter) - ord("a"))
    for one in COMMANDS:
        assert understood(one.word, keys, ALL) == (
            Typed("answer", 18) if one.word == "s" else Typed(one.key)
        )
    assert understood("?", keys, ALL) == Typed("?")
    assert "help help" in hint(answers, ALL).replace("\N{NO-BREAK SPACE}", " ")
    assert understood("undo 12", keys, ALL) == Typed("u", 12)
    assert understood("u12", {}, ALL) == Typed("u", 12)
    assert understood("replay", keys, ["u"]) is None


def test_answers_without_letters_are_numbers() -> None:
    answers = [
        {"answer": n, "label": f"{n} stars", "key": str(n + 1) if n < 9 else None, "places": None}
        for n in range(11)
    ]
    keys = keys_of(answers)
    assert understood("3", keys, ALL) == Typed("answer", 2)
    assert understood("11", keys, ALL) == Typed("answer", 10)
    assert understood("12", keys, ALL) is None
    can_be = hint(answers, ()).replace("\N{NO-BREAK SPACE}", " ")
    assert can_be.startswith("1 0 stars · 2 1 stars · ")
    assert can_be.endswith(" · 11 10 stars")


def test_a_ranking_is_known_before_its_last_letter() -> None:
    answers = possible_answers(materials_of("question=ranking", "pool.options=3"))
    keys = keys_of(answers)
    for line, label in {"b a": "B > A > C", "CBA": "C > B > A", "a>c>b": "A > C > B"}.items():
        typed = understood(line, keys, ALL)
        assert typed is not None
        assert answers[typed.number or 0]["label"] == label
    for line in ("b", "", ",", "b b", "b a a", "bacc"):
        assert understood(line, keys, ALL) is None


@pytest.fixture
def run_in_terminal(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """What runs ask.py in a terminal of its own, and talks to it."""
    talks = []

    def run(*arguments: str) -> Talk:
        talks.append(Talk(tmp_path, *arguments))
        return talks[-1]

    yield run
    for one in talks:
        one.end()


class Talk:
    """``python ask.py ui=terminal`` in a terminal of its own."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._own, its = pty.openpty()
        self.process = start_in_terminal(
            "ask.py",
            "ui=terminal",
            *arguments,
            folder=folder,
            terminal=os.ttyname(its),
            **{"TERM": "xterm", "COLUMNS": "100", "LINES": "50"},
        )
        self._its: int | None = its  # until the program has it open as well
        self._left = b""  # printed, and not looked at yet

    def until(self, text: str) -> str:
        """What is printed until a text is."""
        while text.encode() not in self._left:
            assert select([self._own], [], [], TIMEOUT)[0], self._left.decode(errors="replace")
            self._left += os.read(self._own, 65536)  # fails where the program has ended
            self._let_go()
        before, found, self._left = self._left.partition(text.encode())
        return (before + found).decode(errors="replace")

    def type(self, text: str) -> None:
        """Type something."""
        os.write(self._own, text.encode())

    def signal(self, number: int) -> None:
        """Send a signal, and type Enter: one that comes just before the program waits for a line is
        noticed after the line."""
        assert self.process.pid is not None
        os.kill(self.process.pid, number)
        self.type("\n")

    def end(self) -> None:
        """Kill it, where it has not ended."""
        self.process.kill()
        self.process.join()
        self._let_go()
        os.close(self._own)

    def _let_go(self) -> None:
        if self._its is not None:
            os.close(self._its)
            self._its = None

    def status(self) -> int | None:
        """With which it ends."""
        self.process.join(TIMEOUT)
        return self.process.exitcode


def test_the_script_in_a_terminal(tmp_path: Path, run_in_terminal: Callable[..., Talk]) -> None:
    folder = tmp_path / "study"
    talk = run_in_terminal(*SMALL, f"hydra.run.dir={folder}")
    assert "\x1b[38;5;" in talk.until("> ")
    talk.type("a\n")
    talk.until("Question 2")
    talk.until("> ")
    talk.type("r\n")
    assert talk.until("A┌").count("\n") > 10  # upward, and over it
    talk.signal(signal.SIGINT)  # in the middle of it
    last = talk.until("export: ")
    assert "1 answer of 1 person" in last
    assert "Traceback" not in last
    assert talk.status() == 0
    again = run_in_terminal(f"resume={folder}")
    assert "Question 2 of at most 6" in again.until("h help")
    again.type("b\n")
    again.until("Question 3")
    again.until("> ")
    again.signal(signal.SIGTERM)
    assert "2 answers of 1 person" in again.until("stopped")
    assert again.status() == 128 + signal.SIGTERM


def test_a_terminal_without_letters_to_draw_with_is_refused(
    tmp_path: Path, types: Types, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = study_of(tmp_path)
    types("a")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "latin-1"))
    with pytest.raises(InputError, match="ui=terminal: letters are printed as latin-1 here"):
        converse(study, "P1")
    study.close()
