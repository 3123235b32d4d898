"""How much room is left above the best closed form: where might a policy learn to ask better?

In each corner of the space of tasks the same humans are asked by information gain, expected
alignment, both mixed (information early, alignment late), and expected alignment judged by four
times as many samples. In the query setup the most valuable question is asked, and what looks two
(of short sessions three) questions ahead at the alignment itself is tried, too; *100 of 400* is a
belief of four times as many samples, a quarter of which choose: it tells whether the choice gains
by them, or the belief. In a feed an offer is asked that ranks among the best share, asks left over
offers left (a quantile rule); *patient* and *eager* multiply that share by .6 and 1.6.

The columns are how much more each is than expected alignment alone, in the mean alignment over all
questions. *Room* is that of the one that is best on every other pool, on the remaining pools; ± is
twice the standard error, and a room of less than that is none. Pools are of ``task=gaussian``, of
seeds that no test uses. With ``--policies`` trained policies are tried, and no rules.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import argparse
from collections.abc import Callable, Iterable, Sequence
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
from torchrl_pref.build import load_policy
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.envs.feed import FeedEnv
from torchrl_pref.envs.query import QueryEnv
from torchrl_pref.evaluation.run import draw_humans, evaluate
from torchrl_pref.humans.simulated import SimulatedHuman
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.calibrate import calibrate_tau
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import model_of
from torchrl_pref.strategies import AlignmentLookahead, Greedy, QuantileAsk
from torchrl_pref.strategies.feed import asks_over_offers
from torchrl_pref.tasks.base import make_pool
from torchrl_pref.tasks.gaussian import GaussianTask

FIRST_SEED = 900_000
"""Of the pools, far from those of any training or test."""

OF_HUMANS = 950_000
"""Of who is asked, and of all luck: no pool is drawn from the same numbers."""

BASELINE, FINE, PART = "alignment", "400 samples", "100 of 400"
TRIED = {
    "query": ("2 ahead", "3 ahead", "mixed", "information", FINE, PART),
    "feed": ("mixed", "information", FINE, "patient", "eager"),
}
PATIENT, EAGER = 0.6, 1.6
"""How a quantile rule's share is multiplied."""

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
        offers: of a feed, for each ask.
    """

    dimension: int = 4
    skew: float = 50.0
    options: int = 2
    size: int = 500
    accuracy: float = 0.9
    budget: int = 10
    question: str = "choice"
    unknown: bool = False
    offers: float = 5.0


CORNERS: dict[str, dict[str, Any]] = {
    "D=4, skew 50, K=2, 90%, H=10, N=500": {},
    "H=3": {"budget": 3},
    "H=5": {"budget": 5},
    "H=20": {"budget": 20},
    "H=60": {"budget": 60},
    "H=5, isotropic": {"budget": 5, "skew": 1.0},
    "H=5, skew 500": {"budget": 5, "skew": 500.0},
    "isotropic": {"skew": 1.0},
    "skew 500": {"skew": 500.0},
    "D=2": {"dimension": 2},
    "D=8": {"dimension": 8},
    "D=16": {"dimension": 16},
    "K=4": {"options": 4},
    "K=5": {"options": 5},
    "70%": {"accuracy": 0.7},
    "70%, H=20": {"accuracy": 0.7, "budget": 20},
    "never err": {"accuracy": 1.0},
    "never err, H=5": {"accuracy": 1.0, "budget": 5},
    "N=50": {"size": 50},
    "N=5000": {"size": 5000},
    "N=20000": {"size": 20_000},
    "weak": {"question": "weak"},
    "ranking of 3": {"question": "ranking", "options": 3},
    "tau unknown": {"unknown": True},
}
"""The first, and what is different in the others."""

OF_FEEDS: dict[str, dict[str, Any]] = {
    "1.5 offers an ask": {"offers": 1.5},
    "15 offers an ask": {"offers": 15.0},
    "1.5 offers an ask, 70%": {"offers": 1.5, "accuracy": 0.7},
    "never err, H=20": {"accuracy": 1.0, "budget": 20},
    "isotropic, H=20": {"skew": 1.0, "budget": 20},
}
"""More of them in a feed."""


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


class ByAQuarter(Greedy):
    """Greedy by expected alignment as every fourth sample tells it."""

    def __init__(self, model: ResponseModel) -> None:
        super().__init__(model, alignment_gain)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        shown = tensordict.select(*self.in_keys)
        shown["samples"] = shown["samples"][:, ::4]
        return tensordict.set("action", super().forward(shown)["action"])


@dataclass
class Found:
    """Alignment of each strategy with the humans of all pools (pools · B, H)."""

    curves: dict[str, list[Tensor]] = field(default_factory=dict)
    baseline: str = BASELINE

    def more(self, name: str, pools: slice = slice(None)) -> tuple[float, float]:
        """How much more a strategy is than the baseline in the mean over questions, and ±."""
        own, base = (torch.cat(self.curves[each][pools]).mean(1) for each in (name, self.baseline))
        return float((own - base).mean()), 2 * float((own - base).std()) / len(base) ** 0.5


class Scaled(QuantileAsk):
    """The quantile rule of expected alignment, of a share that is multiplied."""

    def __init__(self, env: FeedEnv, factor: float) -> None:
        super().__init__(env, alignment_gain)
        self.factor = factor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (B)."""
        samples, offer, n_asked, n_offered = (tensordict[key] for key in self.in_keys)
        rank = self.rank(samples, offer, 1 - n_asked / self.budget)
        share = asks_over_offers(n_asked, n_offered, self.budget, self.n_offers)
        ask = (rank >= 1 - self.factor * share) | (share >= 1)
        return tensordict.set("action", ask.squeeze(-1).long())


