"""What single calls cost: metrics, kinds of question, strategies, beliefs, a live session.

``python benchmarks/costs.py metrics`` (or another one) prints CPU milliseconds on one thread, on
the Gridworld's pool of 1,000 questions (2,000 trajectories, D = 4), with 100 samples a belief, and
300 in a live session that infers tau.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Generator

from benchmarks import common, laplace
from torchrl_pref.acquisition.scoring import COMPILED, score_queries, together
from torchrl_pref.beliefs.laplace import LaplaceBelief
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.errors import InputError
from torchrl_pref.evaluation.metrics import METRICS, QUESTIONS, Exam, Standing, measure
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.questions import QUESTIONS as KINDS
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.session import Session
from torchrl_pref.strategies import STRATEGIES

SAMPLES, PEOPLE, D = 100, 200, 4
LATER = 10
"""Answers after which strategies are looked at again."""


def main() -> None:
    """Print a table."""
    parser = common.arguments(__doc__)
    parser.add_argument("what", choices=list(TABLES), help="which table")
    typed = common.start(parser)
    title, rows = TABLES[typed.what]
    common.report(f"CPU milliseconds: {title}", list(rows(typed.repeats)), typed.json)


def milliseconds(call: Callable[[], Any], repeats: int) -> float:
    """CPU time of a call, the median of so many."""
    return 1e3 * common.paired({"": call}, repeats)[""]


def of_metrics(repeats: int) -> Iterator[common.Row]:
    """A row for each metric."""
    pool, model = common.normalised_pool(), Boltzmann(common.TAU)
    samples = common.belief_samples(PEOPLE, SAMPLES)
    omega = uniform_sphere((PEOPLE, D), Generator().manual_seed(1))
    queries = pool.features[:: len(pool) // QUESTIONS]
    answers = model(torch.einsum("nkd,bd->bnk", queries, omega)).exp()
    for name in METRICS:
        exam = Exam(queries, queries, pool.features.flatten(0, 1), (name,))
        ranks = exam.ranks(omega)  # told once, whatever is answered

        def once(name: str = name, exam: Exam = exam, ranks: torch.Tensor | None = ranks) -> None:
            measure([name], Standing(samples, omega, answers, exam, model, ranks))

        yield {"metric": name, "ms": milliseconds(once, repeats)}


def of_questions(repeats: int) -> Iterator[common.Row]:
    """A row for each kind of question, a column for each number of options."""
    samples = common.belief_samples(1, SAMPLES)
    for name, kind in KINDS.items():
        row: common.Row = {"question": name}
        for n_options in range(1, 7):
            shape = (1, 1000, n_options, D)
            queries = torch.randn(shape, generator=Generator().manual_seed(0))
            model = Boltzmann(common.TAU, kind())
            try:
                model.n_answers(n_options)
            except InputError:
                row[f"K = {n_options}"] = ""
                continue
            score = partial(score_queries, samples, queries, model, together(*COMPILED))
            row[f"K = {n_options}"] = milliseconds(score, repeats)
        yield row


def of_strategies(repeats: int) -> Iterator[common.Row]:
    """A row for each strategy: before the first answer, and later."""
    model = Boltzmann(common.TAU)
    belief, human = Belief(model, SAMPLES), SimulatedHuman(model)
    env = QueryEnv(common.normalised_pool(), human, belief, batch_size=(1,), seed=0)
    first = env.reset()
    done = env.rollout(LATER, STRATEGIES["information_gain"](env), tensordict=first.clone())
    later = env.step_mdp(done[:, -1])
    for name, make in STRATEGIES.items():
        strategy, row = make(env), {"strategy": name}
        for what, session in (("before the first answer", first), (f"after {LATER}", later)):
            row[what] = milliseconds(partial(_choose, strategy, session), repeats)
        yield row


def _choose(strategy: torch.nn.Module, session: TensorDictBase) -> None:
    with torch.no_grad():
        strategy(session.clone(False))


def of_beliefs(repeats: int) -> Iterator[common.Row]:
    """A row for each belief: an update of one person and of a thousand, after 12 answers."""
    model, generator = Boltzmann(common.TAU), Generator().manual_seed(0)
    beliefs = {
        "sampled": Belief(model, SAMPLES),
        "rationality": RationalityBelief(model, samples=SAMPLES),
        "laplace": LaplaceBelief(model, SAMPLES),
    }
    for name, belief in beliefs.items():
        row: common.Row = {"belief": name}
        for people in (1, 1000):
            _, evidence = laplace.asked(model, people, D, 12)
            samples = belief.prior(people, D, generator)
            ess = torch.full((people,), float(SAMPLES))
            for h in range(1, 12):
                samples, ess, _ = belief.update(samples, ess, evidence[:, :h], generator)
            update = partial(belief.update, samples, ess, evidence, generator)
            of = f"of {people:,} at once, each" if people > 1 else "of one person"
            row[of] = milliseconds(update, repeats) / people
        yield row


def of_sessions(repeats: int) -> Iterator[common.Row]:
    """A row for each strategy: an answer and the next question, of a live session of 20."""
    features = torch.randn(1000, 2, 12, generator=Generator().manual_seed(0))
    omega = uniform_sphere((12,), Generator().manual_seed(1))
    model = Boltzmann(common.TAU)
    beliefs = {"tau known": Belief(model), "tau unknown": RationalityBelief(model)}
    for strategy, (what, belief) in product(("alignment_gain", "random"), beliefs.items()):
        times: list[float] = []
        for _ in range(1 + max(1, repeats // 3)):  # the first one warms up
            session = Session(features, model, strategy, belief, budget=21)
            question = session.ask()
            for _ in range(20):
                answer = int((question.features @ omega).argmax())
                start = time.process_time()
                session.tell(answer)
                question = session.ask()
                times.append(1e3 * (time.process_time() - start))
        counted = times[20:]
        row: common.Row = {"strategy": strategy, "belief": what}
        yield {**row, "mean": statistics.mean(counted), "most": max(counted)}


TABLES = {
    "metrics": (f"a metric of {PEOPLE} beliefs after an answer", of_metrics),
    "questions": ("all scores of 1,000 candidates under one belief", of_questions),
    "strategies": ("a choice among 1,000 questions for one person", of_strategies),
    "beliefs": (f"an update after 12 answers, D = {D}", of_beliefs),
    "sessions": ("an answer and the next of 20 questions, D = 12, 1,000 questions", of_sessions),
}

if __name__ == "__main__":
    main()
