"""One person in a study: what they were shown and said, rebuilt from the log.

Letters: K options of a question, R possible answers.

What is said is first written to the log, and then let into the session. Both follow the same
events, so that a participant who is rebuilt is the one who was there, bit for bit.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from random import Random
from typing import Any

from torchrl_pref.asking import NothingToAsk
from torchrl_pref.errors import InputError
from torchrl_pref.questions.base import reordered
from torchrl_pref.session import Session
from torchrl_pref.study.log import Event, Log, LogError
from torchrl_pref.study.materials import Materials
from torchrl_pref.study.shown import ATTENTION, QUESTION, REPEAT, Said, Shown

CHECKS = {REPEAT: "repeats", ATTENTION: "attention"}
"""Settings that say how many there are, in the section ``study``."""

MOST_FORESEEN = 25
"""Answers that are thought about before they are given: all orders of four options, and none."""

APART = 3
"""Questions at least between one and its repetition."""


class Participant:
    """One person in a study.

    Args:
        code: by which they are known.
        materials: of the study.
        log: of the study.
        common: what every event says beside its own.

    Attributes:
        session: their session.
        said: their answers, but those that were taken back, oldest first.
        shown: the question that is open; None at the end.
        ended: why there is none: ``budget``, ``no_more`` or ``stopped``.
        n_shown: how often a question was shown.
        foreseen: by answer, the session after it, as far as it was thought out.
    """

    def __init__(self, code: str, materials: Materials, log: Log, common: dict[str, Any]) -> None:
        self.code = code
        self._materials, self._log, self._common = materials, log, common
        # Of the code and the study's seed alone, so that who comes first makes no difference.
        study_seed = materials.settings["seed"]
        self.seed = int(sha256(f"{study_seed} {code}".encode()).hexdigest()[:7], 16)
        self.session: Session = materials.session(self.seed)
        self.said: list[Said] = []
        self.shown: Shown | None = None
        self.ended: str | None = None
        self.n_shown = 0
        self.foreseen: dict[int | None, Session] = {}
        self._waiting: list[Shown] = []

    def replay(self, events: list[Event]) -> None:
        """Let in what happened before.

        Raises:
            InputError: the events are not of this study.
        """
        for event in events:
            try:
                self._let_in(event.kind, event.content, event.at)
            except (KeyError, TypeError, IndexError, StopIteration) as error:
                raise InputError(
                    f"{self._log.path}: event {event.number} does not follow from those before it "
                    f"({type(error).__name__}: {error}); restore a copy of the log"
                ) from None

    def go_to_next(self) -> None:
        """Show the next question, where none is open; or end.

        Raises:
            LogError: it cannot be written.
        """
        if self.shown is None and self.ended is None:
            shown = self._next()
            if isinstance(shown, str):
                self.ended = shown
            else:
                offered = self.session.n_offered
                self._happened("shown", {**vars(shown), "offered": offered}, f"shown {shown.key}")

    def answer(self, key: str, said: int | None, seconds: float, replays: int) -> bool:
        """Take an answer, and show what is next.

        Args:
            key: of the question that is open.
            said: in terms of places; None where the person cannot say.
            seconds: that it took.
            replays: how often something was watched again.

        Returns:
            Whether it is the answer to the open question now, or the same was said to it before.

        Raises:
            InputError: there is no such answer.
            LogError: it cannot be written; nothing has changed then.
        """
        if self.shown is None or self.shown.key != key:
            return any(one.shown.key == key and one.said == said for one in self.said)
        n_answers = len(self.session.answers)
        if said is not None and not 0 <= said < n_answers:
            raise InputError(f"answer={said}: expected a whole number from 0 to {n_answers - 1}")
        content = {
            "key": key,
            "said": said,
            "answer": self.meant(self.shown, said),
            "seconds": seconds,
            "replays": replays,
        }
        self._happened("answer", content, f"answer {key}")
        with suppress(LogError):  # the answer is there; what is next is shown once it can be
            self.go_to_next()
        return True

    def undo(self, key: str) -> bool:
        """Take an answer back; its question is shown again, and the others stay.

        Args:
            key: of the question.

        Returns:
            Whether there was such an answer.

        Raises:
            LogError: it cannot be written; nothing has changed then.
        """
        if all(one.shown.key != key for one in self.said):
            return False
        self._happened("undo", {"key": key}, f"undo {key}")
        with suppress(LogError):
            self.go_to_next()
        return True

    def stop(self) -> None:
        """End, because the person wants to; :meth:`go_on` takes it back.

        Raises:
            LogError: it cannot be written.
        """
        if self.ended is None:
            self._happened("stop", {})

    def go_on(self) -> None:
        """Ask on after :meth:`stop`.

        Raises:
            LogError: it cannot be written.
        """
        if self.ended == "stopped":
            self._happened("go_on", {})
            self.go_to_next()

    def foresee(self) -> bool:
        """Think out what follows one more of the answers that may be given to the open question,
        the most probable first.

        Returns:
            Whether there are answers left to think about.
        """
        if self.shown is None or self.shown.purpose != QUESTION:
            return False
        left = [answer for answer in self._expected() if answer not in self.foreseen]
        if left:
            branch = self.session.branch()
            branch.tell(left[0])
            with suppress(NothingToAsk):
                branch.ask()
            self.foreseen[left[0]] = branch
        return len(left) > 1

    def _expected(self) -> list[int | None]:
        """What may be said to the open question, the most probable first. That a person cannot say
        is taken to be as probable as any answer is by chance."""
        likely = self.session.answer_probabilities.tolist()
        answers = [(-each, answer) for answer, each in enumerate(likely)]
        ordered = sorted([*answers, (-1 / len(likely), None)], key=lambda one: one[0])
        return [answer for _, answer in ordered][:MOST_FORESEEN]

    def meant(self, shown: Shown, said: int | None) -> int | None:
        """The answer in terms of options of one in terms of places."""
        meant = reordered(self._materials.question, shown.order)
        return said if said is None or meant is None else meant[said]

    def _happened(self, kind: str, content: dict[str, Any], once: str | None = None) -> None:
        """Write an event down, and then let it in."""
        content = {**content, **self._common, "participant_seed": self.seed}
        at = self._log.append(self.code, kind, content, once and f"{self.code} {once}")
        if at is not None:
            self._let_in(kind, content, at)

    def _let_in(self, kind: str, content: dict[str, Any], at: str) -> None:
        """What an event changes."""
        match kind:
            case "shown":
                self._see(content)
            case "answer":
                self._hear(content, at)
            case "undo":
                self._take_back(content["key"])
            case "stop":
                self._waiting = [self.shown, *self._waiting] if self.shown else self._waiting
                self.shown, self.ended = None, "stopped"
            case "go_on":
                self.ended = None
            case "joined":
                pass
            case _:
                raise KeyError(kind)

    def _see(self, content: dict[str, Any]) -> None:
        names = ("key", "purpose", "query", "again", "wanted", "of")
        shown = Shown(order=tuple(content["order"]), **{name: content[name] for name in names})
        if shown.purpose == QUESTION:
            self.session.put(shown.query, content["offered"] or None)
        self.shown, self.ended, self._waiting = shown, None, self._waiting[1:]
        self.n_shown += 1

    def _hear(self, content: dict[str, Any], at: str) -> None:
        shown = self.shown
        if shown is None or shown.key != content["key"]:
            raise KeyError(content["key"])
        if shown.purpose == QUESTION:
            foreseen = self.foreseen.get(content["answer"])
            if foreseen is None:
                self.session.tell(content["answer"])
            else:
                self.session = foreseen
        self.foreseen = {}
        names = ("said", "answer", "seconds", "replays")
        self.said.append(Said(shown, at=at, **{name: content[name] for name in names}))
        self.shown = None

    def _take_back(self, key: str) -> None:
        one = next(one for one in self.said if one.shown.key == key)
        if one.shown.purpose == QUESTION:
            self.session.undo(self.questions.index(one))
        self.said.remove(one)
        self.foreseen = {}
        if self.shown is not None and (self.shown.again or self.shown.purpose != QUESTION):
            self._waiting = [self.shown, *self._waiting]  # it would not come by itself
        self.shown, self.ended = None, None
        self._waiting = [replace(one.shown, again=True), *self._waiting]

    @property
    def questions(self) -> list[Said]:
        """What the belief was told, in the order in which it was."""
        return [one for one in self.said if one.shown.purpose == QUESTION]

    def _next(self) -> Shown | str:
        """What to show next; or why there is nothing."""
        luck = Random(f"{self.seed} {self.n_shown}")
        key = f"{self.n_shown + 1}-{luck.randbytes(4).hex()}"
        if self._waiting:
            return replace(self._waiting[0], key=key)
        check = self._attention_due(key, luck) or self._repeat_due(key, luck)
        if check is not None:
            return check
        try:
            query = int(self.session.ask().query)
        except NothingToAsk:
            return "budget" if self.session.n_answered >= self.session.budget else "no_more"
        return Shown(key, QUESTION, query, self._drawn_order(luck))

    def _drawn_order(self, luck: Random) -> tuple[int, ...]:
        """The options in random order, where the question treats them alike."""
        order = list(range(self._materials.pool.n_options))
        luck.shuffle(order)
        alike = reordered(self._materials.question, tuple(order)) is not None
        return tuple(order if alike else sorted(order))

    def _is_due(self, purpose: str) -> bool:
        """Whether it is the turn of a check: they are spread evenly over the questions."""
        count = self._materials.settings["study"][CHECKS[purpose]]
        done = sum(one.shown.purpose == purpose for one in self.said)
        each = self.session.budget / (count + 1)
        return done < count and self.session.n_answered >= math.ceil((done + 1) * each)

    def _attention_due(self, key: str, luck: Random) -> Shown | None:
        """A question whose answer is asked for in words, where it is time for one."""
        if not self._is_due(ATTENTION):
            return None
        query = luck.choice(self.questions).shown.query  # nothing that a feed did not let through
        wanted = luck.randrange(len(self.session.answers))
        return Shown(key, ATTENTION, query, self._drawn_order(luck), wanted=wanted)

    def _repeat_due(self, key: str, luck: Random) -> Shown | None:
        """An earlier question in the opposite order, where it is time for one."""
        if not self._is_due(REPEAT):
            return None
        repeated = {one.shown.of for one in self.said}
        long_ago = self.questions[:-APART]
        choice = [
            one.shown for one in long_ago if one.said is not None and one.shown.key not in repeated
        ]
        if not choice:
            return None
        of = luck.choice(choice)
        order = of.order[::-1]
        alike = reordered(self._materials.question, order) is not None
        return Shown(key, REPEAT, of.query, order if alike else of.order, of=of.key)
