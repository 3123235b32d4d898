"""How much room is left above the best closed form: where might a policy learn to ask better?

In each corner of the space of tasks the same humans are asked by greedy information gain, greedy
expected alignment, both mixed (information early, alignment late), expected alignment judged by
four times as many samples, and by looking two (of short sessions three) questions ahead at the
alignment itself. The columns are how much more each is than greedy expected alignment, in the mean
alignment over all questions. *Room* is that of the one that is best on every other pool, on the
remaining pools; ± is twice the standard error, and a room of less than that is none. Pools are of
``task=gaussian``, of seeds that no test uses.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from tqdm import tqdm

from benchmarks import common
from torchrl_pref.acquisition.functions import alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import score_queries, standardise, together
from torchrl_pref.beliefs.rationality import RationalityBelief
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import model_of
from torchrl_pref.strategies import AlignmentLookahead, Greedy
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.tasks.gaussian import GaussianTask

FIRST_SEED = 900_000
"""Of the pools, far from those of any training or test."""

BASELINE = "alignment"
TRIED = ("2 ahead", "3 ahead", "mixed", "information", "400 samples")

SHORT = 5
"""Questions up to which three steps ahead are looked at, too."""


@dataclass(frozen=True)
class Corner:
    """A place in the space of tasks.

    Attributes:
        dimension, skew: of the features.
        options: K.
        size: N.
        accuracy: how often the better option is picked; 1: humans never err.
        budget: H.
        question: what can be answered.
        unknown: whether the belief has to infer tau, of humans whose tau is within a factor of 4.
    """

    dimension: int = 4
    skew: float = 50.0
    options: int = 2
    size: int = 500
    accuracy: float = 0.9
    budget: int = 10
    question: str = "choice"
    unknown: bool = False


CORNERS: dict[str, dict[str, Any]] = {
    "D=4, skew 50, K=2, 90%, H=10, N=500": {},
    "H=3": {"budget": 3},
    "H=5": {"budget": 5},
    "H=20": {"budget": 20},
    "H=5, isotropic": {"budget": 5, "skew": 1.0},
    "H=5, skew 500": {"budget": 5, "skew": 500.0},
    "isotropic": {"skew": 1.0},
    "skew 500": {"skew": 500.0},
    "D=2": {"dimension": 2},
    "D=8": {"dimension": 8},
    "D=16": {"dimension": 16},
    "K=4": {"options": 4},
    "70%": {"accuracy": 0.7},
    "70%, H=20": {"accuracy": 0.7, "budget": 20},
    "never err": {"accuracy": 1.0},
    "never err, H=5": {"accuracy": 1.0, "budget": 5},
    "N=50": {"size": 50},
    "N=5000": {"size": 5000},
    "weak": {"question": "weak"},
    "ranking of 3": {"question": "ranking", "options": 3},
    "tau unknown": {"unknown": True},
}
"""The first, and what is different in the others."""


class Mixed(TensorDictModuleBase):
    """Greedy by information gain first and by expected alignment last, both standardised."""

    in_keys = ["samples", "queries", "remaining"]
    out_keys = ["action"]

    def __init__(self, model: ResponseModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        both = together(information_gain, alignment_gain)
        scores = score_queries(tensordict["samples"], tensordict["queries"], self.model, both)
        first, last = standardise(scores).unbind(-1)
        left = tensordict["remaining"]
        return tensordict.set("action", (left * first + (1 - left) * last).argmax(-1))


@dataclass
class Found:
    """Alignment of each strategy with the humans of all pools (pools · B, H)."""

    curves: dict[str, list[Tensor]] = field(default_factory=dict)

    def more(self, name: str, pools: slice = slice(None)) -> tuple[float, float]:
        """How much more a strategy is than the baseline in the mean over questions, and ±."""
        own, base = (torch.cat(self.curves[each][pools]).mean(1) for each in (name, BASELINE))
        return float((own - base).mean()), 2 * float((own - base).std()) / len(base) ** 0.5


def strategies_of(model: ResponseModel, budget: int) -> dict[str, TensorDictModuleBase]:
    """What is tried, but for what needs other samples."""
    tried: dict[str, TensorDictModuleBase] = {
        BASELINE: Greedy(model, alignment_gain),
        "information": Greedy(model),
        "mixed": Mixed(model),
        "2 ahead": AlignmentLookahead(model, 2),
    }
    if budget <= SHORT:
        tried["3 ahead"] = AlignmentLookahead(model, 3)
    return tried


def normalised(corner: Corner, number: int) -> QueryPool:
    """A pool of a corner."""
    task = GaussianTask(corner.dimension, corner.skew, axes=FIRST_SEED + number)
    raw = make_pool(task, corner.size, corner.options, seed=FIRST_SEED + 2 * number)
    return raw.map_features(Normalizer.fit(raw.features))


def model_for(corner: Corner, pool: QueryPool) -> ResponseModel:
    """How humans answer."""
    omega = uniform_sphere((1000, pool.n_features), torch.Generator().manual_seed(0))
    returns = torch.einsum("nkd,md->nmk", pool.features[:300], omega)
    tau = None if corner.accuracy == 1 else calibrate_tau(returns, corner.accuracy)
    return model_of(tau, QUESTIONS[corner.question](), lapse=0.0)


def measure(corner: Corner, pools: int, humans: int) -> Found:
    """All strategies on all pools, each with the same humans."""
    found = Found()
    for number in range(pools):
        pool = normalised(corner, number)
        model = model_for(corner, pool)
        spread = 4.0 if corner.unknown else 1.0
        make = RationalityBelief if corner.unknown else Belief
        tried = strategies_of(model, corner.budget)
        for name, strategy in {**tried, "400 samples": tried[BASELINE]}.items():
            belief = make(model, samples=400 if name == "400 samples" else 100)
            human = SimulatedHuman(model, spread)
            env = QueryEnv(
                pool, human, belief, corner.budget, batch_size=(humans,), seed=FIRST_SEED + number
            )
            done = evaluate(env, strategy, draw_humans(env))
            found.curves.setdefault(name, []).append(done.alignment[:, 1:])
    return found


def row_of(name: str, corner: Corner, found: Found) -> common.Row:
    """What is told of a corner."""
    best = max(found.curves, key=lambda each: found.more(each, slice(0, None, 2))[0])
    room, error = found.more(best, slice(1, None, 2))
    told = {each: f"{found.more(each)[0]:+.3f}" for each in found.curves}
    return {
        "corner": name,
        "alignment": float(torch.cat(found.curves[BASELINE]).mean()),
        **{each: told.get(each, "") for each in TRIED},
        "±": found.more("2 ahead")[1],
        "room": f"{room:+.3f} ± {error:.3f}" if room > error else "none seen",
        "by": best if room > error else "",
    }


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--pools", type=int, default=8, help="in each corner (default 8)")
    parser.add_argument("--humans", type=int, default=125, help="of each pool (default 125)")
    parser.add_argument("--only", help="corners, by semicolons")
    typed = common.start(parser)
    if typed.pools < 2:
        parser.error("--pools: expected at least 2, to choose on some and to judge on others")
    names = typed.only.split(";") if typed.only else list(CORNERS)
    if unknown := [name for name in names if name not in CORNERS]:
        parser.error(f"--only {unknown[0]}: expected some of {'; '.join(CORNERS)}")
    rows = []
    for name in tqdm(names, desc="corners"):
        corner = replace(Corner(), **CORNERS[name])
        rows.append(row_of(name, corner, measure(corner, typed.pools, typed.humans)))
    title = "Mean alignment over all questions: greedy expected alignment, and what others are more"
    common.report(title, rows, typed.json)


if __name__ == "__main__":
    main()
