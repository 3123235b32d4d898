"""One person, 20 questions of a pool of 100,000: CPU seconds a question, and memory.

The exit status is 1 where a question takes more than .3 s in the mean, or all more than 1 GiB, by
the strategies that are there to be used on such pools.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import json
import resource
import subprocess
import time
from itertools import product

import torch
from torch import Generator

from benchmarks import common
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.session import Session

STRATEGIES = ("information_gain", "alignment_gain", "policy")
SLOWER = ("thompson", "max_regret", "disagreement", "knowledge_gradient")
"""What is not compiled: with tau known alone, and not held to the bounds."""

BELIEFS = ("tau known", "tau unknown")
"""With the first, whoever answers is thought to be of tau 4.5; with the second this is inferred,
and a twentieth of the answers may be slips, as in ask.py."""

QUESTIONS = 20


def measure(strategy: str, belief: str, size: int) -> common.Row:
    """What a session takes, in this process."""
    known = belief == "tau known"
    model = Boltzmann(common.TAU, lapse=0.0 if known else 0.05)
    features = torch.randn(size, 2, 4, generator=Generator().manual_seed(0))
    made = None if known else RationalityBelief(model)
    session = Session(QueryPool(features), model, strategy, made, budget=QUESTIONS + 1)
    omega, luck = torch.tensor([0.5, -0.5, 0.5, 0.5]), Generator().manual_seed(0)
    seconds = []
    for _ in range(QUESTIONS + 1):  # the first compiles
        start = time.process_time()
        asked = session.ask()
        chances = model(asked.features @ omega).exp()
        session.tell(int(chances.multinomial(1, generator=luck)))
        seconds.append(time.process_time() - start)
    return {
        "strategy": strategy,
        "belief": belief,
        "N": size,
        "CPU s a question": sum(seconds[1:]) / QUESTIONS,
        "most": max(seconds[1:]),
        "MiB in all": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    """Print the table; each row is made in a process of its own."""
    parser = common.arguments(__doc__)
    parser.add_argument("--size", type=int, default=100_000, help="N (default 100000)")
    parser.add_argument("--one", nargs=2, help="one row, as JSON: a strategy and a belief")
    typed = common.start(parser)
    if typed.one:
        print(json.dumps(measure(*typed.one, typed.size)))
        return
    rows = []
    for strategy, belief in (*product(STRATEGIES, BELIEFS), *product(SLOWER, BELIEFS[:1])):
        again = [sys.executable, __file__, f"--size={typed.size}", "--one", strategy, belief]
        rows.append(json.loads(subprocess.check_output(again, text=True)))
    sizes = "M = 100, or 300 where tau is unknown, D = 4"
    common.report(f"One person, {QUESTIONS} questions, {sizes}", rows, typed.json)
    bound = [row for row in rows if row["strategy"] in STRATEGIES]
    kept = all(row["CPU s a question"] <= 0.3 and row["MiB in all"] <= 1024 for row in bound)
    raise SystemExit(not kept)


if __name__ == "__main__":
    main()
