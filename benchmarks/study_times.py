"""From an answer to the next question: the server's part, and what a person at the browser waits.

The exit status is 1 where more than one of twenty takes over 30 ms of the server, or 100 ms in all.

The server is ``ask.py`` itself. Of the server the time from a request over HTTP to the whole of its
reply is taken; in Chromium the time from the key to the next question on the screen.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import gc
import random
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from benchmarks.common import Row, arguments, report, start
from benchmarks.served import WATCHED, Server
from tests.study.browser import Browser

STUDIES = {
    "policy": ("strategy=policy",),
    "policy, feed": ("strategy=policy", "setup=feed"),
    "alignment_gain": ("strategy=alignment_gain",),
}

FIRST = 2
"""Answers that are left out: what the browser and the server do once only is in them."""

BUDGET = 20

PEOPLE = "P1", "P2", "P3"
"""Who answer over HTTP, one after the other."""

LUCK = random.Random(0)

WAIT = """
const [key, done] = arguments;
const question = document.getElementById("prompt");
const main = document.getElementById("main");
new MutationObserver(() => {
  if (document.getElementById("prompt") === question) return;
  requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - begun)));
}).observe(main, { childList: true });
const begun = performance.now();
dispatchEvent(new KeyboardEvent("keydown", { key }));
"""
"""Press a key; the milliseconds until the next question was painted."""


@contextmanager
def serving(*options: str) -> Iterator[Server]:
    """The server of a new study, for the length of the block."""
    with tempfile.TemporaryDirectory() as scratch:
        server = Server(f"hydra.run.dir={scratch}/study", *options)
        try:
            yield server
        finally:
            server.close()


def over_http(server: Server, code: str, think: float) -> Iterator[float]:
    """Milliseconds of each answer of a person."""
    _, state = server.post("/api/join", code=code)
    while state["question"] is not None:
        time.sleep(think)
        said = LUCK.randrange(len(state["question"]["answers"]))
        body = {"code": code, "key": state["question"]["key"], "answer": said, **WATCHED}
        begun = time.perf_counter()
        _, state = server.post("/api/answer", **body)
        yield 1000 * (time.perf_counter() - begun)


def in_browser(server: Server, browser: Browser, think: float) -> Iterator[float]:
    """The same at the page, of questions that one key answers."""
    browser.begin(server.link)
    for _ in range(BUDGET - 1):
        time.sleep(think)
        yield browser.driver.execute_async_script(WAIT, LUCK.choice("ab"))


def row(label: str, where: str, size: int, people: list[Iterator[float]]) -> Row:
    """What is told of each person's times in milliseconds."""
    took = [one for person in people for one in list(person)[FIRST:]]
    return {
        "strategy": label,
        "measured": where,
        "N": size,
        "median ms": statistics.median(took),
        "95% ms": statistics.quantiles(took, n=20, method="inclusive")[-1],
        "most ms": max(took),
    }


def main() -> None:
    """Measure, and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--size", type=int, default=10_000, help="N of the pool (default 10000)")
    parser.add_argument("--think", type=float, default=1.0, help="seconds before each answer")
    typed = start(parser)
    if typed.think < 0.4:
        parser.error("--think: expected at least 0.4, as the page takes no answer sooner")
    gc.disable()  # .2 s of this process would be taken for the server's
    common = f"setup.budget={BUDGET}", "task=driver", f"pool.size={typed.size}"
    rows = []
    for label, options in tqdm(STUDIES.items(), desc="over HTTP"):
        with serving(*common, *options) as server:
            people = [over_http(server, code, typed.think) for code in PEOPLE]
            rows.append(row(label, "server", typed.size, people))
    browser = Browser()  # and not before: it would take of the server's time
    for label, options in tqdm(STUDIES.items(), desc="in Chromium"):
        with serving(*common, *options) as server:
            people = [in_browser(server, browser, typed.think)]
            rows.append(row(label, "Chromium", typed.size, people))
    browser.close()
    title = (
        f"From an answer to the next question, Driver, each answered after {typed.think:g} s; of "
        f"{BUDGET} answers all but the first {FIRST}; {len(PEOPLE)} people over HTTP, 1 in Chromium"
    )
    report(title, rows, typed.json)
    limits = {"server": 30.0, "Chromium": 100.0}
    raise SystemExit(any(one["95% ms"] > limits[one["measured"]] for one in rows))


if __name__ == "__main__":
    main()