Tried = dict[str, Callable[[Any], TensorDictModuleBase]]
"""By name, from an environment to a strategy."""


def tried_in_pools(budget: int) -> Tried:
    """What is tried in the query setup."""
    tried: Tried = {
        BASELINE: lambda env: Greedy(env.belief.response_model, alignment_gain),
        "information": lambda env: Greedy(env.belief.response_model),
        "mixed": lambda env: Mixed(env.belief.response_model),
        "2 ahead": lambda env: AlignmentLookahead(env.belief.response_model, 2),
    }
    if budget <= SHORT:
        tried["3 ahead"] = lambda env: AlignmentLookahead(env.belief.response_model, 3)
    return {**tried, FINE: tried[BASELINE], PART: lambda env: ByAQuarter(env.belief.response_model)}


def tried_in_feeds() -> Tried:
    """What is tried in a feed."""
    tried: Tried = {
        BASELINE: lambda env: QuantileAsk(env, alignment_gain),
        "information": QuantileAsk,
        "mixed": lambda env: QuantileAsk(env, information_gain, late=alignment_gain),
        "patient": lambda env: Scaled(env, PATIENT),
        "eager": lambda env: Scaled(env, EAGER),
    }
    return {**tried, FINE: tried[BASELINE]}


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


def trained(path: Path) -> Callable[[Any], TensorDictModuleBase]:
    """The policy of a checkpoint, from an environment."""
    checkpoint = Checkpoint.load(path)
    return lambda env: load_policy(checkpoint, env).strategy


def measure(corner: Corner, setup: str, pools: int, humans: int, policies: Tried) -> Found:
    """All strategies on all pools, each with the same humans."""
    found = Found()
    tried = tried_in_feeds() if setup == "feed" else tried_in_pools(corner.budget)
    if policies:
        tried = {BASELINE: tried[BASELINE], **policies}
    for number in range(pools):
        pool = normalised(corner, number)
        model = model_for(corner, pool)
        human = SimulatedHuman(model, 4.0 if corner.unknown else 1.0)
        common = {"budget": corner.budget, "batch_size": (humans,), "seed": OF_HUMANS + number}
        for name, make_strategy in tried.items():
            samples = 400 if name in (FINE, PART) else 100
            belief = (RationalityBelief if corner.unknown else Belief)(model, samples=samples)
            env: QueryEnv | FeedEnv
            if setup == "feed":
                offers = round(corner.offers * corner.budget)
                env = FeedEnv(pool, human, belief, offers=offers, skip="free", **common)
            else:
                env = QueryEnv(pool, human, belief, **common)
            done = evaluate(env, make_strategy(env), draw_humans(env))
            found.curves.setdefault(name, []).append(done.alignment[:, 1:])
    return found


