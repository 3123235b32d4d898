"""What it costs not to know how careful a person is: a belief that infers tau, and two told one.

``python benchmarks/rationality.py [--humans 300] [--json FILE]``. Humans' tau is the reference
times a factor, and they answer 20 greedy questions of each of three beliefs: one that infers tau,
one that is told the reference, and one that is told the human's own. All face the same humans and
the same luck. *Coverage* is how often the human's return of a random trajectory lies in the central
interval that the belief holds for so likely, over the humans of all factors; beside it stands the
calibration error of the answers that beliefs predict to random questions.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

from argparse import ArgumentParser
from itertools import product

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Generator, Tensor

from benchmarks import common
from torchrl_pref.acquisition import ACQUISITIONS
from torchrl_pref.beliefs.base import BeliefBase
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.beliefs.sampled import Belief
from torchrl_pref.envs.objectives import alignment_of_mean
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.metrics import (
    QUESTIONS,
    Exam,
    Standing,
    calibration,
    reliability,
)
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies import Greedy
from torchrl_pref.tensors import directions

FACTORS = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
GREEDY_BY = ("alignment_gain", "information_gain")
BUDGET = 20
TRAJECTORIES = 20
"""Random ones whose returns are looked at, for each human."""


def main() -> None:
    """Print the cosines, their paired differences, and the coverage."""
    parser = arguments(__doc__)
    parser.add_argument("--lapse", type=float, default=0.0, help="that beliefs expect (default 0)")
    parser.add_argument("--plot", type=Path, help="also draw the coverage into this file")
    options = common.start(parser)
    cosines: list[common.Row] = []
    covered: list[common.Row] = []
    for (name, pool), how in product(pools(options.queries).items(), GREEDY_BY):
        inside: dict[str, list[Tensor]] = {}
        foreseen: dict[str, list[Tensor]] = {}
        for factor in FACTORS:
            row: common.Row = {"pool": name, "greedy by": how, "factor": factor}
            found = {}
            for kind, belief in beliefs(factor, options.lapse).items():
                done = asked(pool, belief, how, factor, options.humans, options.seed)
                last = done["session", "samples"], done["human", "omega"]
                found[kind] = alignment_of_mean(*last).squeeze(-1)
                row[kind] = float(found[kind].mean())
                inside.setdefault(kind, []).append(coverage(*last))
                foreseen.setdefault(kind, []).append(predicted(*last, belief, factor))
            for other in ("told wrongly", "told rightly"):
                row[f"less {other}"] = difference(found["inferred"] - found[other])
            cosines.append(row)
        for kind, each in inside.items():
            shares = torch.stack(each).mean(0).tolist()
            levels = dict(zip(map("{:.0%}".format, LEVELS), shares, strict=True))
            error = float(calibration(torch.cat(foreseen[kind])))
            of = {"pool": name, "greedy by": how, "belief": kind}
            covered.append({**of, **levels, "calibration error": error})
    title = f"Cosine of the mean after {BUDGET} answers, {options.humans} humans a row"
    common.report(title, cosines, options.json)
    title = "How often central intervals hold the human's return, and calibration of answers"
    common.report(title, covered, common.second(options.json, "coverage"))
    if options.plot:
        draw(covered, options.plot)


def arguments(doc: str | None) -> ArgumentParser:
    """What can be typed: whom to ask, and about what."""
    parser = common.arguments(doc)
    parser.add_argument("--humans", type=int, default=300, help="of each factor (default 300)")
    parser.add_argument("--queries", type=int, default=500, help="of a pool (default 500)")
    parser.add_argument("--seed", type=int, default=0, help="of the humans (default 0)")
    return parser


def pools(n_queries: int) -> dict[str, QueryPool]:
    """What is asked about, by name; both normalised."""
    return {"Gridworld": common.normalised_pool(n_queries), "isotropic": isotropic(n_queries)}


def isotropic(n_queries: int) -> QueryPool:
    """Four independent normal features."""
    features = torch.randn(n_queries, 2, 4, generator=Generator().manual_seed(0))
    return QueryPool(features).map_features(Normalizer.fit(features))


def beliefs(factor: float, lapse: float) -> dict[str, BeliefBase]:
    """Those that are compared, where humans' tau is the reference times a factor."""
    reference = Boltzmann(common.TAU, lapse=lapse)
    return {
        "inferred": RationalityBelief(reference),
        "told wrongly": Belief(reference),
        "told rightly": Belief(Boltzmann(common.TAU * factor, lapse=lapse)),
    }


