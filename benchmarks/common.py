"""What the benchmarks share: paired timings, one table, JSON.

Each benchmark is one command, ``python benchmarks/<name>.py [--json FILE]``. Cases that are
compared take turns within one run, on one torch thread, and the median of each counts: a machine
that slows down slows all of them.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tabulate import tabulate
from torch import Generator, Tensor

from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.compiled import share_out
from torchrl_pref.pool import Normalizer, QueryPool
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.choice import evidence_of_gaps, feature_gaps
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tasks.gridworld import gridworld_pool

TAU = 4.5
"""About what ``tau=noisy`` solves to on the default pool."""

Row = dict[str, Any]


def arguments(description: str | None) -> argparse.ArgumentParser:
    """A parser with what every benchmark takes."""
    parser = argparse.ArgumentParser(description=(description or "").strip().split("\n")[0])
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    parser.add_argument("--repeats", type=int, default=9, help="timings of each case (default 9)")
    return parser


def start(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Read the command line, and take one thread."""
    one_thread()
    return parser.parse_args()


def one_thread() -> None:
    """Torch and the compiled loops take one thread in this process."""
    torch.set_num_threads(1)
    share_out(1)


class Followed(NamedTuple):
    """Many beliefs after each answer of one human."""

    measured: list[float]
    """Effective sample size of their means, from how much these differ."""
    reported: list[float]
    """What the beliefs report of themselves."""
    seconds: float
    """CPU time of all updates of all beliefs."""
    alignment: float
    """Of the samples with the human, in the end."""


def follow(
    model: ResponseModel,
    n_features: int,
    n_beliefs: int,
    questions: Iterable[Callable[[Tensor, Generator], Tensor]],
) -> Followed:
    """Ask one human question after question, and tell many beliefs.

    Args:
        model: of the human and of the beliefs.
        n_features: D.
        n_beliefs: how many.
        questions: each makes, from the samples of the first belief (1 M D) and a generator, the
            options (K D) that are asked about.
    """
    generator, belief = Generator().manual_seed(0), Belief(model)
    omega = uniform_sphere((n_features,), generator)
    samples = belief.prior(n_beliefs, n_features, generator)
    ess = torch.full((n_beliefs,), float(belief.n_samples))
    gaps = torch.zeros(n_beliefs, 0, 1, n_features)
    measured, reported, seconds = [], [], 0.0
    for question in questions:
        query = question(samples[:1], generator)
        answer = model(query @ omega).exp().multinomial(1, generator=generator)
        newest = feature_gaps(query[None], answer).expand(n_beliefs, -1, -1)
        start = time.process_time()
        samples, ess, _ = belief.update(samples, ess, told(gaps, newest), generator)
        seconds += time.process_time() - start
        gaps = torch.cat([gaps, newest.unsqueeze(1)], 1)
        variance = samples.double().flatten(0, 1).var(0).sum()
        measured.append(float(variance / samples.double().mean(1).var(0).sum()))
        reported.append(float(1 / (1 / ess).mean()))
    return Followed(measured, reported, seconds, float((samples @ omega).mean()))


def devices() -> list[str]:
    """The CPU, and a GPU where one is present."""
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def paired(cases: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median CPU seconds of each case; the cases take turns, after one warm-up each.

    On a GPU the work is waited for and wall time counts; give such cases a name with "cuda" in it.
    """
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for case in cases.values():
        case()
    for _ in range(repeats):
        for name, case in cases.items():
            seconds[name].append(_time(case, "cuda" in name))
    return {name: statistics.median(times) for name, times in seconds.items()}


def _time(case: Callable[[], Any], on_gpu: bool) -> float:
    """Seconds of one call."""
    if not on_gpu:
        start = time.process_time()
        case()
        return time.process_time() - start
    torch.cuda.synchronize()
    start = time.perf_counter()
    case()
    torch.cuda.synchronize()
    return time.perf_counter() - start


def report(title: str, rows: Sequence[Row], json_path: Path | None) -> None:
    """Print one table, and write it as JSON where asked."""
    machine = f"{platform.machine()}, torch {torch.__version__}, one thread"
    print(f"\n{title}\n{machine}\n")
    print(tabulate(rows, headers="keys", floatfmt=".4g"))
    if json_path is not None:
        content = {"title": title, "machine": machine, "rows": list(rows)}
        json_path.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten to {json_path}")


def second(json_path: Path | None, name: str) -> Path | None:
    """Where a benchmark's second table goes: beside its first one, with a name of its own."""
    return None if json_path is None else json_path.with_stem(f"{json_path.stem}-{name}")


def normalised_pool(n_queries: int = 1000) -> QueryPool:
    """The default Gridworld pool, normalised."""
    pool = gridworld_pool(n_queries)
    return pool.map_features(Normalizer.fit(pool.features))


def belief_samples(n_sessions: int, n_samples: int = 100, n_features: int = 4) -> torch.Tensor:
    """Samples (S M D) of the prior."""
    shape = (n_sessions, n_samples, n_features)
    return uniform_sphere(shape, torch.Generator().manual_seed(0))


def told(earlier: Tensor, newest: Tensor) -> Evidence:
    """The evidence of choices with feature gaps (S H K-1 D), and then one more (S K-1 D)."""
    return evidence_of_gaps(torch.cat([earlier, newest.unsqueeze(1)], 1))


def copy_to(folder: Path) -> list[Path]:
    """Copy the tracked files, as they are in the working tree, and the machine code of those that
    Numba compiled: it is valid for as long as a file has its size and time.

    Returns:
        The tracked files that are there, as from the root.
    """
    root = Path(__file__).resolve().parents[1]
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True)
    names = [Path(name) for name in listed.stdout.decode().split("\0") if name]
    tracked = [name for name in names if (root / name).is_file()]
    compiled = [path.relative_to(root) for path in root.glob("torchrl_pref/**/__pycache__/*.nb?")]
    for name in (*tracked, *compiled):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(root / name, folder / name)
    return tracked