def row_of_policies(name: str, found: Found) -> common.Row:
    """What is told of a corner where policies were tried: of each, and of their mean."""
    row: common.Row = {"corner": name, "alignment": float(torch.cat(found.curves[BASELINE]).mean())}
    policies = [each for each in found.curves if each != BASELINE]
    of_each_pool = zip(*(found.curves[each] for each in policies), strict=True)
    found.curves["their mean"] = [torch.stack(curves).mean(0) for curves in of_each_pool]
    for each in (*policies, "their mean"):
        row[each] = "{:+.3f} ± {:.3f}".format(*found.more(each))
    return row


def row_of(name: str, found: Found, tried: Sequence[str]) -> common.Row:
    """What is told of a corner: how much more each thing that was tried is than the baseline."""
    best = max(found.curves, key=lambda each: found.more(each, slice(0, None, 2))[0])
    room, error = found.more(best, slice(1, None, 2))
    told = {each: f"{found.more(each)[0]:+.3f}" for each in found.curves}
    return {
        "corner": name,
        "alignment": float(torch.cat(found.curves[found.baseline]).mean()),
        **{each: told.get(each, "") for each in tried if each != found.baseline},
        "±": found.more(tried[0])[1],
        "room": f"{room:+.3f} ± {error:.3f}" if room > error else "none seen",
        "by": best if room > error else "",
    }


def arguments(description: str | None, humans: int) -> argparse.ArgumentParser:
    """A parser with what looking for room takes, and by default so many humans."""
    parser = common.arguments(description)
    parser.add_argument("--pools", type=int, default=8, help="in each corner (default 8)")
    of_each = f"of each pool (default {humans})"
    parser.add_argument("--humans", type=int, default=humans, help=of_each)
    parser.add_argument("--only", help="corners, by semicolons")
    return parser


def chosen(
    parser: argparse.ArgumentParser, typed: argparse.Namespace, corners: Iterable[str]
) -> list[str]:
    """The corners that were typed, or all; refused where there is no such one."""
    names: list[str] = typed.only.split(";") if typed.only else list(corners)
    if unknown := [name for name in names if name not in corners]:
        parser.error(f"--only {unknown[0]}: expected some of {'; '.join(corners)}")
    return names


def check_pools(parser: argparse.ArgumentParser, pools: int) -> None:
    """Refuse a single pool."""
    if pools < 2:
        parser.error("--pools: expected at least 2, to choose on some and to judge on others")


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__, humans=125)
    parser.add_argument("--setup", default="query", choices=list(TRIED), help="(default query)")
    many = "checkpoints or run folders, to be tried instead of the rules"
    parser.add_argument("--policies", nargs="+", type=Path, default=[], help=many)
    typed = common.start(parser)
    if not typed.policies:
        check_pools(parser, typed.pools)
    corners = {**CORNERS, **OF_FEEDS} if typed.setup == "feed" else CORNERS
    policies, rows = {path.stem: trained(path) for path in typed.policies}, []
    for name in tqdm(chosen(parser, typed, corners), desc="corners"):
        corner = replace(Corner(), **corners[name])
        found = measure(corner, typed.setup, typed.pools, typed.humans, policies)
        tried = TRIED[typed.setup]
        rows.append(row_of_policies(name, found) if policies else row_of(name, found, tried))
    title = "Mean alignment over all questions: expected alignment, and what others are more"
    common.report(title, rows, typed.json)


if __name__ == "__main__":
    main()
