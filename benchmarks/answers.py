"""What each kind of answer is worth, by the question and by the second of the person's time.

``python benchmarks/answers.py [--task gridworld] [--humans 100] [--pools 5] [--plot FILE]``. Every
kind of question is asked about the same trajectories: queries of four, of which a question about
two takes the first two. The humans are the same too, as noisy as one who picks the better of two
in 90% of the cases. Each question is the one of highest expected gain in alignment.

How long an answer takes is a model and no measurement: a person watches each of the K trajectories
for ``--watch`` seconds and weighs two of them against each other in ``--decide``. Picking one of K
takes K-1 such decisions, a ranking of K as many as sorting needs, log2 K! of them, best and worst
2K-3, and a weak comparison as many as a choice of two.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import argparse
import math
from typing import NamedTuple

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Generator, Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.acquisition.functions import alignment_gain
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.evaluation.views import mean_and_interval
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import Greedy
from torchrl_pref.tasks import TASKS
from torchrl_pref.tasks.base import make_pool

OPTIONS = 4


class Asked(NamedTuple):
    """A kind of question, about so many trajectories."""

    label: str
    name: str
    options: int
    decisions: float
    """How many times two trajectories are weighed against each other."""


KINDS = (
    Asked("choice of 2", "choice", 2, 1),
    Asked("weak, of 2", "weak", 2, 1),
    Asked("choice of 4", "choice", 4, 3),
    Asked("best and worst of 4", "best_worst", 4, 5),
    Asked("ranking of 3", "ranking", 3, math.log2(math.factorial(3))),
    Asked("ranking of 4", "ranking", 4, math.log2(math.factorial(4))),
)


def main() -> None:
    """Print the table, and draw the figure."""
    parser = common.arguments(__doc__)
    parser.add_argument("--task", default="gridworld", choices=list(TASKS))
    parser.add_argument("--humans", type=int, default=100, help="of each pool")
    parser.add_argument("--pools", type=int, default=5)
    parser.add_argument("--size", type=int, default=300, help="queries in a pool")
    parser.add_argument("--questions", type=int, default=20)
    parser.add_argument("--watch", type=float, default=5.0, help="seconds for each trajectory")
    parser.add_argument("--decide", type=float, default=2.0, help="seconds for each decision")
    parser.add_argument("--plot", type=Path, help="also draw the curves into this file")
    typed = common.start(parser)
    curves = {
        kind.label: torch.stack([curve(kind, typed, pool) for pool in range(typed.pools)])
        for kind in tqdm(KINDS, desc="kinds", unit="kind")
    }
    rows = [row(kind, curves[kind.label], typed) for kind in KINDS]
    people = f"{typed.pools} pools of {typed.humans} humans"
    common.report(f"Alignment by kind of question, {typed.task}, {people}", rows, typed.json)
    if typed.plot:
        draw(curves, typed)


def curve(kind: Asked, typed: argparse.Namespace, seed: int) -> Tensor:
    """Alignment (1 B H+1) after each question of a kind, on one pool."""
    task = TASKS[typed.task]()
    whole = make_pool(task, typed.size, OPTIONS, 2 * seed)
    normalize = Normalizer.fit(whole.features)
    features = normalize(whole.features)
    omega = uniform_sphere((500, features.shape[-1]), Generator().manual_seed(seed))
    tau = calibrate_tau(torch.einsum("nkd,md->nmk", features[:, :2], omega))
    model = Boltzmann(tau, QUESTIONS[kind.name]())
    env = QueryEnv(
        QueryPool(features[:, : kind.options]),
        SimulatedHuman(model),
        Belief(model),
        budget=typed.questions,
        batch_size=(typed.humans,),
        seed=seed,
    )
    return evaluate(env, Greedy(model, alignment_gain), draw_humans(env)).alignment.unsqueeze(0)


def seconds(kind: Asked, watch: float, decide: float) -> float:
    """Of the person's time, for one answer: to watch one option, and for one decision."""
    return kind.options * watch + kind.decisions * decide


def row(kind: Asked, values: Tensor, typed: argparse.Namespace) -> common.Row:
    """One kind's line of the table, from alignments (P 1 B H+1)."""
    each = seconds(kind, typed.watch, typed.decide)
    cells: common.Row = {"question": kind.label, "seconds each": round(each, 1)}
    for count in (5, 10, typed.questions):
        mean, low, high = mean_and_interval(values[:, :, :, count])
        cells[f"after {count}"] = f"{mean:.3f} [{low:.3f}, {high:.3f}]"
    for limit in (60, 120, 240):
        count = int(limit / each)
        within = count <= typed.questions
        cells[f"after {limit} s"] = f"{values[..., count].mean():.3f}" if within else ""
    return cells


def draw(curves: dict[str, Tensor], typed: argparse.Namespace) -> None:
    """Alignment by questions, and by seconds."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    by_question, by_second = figure.subplots(1, 2, sharey=True)
    counts = torch.arange(typed.questions + 1)
    for kind in KINDS:
        mean = curves[kind.label].mean((0, 1, 2))
        style = {"label": kind.label, "linestyle": "--" if kind.options == 2 else "-"}
        by_question.plot(counts, mean, **style)
        by_second.plot(counts * seconds(kind, typed.watch, typed.decide), mean, **style)
    by_question.set(xlabel="questions", ylabel="alignment", title="by the question")
    wait = f"{typed.watch:g} s a trajectory, {typed.decide:g} s a decision"
    by_second.set(xlabel=f"seconds of the person's time ({wait})", title="by the second")
    by_second.set_xlim(0, typed.questions * seconds(KINDS[0], typed.watch, typed.decide))
    for axes in (by_question, by_second):
        axes.grid(alpha=0.3)
    by_second.legend(loc="lower right", frameon=False)
    figure.savefig(typed.plot, dpi=120)


if __name__ == "__main__":
    main()
