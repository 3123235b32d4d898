"""How much room is left where the kind of the next question may be chosen, too.

In each corner the same humans have so many seconds, and each question takes as many as its kind
does (``answers.py`` has the model). At every step any query of the pool may be asked about as a
question of any of four kinds. *Gain a second* is greedy: the query and the kind with the highest
expected gain in alignment for each second. Beside it stand the same by information, greedy by the
gain alone, each kind alone, what looks two questions ahead (what a question and the one after it
gain together for each second), and gain a second by four times as many samples.

Columns are how much more each is than *gain a second*, in the mean alignment over all seconds.
*Room* is that of the one that is best on every other pool, on the remaining pools; ± is twice the
standard error, and a room of less than that is none. Pools are of ``task=gaussian``, of seeds that
no test uses.

Shapes: S sessions, N queries of four options, D features, M samples, R possible answers.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor
from tqdm import tqdm

from benchmarks import answers, common, room
from torchrl_pref.acquisition.functions import Acquisition, alignment_gain, information_gain
from torchrl_pref.acquisition.scoring import predict_answers, score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.pool import QueryPool
from torchrl_pref.questions import QUESTIONS
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.responses import Boltzmann
from torchrl_pref.strategies.lookahead import Ahead

LABELS = ("choice of 2", "weak, of 2", "ranking of 3", "best and worst of 4")
BASELINE, FINE, AHEAD = "gain a second", "400 samples", "2 ahead"
FACTORS, ROWS = 2, 3
"""Of an answer of any of these kinds, at most."""

FIRST, THEN = 24, 60
"""Questions that looking ahead follows, and those of each kind that may come after them."""


@dataclass(frozen=True)
class Corner:
    """A place in the space of tasks: features, humans, and what their time goes to."""

    dimension: int = 4
    skew: float = 50.0
    accuracy: float = 0.9
    limit: float = 120.0
    watch: float = 5.0
    decide: float = 2.0


CORNERS: dict[str, dict[str, Any]] = {
    "D=4, skew 50, 90%, 120 s; 5 s to watch one, 2 to decide": {},
    "60 s": {"limit": 60.0},
    "240 s": {"limit": 240.0},
    "isotropic": {"skew": 1.0},
    "D=8": {"dimension": 8},
    "70%": {"accuracy": 0.7},
    "1 s to watch one": {"watch": 1.0},
    "10 s to watch one": {"watch": 10.0},
}
"""The first, and what is different in the others."""


class Kind(NamedTuple):
    """A kind of question that may be asked: its name, how people answer, and what it takes."""

    label: str
    model: Boltzmann
    options: int
    seconds: float


class Asking(NamedTuple):
    """What a rule may ask."""

    features: Tensor
    """(N 4 D)"""
    kinds: list[Kind]


Rule = Callable[[Asking, Tensor, Tensor], Tensor]
"""From what may be asked, samples (S M D) and the seconds left (S) to values (S kinds N)."""


def by(acquisition: Acquisition, per_second: bool) -> Rule:
    """Greedy by what a question is worth, or what it is worth for each second."""

    def values(asking: Asking, samples: Tensor, left: Tensor) -> Tensor:
        found = []
        for kind in asking.kinds:
            queries = asking.features[None, :, : kind.options].expand(len(samples), -1, -1, -1)
            value = score_queries(samples, queries, kind.model, acquisition)
            found.append(value / kind.seconds if per_second else value)
        return torch.stack(found, 1)

    return values


def only(label: str) -> Rule:
    """One kind alone, by expected gain in alignment."""

    def values(asking: Asking, samples: Tensor, left: Tensor) -> Tensor:
        found = by(alignment_gain, True)(asking, samples, left)
        others = [place for place, kind in enumerate(asking.kinds) if kind.label != label]
        return found.index_fill(1, torch.tensor(others), -math.inf)

    return values


def two_ahead(asking: Asking, samples: Tensor, left: Tensor) -> Tensor:
    """The rate of a question and the best after it together, of the best by gain a second."""
    greedy = by(alignment_gain, True)(asking, samples, left)
    seconds = greedy.new_tensor([kind.seconds for kind in asking.kinds])
    values = torch.full_like(greedy, -math.inf)
    for s, belief in enumerate(samples):
        looks = _looks(asking, belief, greedy[s])
        allowed = greedy[s].masked_fill((seconds > left[s])[:, None], -math.inf)
        for index in allowed.flatten().topk(FIRST).indices.tolist():
            place, query = divmod(index, greedy.shape[-1])
            rate = _rate(asking, looks, belief, place, query, left[s], allowed.max())
            values[s, place, query] = rate
    return values


def _looks(asking: Asking, belief: Tensor, greedy: Tensor) -> list[Ahead]:
    """Of each kind the questions that may come next but one."""
    looks = []
    for kind, value in zip(asking.kinds, greedy, strict=True):
        best = value.topk(min(THEN, len(value))).indices
        queries = asking.features[best, : kind.options].unsqueeze(0)
        probs = predict_answers(belief.unsqueeze(0), queries, kind.model).probs[0]
        looks.append(Ahead(probs, belief, torch.ones(len(best), dtype=torch.bool)))
    return looks


def _rate(
    asking: Asking,
    looks: list[Ahead],
    belief: Tensor,
    place: int,
    query: int,
    left: Tensor,
    usual: Tensor,
) -> float:
    """Expected gain of a question and of the one after it, over the seconds that both take.

    After each answer the next question is the one that gains most beyond what its seconds are
    usually worth: so the quotient of both means is greatest (Dinkelbach, 1967), but for one step.
    Where there is no time for another question the first one counts alone.
    """
    kind = asking.kinds[place]
    shown = asking.features[None, query, : kind.options].unsqueeze(0)
    joint = predict_answers(belief.unsqueeze(0), shown, kind.model).probs[0, 0].mT / len(belief)
    share = joint.sum(-1)  # (R)
    weights = joint / share.clamp(min=1e-30).unsqueeze(-1)
    # Squared lengths are about the mean of the belief, as those of ``Ahead`` are.
    reached = (weights @ (belief - belief.mean(0))).square().sum(-1)
    best, gain, time = (torch.zeros_like(share) - math.inf for _ in range(3))
    for then, look in zip(asking.kinds, looks, strict=True):
        if kind.seconds + then.seconds <= left:
            more = look.values(weights, 1, 1).amax(-1) - reached
            beyond = more - usual * then.seconds
            better = beyond > best
            best = torch.where(better, beyond, best)
            gain = torch.where(better, more, gain)
            time = torch.where(better, then.seconds, time)
    first = (share * reached).sum()
    if best.isinf().any():
        return float(first / kind.seconds)
    return float((first + (share * gain).sum()) / (kind.seconds + (share * time).sum()))


RULES: dict[str, Rule] = {
    BASELINE: by(alignment_gain, True),
    "gain": by(alignment_gain, False),
    "information a second": by(information_gain, True),
    **{f"{label} only": only(label) for label in LABELS},
    AHEAD: two_ahead,
    FINE: by(alignment_gain, True),
}


def asked(
    asking: Asking, rule: Rule, samples: int, limit: float, omega: Tensor, seed: int
) -> Tensor:
    """Mean alignment over the seconds (S) of humans who are asked by a rule."""
    generator, fate = (Generator().manual_seed(seed + part) for part in range(2))
    belief = Belief(asking.kinds[0].model, samples)
    n_humans = len(omega)
    held = belief.prior(n_humans, omega.shape[-1], generator)
    ess = torch.full((n_humans,), float(samples))
    told = Evidence(*(torch.zeros(n_humans, 0, *size) for size in _sizes(omega.shape[-1])))
    left, area = torch.full((n_humans,), limit), torch.zeros(n_humans)
    seconds = left.new_tensor([kind.seconds for kind in asking.kinds])
    asks = torch.arange(n_humans)
    while len(asks := asks[left[asks] >= seconds.min()]):
        values = rule(asking, held[asks], left[asks])
        values = values.masked_fill((seconds > left[asks, None]).unsqueeze(-1), -math.inf)
        value, best = values.flatten(1).max(1)
        asks, best = asks[~value.isinf()], best[~value.isinf()]  # the others have no time left
        if not len(asks):
            break
        place, query = best // values.shape[-1], best % values.shape[-1]
        luck = torch.rand(n_humans, generator=fate)[asks]
        newest = _answered(asking, omega[asks], place, query, luck)
        area[asks] += seconds[place] * (held[asks] @ omega[asks, :, None]).mean((1, 2))
        left[asks] -= seconds[place]
        told = _with(told, asks, newest)
        update = belief.update(held[asks], ess[asks], told[asks], generator)
        held[asks], ess[asks] = update[0], update[1]
    return (area + left * (held @ omega.unsqueeze(-1)).mean((1, 2))) / limit


def _sizes(n_features: int) -> tuple[tuple[int, ...], ...]:
    """Of the fields of an answer's evidence, padded."""
    return (FACTORS, ROWS, n_features), (FACTORS, ROWS), ()


