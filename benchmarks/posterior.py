"""The belief against an independent reference, over features, options, noise and odd histories.

``python benchmarks/posterior.py [--sessions 200] [--features 2,4,6,8,16] [--csv FILE]``. In each
case many beliefs get the same answers, and their samples are held against the posterior by
importance sampling or by a walk (``tests/posterior.py``, which shares no code with the package).
*Bias* is the distance of the mean over all samples from the posterior mean, in posterior standard
deviations; *variance* is that of all samples about the posterior mean over that of the posterior.
Cases beyond a bound (.02 either way) get four times the sessions, as chance can put one there.

With ``--drawn N`` so many cases are drawn at random (``--seed``) instead, and those beyond the
bound are all that is told: other numbers of features and options, other ``tau``, other humans, and
in half of them one history after another.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import csv
import math
import random
import statistics
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from tqdm import tqdm

from benchmarks import common
from benchmarks.common import told
from tests.posterior import Posterior, posterior
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.questions.responses import Boltzmann, Optimal

BOUND = 0.02

TITLES = {
    "random": "random",
    "greedy": "greedy",
    "surprising": "each answer the least likely",
    "contradictory": "one question answered otherwise",
    "60 answers": "60 answers",
    "gaps of 1e-4": "gaps of 10⁻⁴",
    "gaps of 1e3": "gaps of 10³",
    "collinear": "nearly collinear",
}
KINDS = tuple(TITLES)
"""Of histories: questions and answers drawn as a human would give them; questions of highest
information gain; each answer the least likely one; one question asked again and answered otherwise;
many answers; tiny and huge features; features that nearly follow from each other."""

THEN = ", then "
"""Between the kinds of a case whose history is of several, each of a human of its own."""


class Case(NamedTuple):
    """What a belief is asked to get right."""

    features: int
    options: int
    tau: float | None
    kind: str
    seed: int = 0

    @property
    def model(self) -> ResponseModel:
        """Of the human and of the belief."""
        return Optimal() if self.tau is None else Boltzmann(self.tau)


class Measured(NamedTuple):
    """How the samples of many beliefs differ from the posterior, with standard errors."""

    sessions: int
    bias: float
    bias_error: float
    variance: float
    variance_error: float
    effective: float
    reported: float
    milliseconds: float


def main() -> None:
    """Print the table of the worst cases, and every case beyond a bound."""
    parser = common.arguments(__doc__)
    parser.add_argument("--sessions", type=int, default=200, help="beliefs a case (default 200)")
    parser.add_argument("--samples", type=int, default=100, help="M of each (default 100)")
    parser.add_argument("--features", default="2,4,6,8,16", help="numbers of features D")
    parser.add_argument("--options", default="2,3,5", help="numbers of options K")
    parser.add_argument("--drawn", type=int, help="instead, so many cases drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default 0)")
    parser.add_argument("--csv", type=Path, help="also write every case to this file")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    options = common.start(parser)
    sizes = [int(size) for size in options.features.split(",")]
    options_of = [int(number) for number in options.options.split(",")]
    cases = [Case(*case) for case in product(sizes, options_of, (0.5, 4.5, 30.0, None), KINDS)]
    if options.drawn is not None:
        cases = drawn(options.drawn, random.Random(options.seed))
    with ProcessPoolExecutor(options.workers, get_context("spawn"), common.one_thread) as executor:
        jobs = executor.map(
            partial(measure, sessions=options.sessions, n_samples=options.samples), cases
        )
        done = zip(cases, tqdm(jobs, total=len(cases), unit="case"), strict=True)
        results = dict(done if options.csv is None else _written(done, options.csv))
    if options.drawn is None:
        title = f"Worst of {len(results)} cases, standard errors in brackets"
        common.report(title, list(_worst(results)), options.json)
    beyond = list(_beyond(results))
    title = f"{len(beyond)} of {len(results)} cases beyond {BOUND}, standard errors in brackets"
    common.report(title, beyond, common.second(options.json, "beyond"))


def _written(done: Iterable[tuple[Case, Measured]], path: Path) -> Iterator[tuple[Case, Measured]]:
    """Each result, in the file as soon as it is there: all of them take an hour."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*Case._fields, *Measured._fields])
        for case, measured in done:
            tau = "optimal" if case.tau is None else case.tau
            numbers = [f"{number:.4g}" for number in measured]
            writer.writerow([*case[:2], tau, *case[3:], *numbers])
            file.flush()
            yield case, measured


def _worst(results: dict[Case, Measured]) -> Iterator[common.Row]:
    """A row for each kind of history: the worst of all cases, with standard errors in brackets."""
    sizes = sorted({case.features for case in results})
    for kind in KINDS:
        some = {case: m for case, m in results.items() if case.kind == kind}
        biased = max(some.values(), key=lambda m: m.bias)
        narrow, *_, wide = sorted(some.values(), key=lambda m: m.variance)
        times = [
            f"{statistics.mean(m.milliseconds for c, m in some.items() if c.features == size):.1f}"
            for size in sizes
        ]
        yield {
            "history": TITLES[kind],
            "bias": f"{biased.bias:.3f} ({biased.bias_error:.3f})",
            "variance, least": f"{narrow.variance:.3f} ({narrow.variance_error:.3f})",
            "variance, largest": f"{wide.variance:.3f} ({wide.variance_error:.3f})",
            "least effective size": round(min(m.effective for m in some.values())),
            f"ms an update, D = {' / '.join(map(str, sizes))}": " / ".join(times),
        }


