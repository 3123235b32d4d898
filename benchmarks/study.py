"""A study under kills, double submits, reloads and two tabs: is an answer lost, doubled or moved?

Scripted people answer over HTTP while the server is killed by ``kill -9`` at random moments and
started again by ``resume=``. They do what the page does: an answer without a reply is sent again
under the same key. At the end the log is held against what they know of: each answer that was
acknowledged is there once, to the question that it was given to, and the log replays to the belief
that the server showed. The exit status is 1 where anything is otherwise.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import random
import tempfile
import threading
from contextlib import suppress
from typing import Any

from tqdm import tqdm

from benchmarks.common import Row, arguments, report, start
from benchmarks.served import GONE, WATCHED, Server

TRIED = {"kill -9": 200, "double submits": 50, "other tab": 20, "reloads": 20}
"""What has to happen at least in 200 kills, for the run to say anything."""


class People:
    """Who answer one after the other as the page does, and remember what was acknowledged.

    Attributes:
        known: by person and key of the question, what was acknowledged.
        means: by person, the weights that the server showed last.
        pending: an answer to which there was no reply.
        maybe_undone: an answer whose taking back had no reply.
        counts: what was done.
        wrong: what should not have happened, a sentence each.
    """

    def __init__(self, seed: int) -> None:
        self.luck, self.number = random.Random(seed), 1
        self.known: dict[tuple[str, str], int | None] = {}
        self.means: dict[str, list[float]] = {}
        self.pending: dict[str, Any] | None = None
        self.maybe_undone: tuple[str, str] | None = None
        self.state: dict[str, Any] | None = None
        self.counts = {"answers": 0, "double submits": 0, "other tab": 0, "reloads": 0, "undone": 0}
        self.wrong: list[str] = []

    @property
    def code(self) -> str:
        """Of who answers now."""
        return f"P{self.number}"

    def step(self, server: Server) -> None:
        """One thing that a person does."""
        if self.state is None:
            self._see(server.post("/api/join", code=self.code)[1])
        assert self.state is not None
        if self.pending is None and self.state["question"] is None:
            self.number, self.state = self.number + 1, None
            return
        if self.pending is None:
            said = self.luck.choice([0, 1, None])
            key = self.state["question"]["key"]
            self.pending = {"code": self.code, "key": key, "answer": said, **WATCHED}
        status, state = server.post("/api/answer", **self.pending)
        if status != 200:
            self.wrong.append(f"an answer was met with {status}: {state['error']}")
            state = state["state"]
        self.known[self.code, self.pending["key"]] = self.pending["answer"]
        self.counts["answers"] += 1
        answered, self.pending = self.pending, None
        self._see(state)
        self._misbehave(server, answered)

    def _see(self, state: dict[str, Any]) -> None:
        self.state, self.means[self.code] = state, state["learned"]["mean"]

    def _misbehave(self, server: Server, answered: dict[str, Any]) -> None:
        """Now and then: submit twice, answer in another tab, reload, take an answer back."""
        assert self.state is not None
        before, draw = self.state["answers"], self.luck.random()
        if draw < 0.12:
            self.counts["double submits"] += 1
            status, again = server.post("/api/answer", **answered)
            if status != 200 or again["answers"] != before:
                self.wrong.append(f"a double submit was met with {status}")
        elif draw < 0.24:
            self.counts["other tab"] += 1
            other = {**answered, "answer": 1 if answered["answer"] != 1 else 0}
            status, again = server.post("/api/answer", **other)
            if status != 409 or again["state"]["answers"] != before:
                self.wrong.append(f"another answer in another tab was met with {status}")
        elif draw < 0.30:
            self.counts["reloads"] += 1
            self._see(server.post("/api/join", code=self.code)[1])
        elif draw < 0.33:
            self._take_back(server, self.luck.choice(before)["key"])

    def _take_back(self, server: Server, key: str) -> None:
        """Undo an answer; without a reply nobody knows whether that was done."""
        was = self.known.pop((self.code, key))
        try:
            status, state = server.post("/api/undo", code=self.code, key=key)
        except GONE:
            self.state = None  # the page loads again, and shows what is there
            self.known[self.code, key] = was
            self.maybe_undone = self.code, key
            raise
        if status != 200:
            self.wrong.append(f"taking an answer back was met with {status}")
        self.counts["undone"] += 1
        self._see(state)

    def after_kill(self, server: Server) -> None:
        """See what became of an answer that was being taken back."""
        if self.state is None and self.maybe_undone is not None:
            self._see(server.post("/api/join", code=self.code)[1])
            assert self.state is not None
            if self.maybe_undone[1] not in {one["key"] for one in self.state["answers"]}:
                self.known.pop(self.maybe_undone)
                self.counts["undone"] += 1
            self.maybe_undone = None


def kills(count: int, seed: int) -> tuple[list[Row], list[str]]:
    """Kill the server so often; the rows of the table, and what is wrong."""
    luck, people = random.Random(seed), People(seed)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "study"
        server = Server(f"hydra.run.dir={folder}")
        for _ in tqdm(range(count), desc="kills"):
            with suppress(*GONE):
                people.after_kill(server)
                people.step(server)  # it is there, and what was slow at its start is over
                threading.Timer(luck.expovariate(5), server.kill).start()
                while server.process.is_alive():
                    people.step(server)
            server.close()
            server = Server(f"resume={folder}")
        people.after_kill(server)
        for _ in range(5):
            people.step(server)
        server.close()
        return judge(folder, people, count)


def judge(folder: Path, people: People, count: int) -> tuple[list[Row], list[str]]:
    """Hold the log against what people know."""
    import ask

    study = ask.load_study(folder, ask.load_settings("resume", folder))
    answers = [(code, one) for code, person in study.people.items() for one in person.said]
    said = {(code, one.shown.key): one.said for code, one in answers}
    found = {
        "lost": [key for key in people.known if key not in said],
        "that nobody gave": [key for key in said if key not in people.known],
        "changed": [key for key in said if said[key] != people.known.get(key, said[key])],
        "doubled": answers[len(said) :],
    }
    wrong = [
        *people.wrong,
        *(f"{len(keys)} answers {what}" for what, keys in found.items() if keys),
    ]
    for code, means in people.means.items():
        if study.people[code].session.weights.mean.tolist() != means:
            wrong.append(f"the log of {code} replays to another belief than the server showed")
    study.close()
    counts = {"kill -9": count, "people": len(people.means), **people.counts}
    counts |= {"answers that stand in the log": len(answers), "anything wrong": len(wrong)}
    return [{"what": name, "how often": number} for name, number in counts.items()], wrong


def main() -> None:
    """Run what was typed."""
    parser = arguments(__doc__)
    parser.add_argument("--kills", type=int, default=200, help="of the server (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments and the people")
    typed = start(parser)
    rows, wrong = kills(typed.kills, typed.seed)
    report("A study under kills, double submits, reloads and two tabs", rows, typed.json)
    for sentence in wrong[:10]:
        print(sentence, file=sys.stderr)
    happened = {str(row["what"]): int(row["how often"]) for row in rows}
    rare = {name: most for name, most in TRIED.items() if happened[name] < typed.kills * most / 200}
    if rare:
        print(f"too few to tell: {', '.join(rare)}", file=sys.stderr)
    raise SystemExit(bool(wrong or rare))


if __name__ == "__main__":
    main()
