"""How CPU time and peak memory grow with the size of each input, for choosing a query and updating.

``python benchmarks/scale.py [--json FILE] [--plot FILE] [--repeats N]``: one table, one plot. Every
size is varied in turn with the others at a default, given in each row. A slope is that of log time
against log size over a sweep's last three points, where fixed costs weigh least; 1 is linear.

Letters: B sessions, M belief samples, N queries, K options, D features, H earlier answers.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import ctypes
import math
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import matplotlib
import torch
from torch import Generator

from benchmarks.common import (
    TAU,
    Row,
    arguments,
    belief_samples,
    devices,
    paired,
    report,
    start,
    told,
)
from torchrl_pref.acquisition.functions import information_gain
from torchrl_pref.acquisition.scoring import score_queries
from torchrl_pref.beliefs.sampled import Belief, uniform_sphere
from torchrl_pref.questions.choice import feature_gaps
from torchrl_pref.questions.responses import Boltzmann

matplotlib.use("Agg")
from matplotlib import pyplot as plt


class Point(NamedTuple):
    """The sizes of one call. Choosing a query has no H, updating a belief no N."""

    N: int | None = None
    M: int = 100
    B: int = 1
    D: int = 4
    K: int = 2
    H: int | None = None


CHOOSE = Point(N=1000)
FEW = Point(N=10)
"""Candidates of a session where B is varied, so that 10⁵ sessions stay feasible."""
UPDATE = Point(B=100, H=10)
"""A hundred sessions: an update of one is nearly all overhead, whatever the other sizes are."""

SWEEPS: list[tuple[Point, str, Sequence[int]]] = [
    (CHOOSE, "N", (1000, 10_000, 100_000, 1_000_000)),
    (CHOOSE, "M", (100, 300, 1000, 3000, 10_000)),
    (FEW, "B", (1, 10, 100, 1000, 10_000, 100_000)),
    (CHOOSE, "D", (2, 4, 8, 16, 32, 64)),
    (CHOOSE, "K", (2, 3, 4, 6, 8, 10)),
    (UPDATE, "M", (100, 300, 1000, 3000, 10_000)),
    (UPDATE, "B", (1, 10, 100, 1000, 10_000, 100_000)),
    (UPDATE, "D", (2, 4, 8, 16, 32, 64)),
    (UPDATE, "K", (2, 3, 4, 6, 8, 10)),
    (UPDATE, "H", (1, 2, 5, 10, 20, 40)),
]
LIMIT = 20.0
"""Seconds of one call: a point that would take longer is left out."""
MODEL = Boltzmann(TAU)


def prepare(point: Point, device: str = "cpu") -> Callable[[], Any]:
    """The call to be measured, with its inputs made.

    The features of the pool (N K D) are standard normal, as normalised ones would be; all sessions
    share its memory.
    """
    if point.N is None:
        return _prepare_update(point, device)
    samples = belief_samples(point.B, point.M, point.D).to(device)
    pool = torch.randn((point.N, point.K, point.D), generator=Generator().manual_seed(1)).to(device)
    queries = pool.expand(point.B, *pool.shape)
    return lambda: score_queries(samples, queries, MODEL, information_gain).argmax(1)


def _prepare_update(point: Point, device: str) -> Callable[[], Any]:
    """An update of beliefs that have had H answers of simulated humans to random queries.

    The cost depends on where the samples are, so they must be of the posterior. To have them at
    little cost, at most 100 sessions of 100 samples are brought there; copies of them fill B and M.
    """
    assert point.H is not None
    n_sessions, n_samples, n_answers = min(point.B, 100), min(point.M, 100), point.H + 1
    generator = Generator().manual_seed(0)
    human = uniform_sphere((n_sessions, 1, point.D), generator)
    queries = torch.randn((n_sessions, n_answers, point.K, point.D), generator=generator)
    probs = MODEL((queries * human.unsqueeze(1)).sum(-1)).exp()  # (B H+1 K)
    answers = torch.multinomial(probs.flatten(0, 1), 1, generator=generator)
    gaps = feature_gaps(queries, answers.view(n_sessions, n_answers))  # (B H+1 K-1 D)
    belief = Belief(MODEL, n_samples)
    samples = belief.prior(n_sessions, point.D, generator)
    ess = torch.full((n_sessions,), float(n_samples))
    for j in range(point.H):
        samples, ess, _ = belief.update(samples, ess, told(gaps[:, :j], gaps[:, j]), generator)

    rows, columns = torch.arange(point.B) % n_sessions, torch.arange(point.M) % n_samples
    samples, gaps = samples[rows][:, columns].to(device), gaps[rows].to(device)
    ess = (ess[rows] * point.M / n_samples).to(device)
    source, whole = Generator(device).manual_seed(2), Belief(MODEL, point.M)
    return lambda: whole.update(samples, ess, told(gaps[:, :-1], gaps[:, -1]), source)


def resident(field: str) -> float:
    """MiB of this process: VmRSS now, VmHWM at the highest. NaN where there is no /proc."""
    path = Path("/proc/self/status")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith(field)), math.nan)


def measure(point: Point, repeats: int) -> Row:
    """CPU seconds and peak memory of a call, in a process that runs nothing else.

    The memory is that of the first call: the highest resident set during it less what was resident
    just before it, when the inputs had been made. "In all" has the inputs too, not yet the imports.
    """
    torch.set_num_threads(1)
    at_start = resident("VmRSS")
    # A small call first, or the libraries that torch loads on demand would count.
    prepare(point._replace(N=point.N and 10, B=1, M=10))()
    call = prepare(point)
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)  # what is freed yet resident: the call could hide in it
        Path("/proc/self/clear_refs").write_text("5")  # the highest so far becomes the present
    before, begin = resident("VmRSS"), time.process_time()
    call()
    seconds, peak = time.process_time() - begin, resident("VmHWM")
    if seconds < LIMIT / 4:
        repeats = max(1, min(repeats, int(2 / seconds)))  # about two seconds for each point
        seconds = paired({"cpu": call}, repeats)["cpu"]
    return {"CPU s": seconds, "call MiB": peak - before, "in all MiB": peak - at_start}


def run(default: Point, letter: str, sizes: Sequence[int], repeats: int) -> list[Row]:
    """One row for each point of a sweep that is within the limit; the last has the slope."""
    name = "update" if default.N is None else "choose"
    loaded = resident("VmRSS")
    rows: list[Row] = []
    for size in sizes:
        if rows and rows[-1]["CPU s"] * size / rows[-1][letter] > LIMIT:
            print(f"{name}, {letter} = {size:,}: left out, as it would take over {LIMIT:g} s")
            break
        point = default._replace(**{letter: size})
        # Forked from this process, which computes nothing: fresh, without seconds of imports.
        with ProcessPoolExecutor(1, get_context("fork")) as pool:
            measured = pool.submit(measure, point, repeats).result()
        measured["in all MiB"] += loaded
        rows.append({"call": name, "varied": letter, **point._asdict(), **measured, "slope": None})
    # Least squares.
    x, y = ([math.log(row[key]) for row in rows[-3:]] for key in (letter, "CPU s"))
    rows[-1]["slope"] = statistics.linear_regression(x, y).slope
    return rows


def draw(rows: Sequence[Row], path: Path) -> None:
    """Time above and memory below, choosing on the left and updating on the right."""
    figure, axes = plt.subplots(
        2, 2, figsize=(11, 9), sharex="col", sharey="row", layout="constrained"
    )
    titles = {
        "choose": f"choosing a query\nN = {CHOOSE.N} ({FEW.N} for B), M = 100, B = 1, D = 4, K = 2",
        "update": f"updating the belief\nM = 100, B = {UPDATE.B}, D = 4, K = 2, H = {UPDATE.H}",
    }
    names = ("queries", "samples", "sessions", "features", "options", "answers")
    for column, (call, title) in zip(axes.T, titles.items(), strict=True):
        for i, (letter, name) in enumerate(zip(Point._fields, names, strict=True)):
            own = [row for row in rows if (row["call"], row["varied"]) == (call, letter)]
            for axis, key in zip(column, ("CPU s", "call MiB"), strict=True):
                if own:
                    x, y = ([row[field] for row in own] for field in (letter, key))
                    label = f"{letter} {name}, slope {own[-1]['slope']:.2f}"
                    axis.plot(x, y, color=f"C{i}", marker="os^Dvp"[i], label=label)
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}  # above: it covers nothing
        column[0].legend(title=title, ncols=2, frameon=False, **place)
        column[1].set_xlabel("size of what is varied, the others as in the title")
    axes[0, 0].set_ylabel("CPU seconds, one thread")
    axes[1, 0].set_ylabel("peak memory of the call, MiB")
    for axis in axes.flat:
        axis.set(xscale="log", yscale="log")
        axis.grid(alpha=0.25)
    figure.savefig(path, dpi=150)
    print(f"plot written to {path}")


def main() -> None:
    """Measure, print, draw."""
    parser = arguments(__doc__)
    parser.add_argument("--plot", type=Path, default=Path("scale.png"), help="default scale.png")
    settings = start(parser)
    rows = [row for sweep in SWEEPS for row in run(*sweep, settings.repeats)]
    if "cuda" in devices():  # asked and used last: a process that has used a GPU must not fork
        for row in rows:
            call = prepare(Point(*(row[letter] for letter in Point._fields)), "cuda")
            row["GPU s"] = paired({"cuda": call}, settings.repeats)["cuda"]
    report("Growth with size (the pool has 10 queries where B is varied)", rows, settings.json)
    draw(rows, settings.plot)


if __name__ == "__main__":
    main()