def _beyond(results: dict[Case, Measured]) -> Iterator[common.Row]:
    """A row for each case that is beyond the bound."""
    for case, m in results.items():
        if _is_beyond(m):
            yield {
                "D": case.features,
                "K": case.options,
                "tau": "optimal" if case.tau is None else case.tau,
                "history": THEN.join(TITLES[kind] for kind in case.kind.split(THEN)),
                **({"seed": case.seed} if case.seed else {}),
                "bias": f"{m.bias:.3f} ({m.bias_error:.3f})",
                "variance": f"{m.variance:.3f} ({m.variance_error:.3f})",
                "effective size": round(m.effective),
                "reported": round(m.reported),
            }


def _is_beyond(measured: Measured) -> bool:
    return measured.bias > BOUND or abs(measured.variance - 1) > BOUND


def drawn(count: int, luck: random.Random) -> list[Case]:
    """Cases drawn at random."""
    cases = []
    for _ in range(count):
        tau = luck.choice((0.2, 1.0, 4.5, 12.0, 100.0, None))
        kind = luck.choice(KINDS)
        # Two humans who never err are one who contradicts themselves: nobody is left.
        if tau is not None and luck.random() < 0.5:
            kind += THEN + luck.choice([each for each in KINDS if each != "60 answers"])
        features, options = luck.choice((2, 3, 5, 7, 10, 12)), luck.choice((2, 3, 4, 6))
        cases.append(Case(features, options, tau, kind, luck.randrange(10**6)))
    return cases


def measure(case: Case, sessions: int, n_samples: int = 100) -> Measured:
    """One case; four times the sessions where the first ones are beyond a bound."""
    kinds = case.kind.split(THEN)
    parts = [history(case._replace(kind=each), case.seed + n) for n, each in enumerate(kinds)]
    gaps = torch.cat(parts)
    exact = posterior(gaps.double().numpy(), case.tau)
    measured = compare(case, gaps, exact, sessions, n_samples)
    if _is_beyond(measured):
        measured = compare(case, gaps, exact, 4 * sessions, n_samples)
    return measured


def compare(
    case: Case, gaps: Tensor, exact: Posterior, sessions: int, n_samples: int = 100
) -> Measured:
    """Beliefs that all get the answers with these gaps (H K-1 D), beside the posterior."""
    generator, belief = Generator().manual_seed(1), Belief(case.model, n_samples)
    samples = belief.prior(sessions, case.features, generator)
    ess = torch.full((sessions,), float(belief.n_samples))
    start = time.process_time()
    for h in range(len(gaps)):
        earlier, newest = gaps[:h].expand(sessions, -1, -1, -1), gaps[h].expand(sessions, -1, -1)
        samples, ess, _ = belief.update(samples, ess, told(earlier, newest), generator)
    seconds = time.process_time() - start
    mean, total = torch.from_numpy(exact.mean), float(exact.covariance.trace())
    means = samples.double().mean(1)
    spread = (samples.double() - mean).square().sum(-1).mean(1) / total
    bias = float((means.mean(0) - mean).norm()) / math.sqrt(total)
    noise = float(means.var(0).sum()) / sessions / total
    return Measured(
        sessions=sessions,
        bias=bias,
        bias_error=math.sqrt(noise + 1 / exact.draws),
        variance=float(spread.mean()),
        variance_error=math.sqrt(float(spread.var()) / sessions + exact.error**2),
        effective=total / float((means - mean).square().sum(-1).mean()),
        reported=float(1 / (1 / ess).mean()),
        milliseconds=1000 * seconds / sessions / max(1, len(gaps)),
    )


def history(case: Case, seed: int = 0) -> Tensor:
    """Feature gaps (H K-1 D) of a human's answers."""
    generator, model = Generator().manual_seed(seed), case.model
    omega = uniform_sphere((case.features,), generator)
    belief = Belief(model, 400)
    samples, ess = belief.prior(1, case.features, generator), torch.full((1,), 400.0)
    gaps = torch.zeros(1, 0, case.options - 1, case.features)
    mixing = _mixing(case, generator)
    query = torch.zeros(case.options, case.features)
    for h in range(60 if case.kind == "60 answers" else 8):
        pool = torch.randn(200, case.options, case.features, generator=generator) @ mixing
        if case.kind == "greedy":
            values = score_queries(samples, pool[None], model, information_gain)
            query = pool[int(values.argmax())]
        elif case.kind != "contradictory" or h % 4 == 0:
            query = pool[0]
        likely = model(samples[0] @ query.T).exp().mean(0)
        # What a human who never errs cannot answer is no answer.
        likely = torch.where(likely > 0.005, likely, torch.inf) if case.tau is None else likely
        answer = model(query @ omega).exp().multinomial(1, generator=generator)[0]
        if case.kind == "surprising":
            answer = likely.argmin()
        if case.kind == "contradictory":
            answer = torch.tensor(h % case.options)
            if likely[answer].isinf():
                continue
        newest = feature_gaps(query[None], answer[None])
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        gaps = torch.cat([gaps, newest[None]], 1)
    return gaps[0]


def _mixing(case: Case, generator: Generator) -> Tensor:
    """What turns independent standard normal features into those of the case, (D D)."""
    scale = {"gaps of 1e-4": 1e-4, "gaps of 1e3": 1e3}.get(case.kind, 1.0)
    if case.kind != "collinear":
        return scale * torch.eye(case.features)
    common_part = torch.randn(case.features, 1, generator=generator)
    shown = torch.randn(1, case.features, generator=generator)
    noise = torch.randn(case.features, case.features, generator=generator)
    return common_part @ shown + 0.01 * noise


if __name__ == "__main__":
    main()
