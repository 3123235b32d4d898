"""What the parts of a session cost, beside an earlier version of this package.

``python benchmarks/versions.py 672a7d5`` (version 0.1.0; any commit). Each version is measured in
processes of its own, in turn; the least CPU time of all repetitions counts, as whatever else the
machine does only adds to it.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

PAPER: dict[str, Any] = {"objective": "information_gain"}
"""What environments of version 0.1.0 were rewarded for by default."""

MEASURE = "--measure"
"""First argument of a process that measures the version in its working directory."""

# Not this folder, whose select.py hides Python's.
sys.path[0] = os.getcwd() if MEASURE in sys.argv else str(Path(__file__).resolve().parents[1])

import inspect
import json
import subprocess
import tempfile
import time
from collections.abc import Callable

from benchmarks import common


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("earlier", help="the commit of the earlier version")
    options = common.start(parser)
    now = Path(sys.path[0])
    with tempfile.TemporaryDirectory() as scratch:
        git = ["git", "-C", str(now), "archive", options.earlier]
        archive = subprocess.run(git, capture_output=True, check=False)
        if archive.returncode != 0:
            parser.error(f"{options.earlier}: {archive.stderr.decode().strip()}")
        subprocess.run(["tar", "-x", "-C", scratch], input=archive.stdout, check=True)
        least = measured({"earlier": Path(scratch), "now": now}, max(1, options.repeats // 3))
    rows: list[common.Row] = [
        {
            "CPU ms": name,
            "earlier": 1000 * least["earlier"][name],
            "now": 1000 * seconds,
            "now / earlier": seconds / least["earlier"][name],
        }
        for name, seconds in least["now"].items()
    ]
    title = f"Beside commit {options.earlier}, in turn, D = 4, K = 2, M = 100"
    common.report(title, rows, options.json)


def measured(folders: dict[str, Path], repeats: int) -> dict[str, dict[str, float]]:
    """The least CPU seconds of each part, by version."""
    least: dict[str, dict[str, float]] = {version: {} for version in folders}
    for _ in range(repeats):
        for version, folder in folders.items():
            for name, seconds in measured_in(folder).items():
                before = least[version].get(name, seconds)
                least[version][name] = min(before, seconds)
    return least


def measured_in(folder: Path) -> dict[str, float]:
    """What :func:`measure` finds in a process that imports the package from a folder."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), MEASURE]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)
    if done.returncode != 0:
        sys.exit(f"{folder}: cannot be measured\n{done.stderr}")
    found: dict[str, float] = json.loads(done.stdout)
    return found


def updater_of(belief: Any) -> Callable[..., Any]:
    """The update by gaps of earlier answers (S H 1 D) and of the newest (S 1 D)."""
    if "earlier" in inspect.signature(belief.update).parameters:  # version 0.1.0
        return lambda samples, ess, *rest: belief.update(samples, ess, *rest)[:2]
    import torch

    from torchrl_pref.questions.choice import evidence_of_gaps

    def update(samples: Any, ess: Any, gaps: Any, newest: Any, generator: Any) -> Any:
        evidence = evidence_of_gaps(torch.cat([gaps, newest[:, None]], 1))
        return belief.update(samples, ess, evidence, generator)[:2]

    return update


def measure() -> dict[str, float]:
    """CPU seconds of each part, with names that both versions know."""
    import torch

    from torchrl_pref import (
        Belief,
        Boltzmann,
        FeedEnv,
        Normalizer,
        Optimal,
        QueryEnv,
        ResponseModel,
        SimulatedHuman,
        gridworld_pool,
    )
    from torchrl_pref.strategies import Greedy

    torch.set_num_threads(1)
    pool = gridworld_pool()
    pool = pool.map_features(Normalizer.fit(pool.features))

    def updates(model: ResponseModel, sessions: int, seed: int) -> float:
        """CPU seconds of an update of one session, over 20 answers to random questions."""
        generator, belief = torch.Generator().manual_seed(seed), Belief(model)
        omega = torch.randn(sessions, 4, 1, generator=generator)
        omega /= omega.norm(dim=1, keepdim=True)
        samples, ess = belief.prior(sessions, 4, generator), torch.full((sessions,), 100.0)
        gaps, seconds = torch.zeros(sessions, 0, 1, 4), 0.0
        update = updater_of(belief)
        for _ in range(20):
            asked = pool.features[torch.randint(1000, (sessions,), generator=generator)]
            likely = model((asked @ omega).squeeze(-1)).exp()
            second = likely.multinomial(1, generator=generator).squeeze(-1) == 1
            newest = torch.where(second[:, None], -1.0, 1.0) * (asked[:, 0] - asked[:, 1])
            newest = newest.unsqueeze(1)
            start = time.process_time()
            samples, ess = update(samples, ess, gaps, newest, generator)
            seconds += time.process_time() - start
            gaps = torch.cat([gaps, newest[:, None]], 1)
        return seconds / 20 / sessions

    def greedily(model: ResponseModel, sessions: int, seed: int) -> float:
        """CPU seconds of a step of one session, by the greedy strategy."""
        human, belief = SimulatedHuman(model), Belief(model)
        env = QueryEnv(pool, human, belief, batch_size=(sessions,), seed=seed, **PAPER)
        start = time.process_time()
        with torch.no_grad():
            taken = env.rollout(20, Greedy(model))
        return (time.process_time() - start) / taken.numel()

    def steps(kind: type[QueryEnv] | type[FeedEnv], action: int, seed: int) -> float:
        """CPU seconds of a step of one session that takes the same action again and again."""
        model, seconds = Boltzmann(4.5), 0.0
        usual = PAPER if kind is QueryEnv else {**PAPER, "skip": "regret"}
        env = kind(pool, SimulatedHuman(model), Belief(model), batch_size=(1,), seed=seed, **usual)
        session = env.reset()
        for _ in range(20):
            session["action"] = torch.tensor([action])
            start = time.process_time()
            session = env.step(session)["next"]
            seconds += time.process_time() - start
        return seconds / 20

    cases: dict[str, Callable[[int], float]] = {}
    for human, model in (("tau 4.5", Boltzmann(4.5)), ("optimal", Optimal())):
        for count in (1, 200):

            def update(seed: int, model: ResponseModel = model, count: int = count) -> float:
                return updates(model, count, seed)

            def greedy(seed: int, model: ResponseModel = model, count: int = count) -> float:
                return greedily(model, count, seed)

            cases[f"update, {human}, {count} sessions"] = update
            cases[f"greedy step, {human}, {count} sessions"] = greedy
    cases["asking step, QueryEnv, 1 session"] = lambda seed: steps(QueryEnv, 100, seed)
    cases["asking step, FeedEnv, 1 session"] = lambda seed: steps(FeedEnv, 1, seed)
    cases["skipping step, FeedEnv, 1 session"] = lambda seed: steps(FeedEnv, 0, seed)
    return {name: min(case(seed) for seed in range(4)) for name, case in cases.items()}


if __name__ == "__main__":
    if sys.argv[1:] == [MEASURE]:
        print(json.dumps(measure()))
    else:
        main()
