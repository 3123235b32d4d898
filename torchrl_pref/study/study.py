"""A study: its participants, its log, and what they have in common.

One thing happens at a time: whoever asks or answers has the study's turn. In between it thinks
ahead of what the people there may answer.
"""

from __future__ import annotations

import gc
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torchrl_pref.asking import NothingToAsk
from torchrl_pref.config.study import CODE
from torchrl_pref.errors import InputError
from torchrl_pref.study.instructions import read_instructions
from torchrl_pref.study.log import Event, Log
from torchrl_pref.study.materials import Materials
from torchrl_pref.study.participant import Participant
from torchrl_pref.study.scenes import Scenes
from torchrl_pref.study.state import best_of_pool, state_of

LOG = "study.db"
"""The log of a study, in its folder."""

MOST_PARTICIPANTS = 1000


def versions() -> dict[str, str]:
    """Of what a belief depends on, to the last bit."""
    return {name: version(name) for name in ("torchrl_pref", "torch", "numba")}


class Study:
    """A study that goes on.

    Args:
        folder: of the study; a new log is begun there where there is none.
        materials: what it asks about.

    Attributes:
        people: participants by their codes, in the order in which they came.
        scenes: of the pool, as a page draws them.
        notes: what is worth knowing of how it goes on, a sentence each.

    Raises:
        InputError: the log is of another study, or cannot be used.
    """

    def __init__(self, folder: Path, materials: Materials) -> None:
        self.folder, self.materials, self.scenes = folder, materials, Scenes(materials)
        settings = materials.settings["study"]
        named = settings["instructions"]
        self.instructions = [] if named is None else read_instructions(named)
        self.log = Log(folder / LOG)
        self.people: dict[str, Participant] = {}
        self._common: dict[str, Any] = {
            "study_seed": materials.settings["seed"],
            "pool": materials.pool.digest,
            "versions": versions(),
        }
        self._lock, self._counting, self._in_line = threading.Lock(), threading.Lock(), 0
        self._to_think: queue.SimpleQueue[Participant | None] = queue.SimpleQueue()
        self._thinker: threading.Thread | None = None
        self.notes = self._replay(self.log.events())

    def _replay(self, events: list[Event]) -> list[str]:
        """Let in what happened before; what is worth knowing of it."""
        if not events:
            self.log.append("", "study", {**self._common, "settings": self._deciding()})
            return []
        first = events[0].content
        if first.get("pool") != self._common["pool"]:
            raise InputError(
                f"{self.log.path}: people were asked about another pool; restore the pool file of "
                "the study"
            )
        for key, was in first.get("settings", {}).items():
            now = self._deciding().get(key)
            if now != was:
                raise InputError(
                    f"{self.log.path}: people were asked with {key}={was!s:.80}, and the settings "
                    f"of the study now say {now!s:.80}; restore its settings"
                )
        by_person: dict[str, list[Event]] = {}
        for event in events[1:]:
            by_person.setdefault(event.participant, []).append(event)
        for code, own in by_person.items():
            person = Participant(code, self.materials, self.log, self._common)
            person.replay(own)
            self.people[code] = person
        other = [
            f"{name} {was} then and {versions()[name]} now"
            for name, was in first.get("versions", {}).items()
            if was != versions().get(name)
        ]
        if not other:
            return []
        return [f"note: {', '.join(other)}; a belief may differ in its last digits"]

    def _deciding(self) -> dict[str, Any]:
        """The settings from which, with the pool and the answers, all follows."""
        settings = self.materials.settings
        checks = {f"study.{name}": settings["study"][name] for name in ("attention", "repeats")}
        named = ("question", "belief", "setup", "strategy", "cost", "tau", "seed")
        return {**{name: settings[name] for name in named}, **checks}

    @contextmanager
    def turn(self) -> Iterator[None]:
        """While the block lasts nobody else does anything, and nothing is thought ahead."""
        with self._counting:
            self._in_line += 1
        try:
            with self._lock:
                yield
        finally:
            with self._counting:
                self._in_line -= 1

    def may_join(self, code: str) -> bool:
        """Whether somebody may be called that: who is known, or anybody new that is expected."""
        if code in self.people:
            return True
        named = self.materials.settings["study"]["participants"]
        expected = CODE.fullmatch(code) and (named is None or code in named)
        return bool(expected) and len(self.people) < MOST_PARTICIPANTS

    def lacks_consent(self, code: str) -> bool:
        """Whether somebody has to say that they agree, before they can begin."""
        return code not in self.people and bool(self.materials.settings["study"]["consent"])

    def join(self, code: str) -> Participant | None:
        """The participant of a code, who may be new, and then has agreed where they have to; None
        where nobody may be called that.

        Raises:
            LogError: it cannot be written.
        """
        if not self.may_join(code):
            return None
        if code not in self.people:
            person = Participant(code, self.materials, self.log, self._common)
            content = {**self._common, "consented": self.lacks_consent(code)}
            self.log.append(code, "joined", content, f"{code} joined")
            self.people[code] = person
        return self.people[code]

    def state(self, person: Participant) -> dict[str, Any]:
        """What a page shows of a participant.

        Raises:
            LogError: the next question could not be written down yet.
        """
        person.go_to_next()
        return state_of(person, self.materials, self.scenes)

    def think_of(self, person: Participant) -> None:
        """Think ahead of what a participant may answer: once they see the question, as thinking
        would slow down what is still to be sent."""
        self._to_think.put(person)

    def think_ahead(self) -> None:
        """From now on think of what follows the answers, in a thread of its own.

        What is slow once only, as compiling, is done before.
        """
        session = self.materials.session(0)
        for _ in range(min(2, session.budget)):
            with suppress(NothingToAsk):
                session.ask()
                session.tell(0)
        # What is there now stays: else it is gone through for garbage again and again, .3 s each
        # time in which nobody is answered.
        gc.collect()
        gc.freeze()
        self._thinker = threading.Thread(target=self._think, daemon=True)
        self._thinker.start()

    def _think(self) -> None:
        """Of whoever was shown something, until there is nothing more to think of."""
        while (person := self._to_think.get()) is not None:
            more = True
            while more:
                while self._in_line:  # people first
                    time.sleep(0.001)
                with self._lock:
                    more = person.foresee()
                    self._draw_ahead(person)

    def _draw_ahead(self, person: Participant) -> None:
        """Make the scenes that may be shown next."""
        for session in person.foreseen.values():
            self.scenes.of(*best_of_pool(session, self.materials))
            with suppress(NothingToAsk):
                query = int(session.ask().query)
                for option in range(self.materials.pool.n_options):
                    self.scenes.of(query, option)

    def close(self) -> None:
        """End what is thought ahead, and let the log go."""
        if self._thinker is not None:
            self._to_think.put(None)
            self._thinker.join()
        with self.turn():
            self.log.close()
