"""CPU seconds of whole sessions: 100 simulated humans, 20 queries each, from a pool of 1000.

``python benchmarks/session.py``. Choosing, answering and updating the belief, by random, by greedy
information gain and by the (untrained) scorer policy. Where APReL is importable (see ``peers.py``)
it asks one human 20 queries in the same way, which takes minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import time
from types import ModuleType

import numpy as np
from tensordict.nn import TensorDictModuleBase

from benchmarks import common, peers
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.policies.scorer import scorer_policy
from torchrl_pref.questions.responses import Boltzmann, Optimal
from torchrl_pref.strategies import Greedy, RandomQuery

HUMANS, BUDGET = 100, 20


def main() -> None:
    """Print the table."""
    options = common.start(common.arguments(__doc__))
    pool, rows = common.normalised_pool(), []
    for model in (Boltzmann(common.TAU), Optimal()):
        env = QueryEnv(
            pool, SimulatedHuman(model), Belief(model), BUDGET, batch_size=(HUMANS,), seed=1
        )
        humans = draw_humans(env)
        strategies: dict[str, TensorDictModuleBase] = {
            "random": RandomQuery(),
            "greedy information gain": Greedy(model),
            "scorer policy": scorer_policy(env).strategy,
        }
        for name, strategy in strategies.items():
            start = time.process_time()
            evaluate(env, strategy, humans)
            rows.append(_row(f"{name}, {model}", HUMANS, time.process_time() - start))
    aprel = peers.import_aprel()
    if aprel is not None:
        rows.append(_row("APReL, greedy", 1, _aprel_session(aprel)))
    common.report(f"Sessions of {BUDGET} queries, pool of 1000, M=100", rows, options.json)


def _row(name: str, humans: int, seconds: float) -> common.Row:
    """One line of the table."""
    return {
        "strategy": name,
        "humans": humans,
        "CPU s": seconds,
        "CPU s a human": seconds / humans,
        "CPU ms a query": 1000 * seconds / humans / BUDGET,
    }


def _aprel_session(aprel: ModuleType) -> float:
    """CPU seconds of one human and 20 greedy queries with APReL; the answers are random."""
    pool = common.normalised_pool().features.double().numpy()
    rng, asked = np.random.default_rng(0), [0]
    queries = peers.aprel_queries(aprel, pool)
    start = time.process_time()
    for _ in range(BUDGET):
        answers = rng.integers(2, size=len(asked))
        belief = peers.aprel_belief(aprel, pool[asked], answers, common.TAU)
        asked.append(peers.choose_by_aprel(aprel, belief, queries)())
    return time.process_time() - start


if __name__ == "__main__":
    main()
