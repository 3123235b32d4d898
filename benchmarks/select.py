"""CPU seconds to choose the best of N queries by information gain, ours beside others'.

``python benchmarks/select.py``. "APReL's way" is a NumPy loop with one logsumexp per query and
sample; APReL itself is timed where it is importable (see ``peers.py``), BoTorch's PairwiseGP where
it is installed (``pip install -e ".[bench]"``). All of the first four choose the same query.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import importlib.util
import warnings
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks import common, peers
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.questions.responses import Boltzmann

BATCH = 100
"""Sessions of the batched case."""


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--queries", type=int, default=1000, help="N (default 1000)")
    parser.add_argument("--samples", type=int, default=100, help="M (default 100)")
    options = common.start(parser)
    pool = common.normalised_pool(options.queries).features
    samples = common.belief_samples(BATCH, options.samples)
    omega, queries = samples[0].double().numpy(), pool.double().numpy()

    cases: dict[str, Callable[[], int | Tensor]] = {}
    work = dict.fromkeys(("vectorised NumPy", "ours, B=1"), 1)
    cases["vectorised NumPy"] = lambda: peers.choose_by_numpy(omega, queries, common.TAU)
    for device in common.devices():
        mark = "" if device == "cpu" else f", {device}"
        for size in (1, BATCH):
            cases[f"ours, B={size}{mark}"] = _ours(samples[:size].to(device), pool.to(device))
            work[f"ours, B={size}{mark}"] = size
    if importlib.util.find_spec("botorch") is not None:
        cases["BoTorch PairwiseGP, EUBO"] = _botorch(pool)
    seconds = common.paired(cases, options.repeats)

    slow: dict[str, Callable[[], int]] = {
        "APReL's way (NumPy loop)": lambda: peers.choose_by_loop(omega, queries, common.TAU)
    }
    aprel = peers.import_aprel()
    if aprel is not None:
        belief = peers.aprel_belief(aprel, queries[:1], np.zeros(1), common.TAU)
        belief.samples = [{"weights": row, "beta": common.TAU} for row in omega]
        asked = peers.aprel_queries(aprel, queries)
        slow["APReL"] = peers.choose_by_aprel(aprel, belief, asked)
    chosen = {name: case() for name, case in (slow | cases).items()}  # also their warm-up
    expected = chosen["APReL's way (NumPy loop)"]
    for name in ("vectorised NumPy", "ours, B=1", *(["APReL"] if aprel is not None else [])):
        assert int(chosen[name]) == expected, f"{name} chose another query"
    seconds |= common.paired(slow, 1)

    base = seconds["APReL's way (NumPy loop)"]
    rows = [
        {
            "case": name,
            "sessions": work.get(name, 1),
            "CPU ms a choice": 1000 * (each := time / work.get(name, 1)),
            "times less than APReL's way": base / each,
        }
        for name, time in sorted(seconds.items(), key=lambda item: -item[1] / work.get(item[0], 1))
    ]
    title = f"Choose one of N={options.queries} queries, M={options.samples} samples, K=2, D=4"
    common.report(title, rows, options.json)


def _ours(samples: Tensor, pool: Tensor) -> Callable[[], Tensor]:
    """Our choice for every session of samples (B M D) from one pool (N K D)."""
    queries, model = pool.expand(len(samples), *pool.shape), Boltzmann(common.TAU)
    return lambda: score_queries(samples, queries, model, information_gain).argmax(-1)


def _botorch(pool: Tensor) -> Callable[[], Tensor]:
    """BoTorch's choice: a Gaussian process fitted to 10 answers, EUBO over the pool.

    The fit is done beforehand and is not timed. It is another model and another criterion: the row
    says what a user of BoTorch waits for.
    """
    from botorch.acquisition.preference import AnalyticExpectedUtilityOfBestOption
    from botorch.models import PairwiseGP

    warnings.simplefilter("ignore")
    points = pool[:10].flatten(0, 1).double()
    comparisons = torch.arange(20).view(10, 2)
    acquisition = AnalyticExpectedUtilityOfBestOption(PairwiseGP(points, comparisons))
    pairs = pool.double()

    def choose() -> Tensor:
        with torch.no_grad():
            return acquisition(pairs).argmax()

    return choose


if __name__ == "__main__":
    main()