def asked(
    pool: QueryPool, belief: BeliefBase, how: str, factor: float, humans: int, seed: int
) -> TensorDictBase:
    """The sessions (S) after the last answer, with their humans."""
    human = SimulatedHuman(Boltzmann(common.TAU))
    env = QueryEnv(pool, human, belief, BUDGET, batch_size=(humans,), seed=seed)
    start = env.reset()
    start["human", "care"].fill_(factor)
    start = env.reset(start, set_state=True)
    strategy = Greedy(belief.response_model, ACQUISITIONS[how])
    done = env.rollout(BUDGET, strategy, auto_reset=False, tensordict=start)[:, -1]
    return done["next"].set("human", done["human"])


def difference(values: Tensor) -> str:
    """The mean of paired differences (n), ± one standard error."""
    return f"{float(values.mean()):+.3f} ± {float(values.std() / len(values) ** 0.5):.3f}"


def coverage(samples: Tensor, omega: Tensor) -> Tensor:
    """How often central intervals of each level hold the human's return of a random trajectory."""
    size = (len(omega), TRAJECTORIES, omega.shape[-1])
    shown = torch.randn(size, generator=Generator().manual_seed(1))
    returns = directions(samples) @ shown.mT
    true = (shown @ omega.unsqueeze(-1)).squeeze(-1)
    inside = []
    for level in LEVELS:
        ends = returns.new_tensor([0.5 - level / 2, 0.5 + level / 2])
        low, high = torch.quantile(returns, ends, dim=1)
        inside.append(((low < true) & (true < high)).double().mean())
    return torch.stack(inside)


def predicted(samples: Tensor, omega: Tensor, belief: BeliefBase, factor: float) -> Tensor:
    """Answers to random questions by how likely they are to the belief, see ``reliability``."""
    size = (QUESTIONS, 2, omega.shape[-1])
    queries = torch.randn(size, generator=Generator().manual_seed(2))
    returns = torch.einsum("nkd,bd->bnk", queries, omega * factor)
    answers = Boltzmann(common.TAU)(returns).exp()
    exam = Exam(queries, queries, queries.flatten(0, 1), ("calibration",))
    return reliability(Standing(samples, omega, answers, exam, belief.response_model))


def draw(covered: list[common.Row], path: Path) -> None:
    """How often intervals hold what they should, a panel for each pool and way to ask."""
    asked_by = list(dict.fromkeys((row["pool"], row["greedy by"]) for row in covered))
    figure = Figure(figsize=(3.1 * len(asked_by), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(asked_by), sharex=True, sharey=True)
    for axes, (pool, how) in zip(panels, asked_by, strict=True):
        axes.plot((0, 1), (0, 1), color="#bbbbbb", lw=1)
        for row in covered:
            if (row["pool"], row["greedy by"]) == (pool, how):
                shares = [row[f"{level:.0%}"] for level in LEVELS]
                color, line = STYLES[row["belief"]]
                axes.plot(LEVELS, shares, color=color, linestyle=line, label=row["belief"])
        axes.set(title=f"{pool}\ngreedy by {how.replace('_', ' ')}", aspect="equal")
        axes.set(xlabel="interval of", xlim=(0, 1), ylim=(0, 1))
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("holds")
    panels[0].legend(frameon=False, fontsize="small", loc="upper left")
    figure.savefig(path, dpi=130)


STYLES = {
    "inferred": ("#0072b2", "-"),
    "told wrongly": ("#d55e00", "--"),
    "told rightly": ("#1f1f1f", ":"),
}

if __name__ == "__main__":
    main()
