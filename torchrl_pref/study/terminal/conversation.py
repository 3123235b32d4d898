"""A conversation with one person in the terminal: a question, a line, and what follows from it.

Shapes: K options of a question.
"""

from __future__ import annotations

import re
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from string import ascii_uppercase
from typing import Any, TypeVar

from torchrl_pref.study.log import LogError
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.state import best_of_pool, label_of
from torchrl_pref.study.study import Study
from torchrl_pref.study.terminal.files import QuestionFiles
from torchrl_pref.study.terminal.learned import learned_as_text
from torchrl_pref.study.terminal.lines import BESIDE, COMMANDS, TOGETHER, hint, keys_of, understood
from torchrl_pref.study.terminal.options import (
    at_one_scale,
    marks_of,
    options_as_text,
    printable,
    room_of,
)
from torchrl_pref.study.terminal.player import play
from torchrl_pref.tasks.scene import Scene

Done = TypeVar("Done")

WIDEST = 88
"""Letters of a line that reads well."""

ENDS = {
    "budget": "That was the last question. Thank you!",
    "no_more": "There is nothing more to ask. Thank you!",
}


def say(text: str, before: str = "") -> None:
    """Print a text, in lines that read well."""
    columns = min(WIDEST, room_of(sys.stdout).columns)
    after = " " * len(before)
    wrapped = textwrap.wrap(
        printable(text),
        columns,
        initial_indent=before,
        subsequent_indent=after,
        break_long_words=False,
        break_on_hyphens=False,
    )
    print("\n".join(wrapped).replace(TOGETHER, " "))


def rule(title: str) -> None:
    """Print where something new begins."""
    print(f"\n{f'── {title} ':─<{min(WIDEST, room_of(sys.stdout).columns)}}")


def instruct(study: Study) -> None:
    """Print what people read before the first question."""
    for block in study.instructions:
        if block["kind"] == "list":
            for item in block["items"]:
                say(item, "- ")
        else:
            say(block["text"].upper() if block["kind"] == "heading" else block["text"])
        print()


def surely(study: Study, action: Callable[[], Done]) -> Done:
    """Do something that has to be written down first, however often that has to be tried."""
    while True:
        try:
            with study.turn():
                return action()
        except LogError as error:
            say(str(error))
            input("Enter tries again, Ctrl-C ends. ")