def _answered(
    asking: Asking, omega: Tensor, place: Tensor, query: Tensor, luck: Tensor
) -> Evidence:
    """What the answers (S) to these questions say, padded to one size."""
    fields = [torch.zeros(len(omega), *size) for size in _sizes(omega.shape[-1])]
    fields[1].fill_(torch.inf)
    for number, kind in enumerate(asking.kinds):
        some = (place == number).nonzero().squeeze(-1)
        options = asking.features[query[some], : kind.options]
        chances = kind.model((options @ omega[some].unsqueeze(-1)).squeeze(-1)).exp()
        answer = (chances.cumsum(-1) < luck[some, None]).sum(-1).clamp(max=chances.shape[-1] - 1)
        evidence = kind.model.evidence(options, answer)
        more = [FACTORS - evidence.rows.shape[1], ROWS - evidence.rows.shape[2]]
        fields[0][some] = F.pad(evidence.rows, (0, 0, 0, more[1], 0, more[0]))
        fields[1][some] = F.pad(evidence.offsets, (0, more[1], 0, more[0]), value=torch.inf)
    return Evidence(*fields)


def _with(told: Evidence, asks: Tensor, newest: Evidence) -> Evidence:
    """One more answer of these sessions, and none of the others."""
    fields = []
    for name, empty in (("rows", 0.0), ("offsets", torch.inf), ("floor", 0.0)):
        before, now = getattr(told, name), getattr(newest, name)
        more = before.new_full((len(before), 1, *before.shape[2:]), empty)
        more[asks, 0] = now
        fields.append(torch.cat([before, more], 1))
    return Evidence(*fields)


