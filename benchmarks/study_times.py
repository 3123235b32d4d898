"""From an answer to the next question: the server's part, and what a person at the browser waits.

The exit status is 1 where the median is more than 30 ms of the server, or 100 ms in all.

The server is ``ask.py`` itself. Of the server the time from a request over HTTP to the whole of its
reply is taken; in Chromium the time from the key to the next question on the screen.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import random
import statistics
import tempfile
import time
from collections.abc import Iterator

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


def over_http(server: Server, think: float) -> Iterator[float]:
    """Milliseconds of each answer of a person."""
    _, state = server.post("/api/join", code="P1")
    while state["question"] is not None:
        time.sleep(think)
        said = LUCK.randrange(len(state["question"]["answers"]))
        body = {"code": "P1", "key": state["question"]["key"], "answer": said, **WATCHED}
        begun = time.perf_counter()
        _, state = server.post("/api/answer", **body)
        yield 1000 * (time.perf_counter() - begun)


def in_browser(server: Server, browser: Browser, think: float) -> Iterator[float]:
    """The same at the page, of questions that one key answers."""
    browser.begin(server.link)
    for _ in range(BUDGET - 1):
        time.sleep(think)
        yield browser.driver.execute_async_script(WAIT, LUCK.choice("ab"))


def row(label: str, where: str, size: int, took: list[float]) -> Row:
    """What is told of some times in milliseconds."""
    took = took[FIRST:]
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
    rows: list[Row] = []
    browser = Browser()
    for label, options in tqdm(STUDIES.items(), desc="strategies"):
        with tempfile.TemporaryDirectory() as scratch:
            common = f"setup.budget={BUDGET}", "task=driver", f"pool.size={typed.size}", *options
            server = Server(f"hydra.run.dir={scratch}/study", *common)
            rows.append(row(label, "server", typed.size, list(over_http(server, typed.think))))
            server.close()
            server = Server(f"hydra.run.dir={scratch}/other", *common)
            took = list(in_browser(server, browser, typed.think))
            rows.append(row(label, "Chromium", typed.size, took))
            server.close()
    browser.close()
    title = (
        f"From an answer to the next question, Driver, each answered after {typed.think:g} s; of "
        f"{BUDGET} answers all but the first {FIRST}"
    )
    report(title, rows, typed.json)
    limits = {"server": 30.0, "Chromium": 100.0}
    raise SystemExit(any(one["median ms"] > limits[one["measured"]] for one in rows))


if __name__ == "__main__":
    main()