class Conversation:
    """Questions to one person, and what they say.

    Args:
        study: what is asked.
        person: who answers.
        files: where the open question is drawn as well.
    """

    def __init__(self, study: Study, person: Participant, files: QuestionFiles) -> None:
        self._study, self._person, self._files = study, person, files
        self._scenes: list[Scene] = []
        self._paths: list[Path] = []
        self._key: str | None = None  # of the open question, which is there
        self._since, self._replays = 0.0, 0  # that time, and was watched again so often
        self._told_hardly = False

    def hold(self) -> None:
        """Ask until there is no question left, or the person stops."""
        more = True
        while more:
            state = surely(self._study, lambda: self._study.state(self._person))
            if state["question"] is None:
                self._end(state)
            else:
                self._ask(state)
            self._study.think_of(self._person)
            more = self._listen(state)

    def _ask(self, state: dict[str, Any]) -> None:
        """Show the open question."""
        question = state["question"]
        is_new = question["key"] != self._key
        if is_new:
            shown, scene = self._person.shown, self._study.materials.scene
            assert shown is not None
            self._scenes = at_one_scale([scene(shown.query, option) for option in shown.order])
            self._paths = self._files.show(self._scenes)
        rule(f"Question {question['number']} of at most {state['budget']}")
        say(question["prompt"])
        if question["note"] is not None:
            say(question["note"])
        if question["again"]:
            say("You took back your answer to this one; please answer it again.")
        room = room_of(sys.stdout)
        print("\n".join(options_as_text(self._scenes, room, letters=self._letters)))
        self._tell_beside(state)
        say(hint(question["answers"], self._commands(state)))
        if is_new:
            self._key, self._since, self._replays = question["key"], time.monotonic(), 0

    def _tell_beside(self, state: dict[str, Any]) -> None:
        """What is worth knowing of the open question."""
        marks = marks_of(self._scenes)
        if marks is not None:
            print(marks)
        if self._paths:
            names = ", ".join(path.name for path in self._paths)
            print(f"as pictures: {printable(str(self._files.folder))}: {names}")
        if self._files.problem is not None:
            say(f"An earlier picture could not be written: {self._files.problem}")
        if not state["learned"]["worth_asking"]:
            if not self._told_hardly:
                say(
                    "Another answer is expected to teach next to nothing: you can stop here by q, "
                    "or go on."
                )
            self._told_hardly = True

    @property
    def _letters(self) -> str:
        """K, of the options of the open question; of one alone none."""
        return ascii_uppercase[: len(self._scenes)] if len(self._scenes) > 1 else ""

    def _commands(self, state: dict[str, Any]) -> tuple[str, ...]:
        """Keys of what can be done beside answering."""
        if state["question"] is None:
            return BESIDE
        moves = any(len(scene.frames) > 1 for scene in self._scenes)
        return tuple(one.key for one in COMMANDS if moves or one.key != "r")

    def _listen(self, state: dict[str, Any]) -> bool:
        """Do what the person types, until something has changed; whether to go on then."""
        answers = [] if state["question"] is None else state["question"]["answers"]
        keys, commands = keys_of(answers), self._commands(state)
        while True:
            line = input("> ")
            if not line.strip():
                return bool(answers)
            typed = understood(line, keys, commands)
            command, number = (None, None) if typed is None else typed
            if command in ("answer", "?"):
                self._answer(number)
                return True
            if command == "q":
                self._stop()
                return False
            if command == "u" and self._undo(state, number):
                return True
            if command == "r":
                self._replays += 1
                play(self._scenes, room_of(sys.stdout), self._letters)
            elif command == "w":
                self._show_learned(state)
            elif command == "h":
                self._help(answers, commands)
            elif command is None:
                say(f"{printable(line.strip())[:40]} is none of these: {hint(answers, commands)}")

    def _answer(self, said: int | None) -> None:
        """Take an answer to the open question."""
        assert self._key is not None
        seconds = time.monotonic() - self._since
        try:
            with self._study.turn():
                taken = self._person.answer(self._key, said, seconds, self._replays)
        except LogError as error:
            say(str(error))
        else:
            if taken:
                say(f"You said: {label_of(self._study.materials, said)}.")

    def _undo(self, state: dict[str, Any], number: int | None) -> bool:
        """Take an answer back; whether one was."""
        answers = state["answers"]
        if not answers:
            say("There is no answer yet.")
            return False
        if number is None:
            for one in answers:
                doubt = "   fits badly with the others" if one["doubtful"] else ""
                print(f"{one['number']:4}  {one['label']}   {one['seconds']} s{doubt}")
            typed = input("Which one? Its number, or Enter for the last: ").strip()
            number = len(answers) if not typed else 0
            if re.fullmatch("[0-9]{1,9}", typed):
                number = int(typed)
        if not 1 <= number <= len(answers):
            say(f"No answer was taken back: expected a number from 1 to {len(answers)}.")
            return False
        try:
            with self._study.turn():
                return self._person.undo(answers[number - 1]["key"])
        except LogError as error:
            say(str(error))
            return False

    def _stop(self) -> None:
        try:
            with self._study.turn():
                self._person.stop()
        except LogError as error:  # all answers are there
            say(str(error))

    def _end(self, state: dict[str, Any]) -> None:
        """What is shown once there is no question left."""
        self._key = None
        rule(f"Answers: {state['answered']}")
        say(ENDS[state["end"]["reason"]])
        self._show_learned(state)
        say(f"{hint([], BESIDE)} · Enter ends")

    def _show_learned(self, state: dict[str, Any]) -> None:
        """What has been learned so far, with the trajectory that is now thought best."""
        weights, known = learned_as_text(state)
        print("\n".join(["", *weights, ""]))
        for sentence in known:
            say(sentence)
        with self._study.turn():
            materials = self._study.materials
            scene = materials.scene(*best_of_pool(self._person.session, materials))
        say(f"The best of the pool is now thought to be {state['learned']['best_label']}:")
        room = room_of(sys.stdout)._replace(lines=0)  # no larger than it has to be
        print("\n".join(options_as_text([scene], room, letters="")))

    def _help(self, answers: list[dict[str, Any]], commands: tuple[str, ...]) -> None:
        """What can be typed, and what people read before the first question."""
        instruct(self._study)
        for typed, number in keys_of(answers).items():
            print(f"{typed:>8}  {label_of(self._study.materials, number)}")
        for one in COMMANDS:
            if one.key in commands:
                key = one.word if one.key in keys_of(answers) else one.key
                print(f"{key:>8}  {one.help}")
        if answers:
            print("   Enter  the question again")