def asking_in(corner: Corner, number: int) -> Asking:
    """A pool of a corner, and what may be asked of it."""
    of_four = room.Corner(corner.dimension, corner.skew, 4, size=300, accuracy=corner.accuracy)
    features = room.normalised(of_four, number).features
    tau = room.model_for(of_four, QueryPool(features[:, :2])).scale
    kinds = [
        Kind(
            kind.label,
            Boltzmann(tau, QUESTIONS[kind.name]()),
            kind.options,
            answers.seconds(kind, corner.watch, corner.decide),
        )
        for kind in answers.KINDS
        if kind.label in LABELS
    ]
    return Asking(features, kinds)


def main() -> None:
    """Print the table."""
    parser = room.arguments(__doc__, humans=100)
    typed = common.start(parser)
    room.check_pools(parser, typed.pools)
    rows = []
    for name in tqdm(room.chosen(parser, typed, CORNERS), desc="corners"):
        corner, found = replace(Corner(), **CORNERS[name]), room.Found(baseline=BASELINE)
        for number in tqdm(range(typed.pools), desc="pools", leave=False):
            asking = asking_in(corner, number)
            seed = room.OF_HUMANS + 3 * number  # of who is asked, the belief's luck, and theirs
            humans = Generator().manual_seed(seed)
            omega = uniform_sphere((typed.humans, corner.dimension), humans)
            for each, rule in RULES.items():
                count = 400 if each == FINE else 100
                mean = asked(asking, rule, count, corner.limit, omega, seed + 1)
                found.curves.setdefault(each, []).append(mean.unsqueeze(1))
        rows.append(room.row_of(name, found, [AHEAD, *(each for each in RULES if each != AHEAD)]))
    title = f"Mean alignment over all seconds: {BASELINE}, and what others are more"
    common.report(title, rows, typed.json)


if __name__ == "__main__":
    main()
