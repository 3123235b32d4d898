"""A study under kills, double submits, reloads and two tabs: is an answer lost, doubled or moved?

Scripted people answer over HTTP while the server is killed by ``kill -9`` at random moments and
started again by ``resume=``. They do what the page does: an answer without a reply is sent again
under the same key. At the end the log is held against what they know of: each answer that was
acknowledged is there once, to the question that it was given to, and the log replays to the belief
that the server showed. With ``--times`` the time from an answer to the next question is measured
instead. The exit status is 1 where anything is otherwise.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import argparse
import http.client
import json
import multiprocessing
import os
import random
import re
import runpy
import signal
import statistics
import tempfile
import threading
import time
from contextlib import suppress
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["hydra", "uvicorn", "torchrl_pref.study.serve", "torchrl_pref.pretrained"]
)

SLOWEST = 120
"""Seconds within which a server has to be there, and to reply."""

GONE = (OSError, http.client.HTTPException)
"""What is raised where the server was killed."""


class Server:
    """``ask.py`` in a process of its own; forked from one that has imported everything."""

    def __init__(self, *arguments: str) -> None:
        number, name = tempfile.mkstemp(suffix=".log")
        os.close(number)
        self.log = Path(name)
        self.process = CONTEXT.Process(target=be_server, args=(name, arguments), daemon=True)
        self.process.start()
        self.port = self._wait_for_port()

    def _wait_for_port(self) -> int:
        until = time.monotonic() + SLOWEST
        while time.monotonic() < until and self.process.is_alive():
            found = re.search(r"http://127\.0\.0\.1:(\d+)/", self.log.read_text())
            if found:
                return int(found[1])
            time.sleep(0.005)
        raise SystemExit(f"the server did not start: {self.log.read_text()}")

    def kill(self) -> None:
        """By SIGKILL, which nothing survives."""
        with suppress(ProcessLookupError):
            os.kill(self.process.pid or 0, signal.SIGKILL)

    def close(self) -> None:
        """Kill it, and wait until it is gone."""
        self.kill()
        self.process.join()
        self.log.unlink()

    def post(self, path: str, **body: Any) -> tuple[int, dict[str, Any]]:
        """Status and JSON of a request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=SLOWEST)
        try:
            headers = {"Content-Type": "application/json"}
            connection.request("POST", path, json.dumps(body), headers)
            reply = connection.getresponse()
            return reply.status, json.loads(reply.read())
        finally:
            connection.close()


def be_server(log: str, arguments: tuple[str, ...]) -> None:
    """Become ``ask.py``."""
    out = os.open(log, os.O_WRONLY)
    os.dup2(out, 1)
    os.dup2(out, 2)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    os.chdir(tempfile.gettempdir())
    sys.argv = [str(ROOT / "ask.py"), *arguments, "open=false"]
    sys.path[0] = str(ROOT)
    runpy.run_path(sys.argv[0], run_name="__main__")


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


WATCHED = {"seconds": 1.0, "replays": 0}


def kills(count: int, seed: int) -> bool:
    """Kill the server so often; whether nothing was lost, doubled or moved."""
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
        return report(folder, people, count)


def report(folder: Path, people: People, count: int) -> bool:
    """Hold the log against what people know; print what was found."""
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
    rows = [["kill -9", count], *([name, number] for name, number in people.counts.items())]
    rows += [["people", len(people.means)], ["in the log", len(answers)], ["wrong", len(wrong)]]
    print(tabulate(rows, tablefmt="simple"))
    for sentence in wrong[:10]:
        print(sentence)
    return not wrong


def times(size: int, think: float) -> bool:
    """Measure the server's part from an answer to the next question."""
    rows = []
    for label, typed in (
        ("policy", ("strategy=policy",)),
        ("policy, feed", ("strategy=policy", "setup=feed")),
        ("alignment_gain", ("strategy=alignment_gain",)),
    ):
        with tempfile.TemporaryDirectory() as scratch:
            common = f"hydra.run.dir={scratch}/study", "task=driver", f"pool.size={size}"
            server = Server(*common, *typed)
            _, state = server.post("/api/join", code="P1")
            took = []
            while state["question"] is not None:
                time.sleep(think)
                body = {"key": state["question"]["key"], **WATCHED}
                begun = time.perf_counter()
                _, state = server.post(
                    "/api/answer", code="P1", answer=random.choice([0, 1]), **body
                )
                took.append(1000 * (time.perf_counter() - begun))
            server.close()
        ordered = sorted(took)
        rows.append([label, statistics.median(took), ordered[int(0.95 * len(took))], ordered[-1]])
    heads = ["strategy", "median ms", "95% ms", "most ms"]
    print(f"from an answer to the next question, Driver, N={size}, answered after {think} s")
    print(tabulate(rows, heads, floatfmt=".1f"))
    return True


def main() -> None:
    """Run what was typed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--kills", type=int, default=200, help="how often the server is killed (200)"
    )
    parser.add_argument("--seed", type=int, default=0, help="fixes the moments and the person (0)")
    parser.add_argument("--times", action="store_true", help="measure times instead")
    parser.add_argument("--size", type=int, default=10_000, help="N, with --times (10000)")
    parser.add_argument(
        "--think", type=float, default=1.0, help="seconds of a person, with --times (1)"
    )
    typed = parser.parse_args()
    good = times(typed.size, typed.think) if typed.times else kills(typed.kills, typed.seed)
    raise SystemExit(0 if good else 1)


if __name__ == "__main__":
    main()
