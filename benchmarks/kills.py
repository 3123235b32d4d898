"""Kill runs at random moments and start runs twice: is anything lost, is anything mixed?

Each kill is followed by what a user would do: type the command again, and where it is refused,
paste into a shell the line that the error names; after SIGTERM paste the line that was printed. The
run is then to end as one that nobody disturbed, bit for bit. Of two processes in one folder exactly
one is to proceed. The exit status is 1 where anything is otherwise.

Processes to be killed are forked from this one, which has imported everything, so that a kill is
not spent on an import.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[0] = str(ROOT)  # and not this folder, whose select.py would hide Python's own

import csv
import itertools
import json
import os
import random
import re
import runpy
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch

import torchrl_pref.evaluation.reports  # forked processes need not import these
import torchrl_pref.training.start  # noqa: F401
import train  # noqa: F401
from benchmarks import common
from torchrl_pref.checkpoints.checkpoint import Checkpoint
from torchrl_pref.training.progress import Progress

TINY = [
    *("belief.samples=10", "belief.moves=1", "pool.size=50", "setup.budget=3"),
    *("evaluation.humans=5", "training.updates=4", "training.sessions=4", "training.steps=6"),
    *("training.warm_up=1", "training.save_every=1"),
]

WORK = ("evaluation", "write")
"""Where a process can be told to kill itself, besides being killed at a random moment."""


@dataclass
class Ended:
    """How a process ended; a negative status is the signal that ended it."""

    status: int
    output: str
    errors: str


class Process:
    """``train.py`` in a forked process.

    Args:
        arguments: of ``train.py``.
        scratch: where what it prints goes.
        cwd: the folder that it runs in.
        trap: called in the new process before anything else.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        scratch: Path,
        cwd: Path = ROOT,
        trap: Callable[[], None] = lambda: None,
    ) -> None:
        self.printed = [Path(tempfile.mkstemp(dir=scratch)[1]) for _ in range(2)]
        self.pid = os.fork()
        if self.pid == 0:
            self._run(arguments, cwd, trap)

    def _run(self, arguments: Sequence[str], cwd: Path, trap: Callable[[], None]) -> None:
        status = 1
        try:
            for path, stream in zip(self.printed, (1, 2), strict=True):
                os.dup2(os.open(path, os.O_WRONLY), stream)
            os.chdir(cwd)
            script = str(ROOT / "train.py")
            sys.argv = [script, *arguments]
            trap()
            runpy.run_path(script, run_name="__main__")
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        finally:
            sys.stdout.flush()
            os._exit(status)

    def wait(self) -> Ended:
        """Until it ends."""
        _, status = os.waitpid(self.pid, 0)
        output, errors = (path.read_text() for path in self.printed)
        return Ended(os.waitstatus_to_exitcode(status), output, errors)


def kill_at(work: str, count: int) -> Callable[[], None]:
    """A trap: the process kills itself at the start of its ``count``-th evaluation of a strategy,
    or when a file is written but has not yet its name."""

    def set_trap() -> None:
        from torchrl_pref.evaluation import comparison

        module, name = (os, "replace") if work == "write" else (comparison, "evaluate")
        function, calls = getattr(module, name), itertools.count(1)

        def trapped(*arguments: Any, **keywords: Any) -> Any:
            if next(calls) == count:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **keywords)

        setattr(module, name, trapped)

    return set_trap


def paste(line: str) -> Ended:
    """Run a printed line in a shell."""
    done = subprocess.run(["bash", "-c", line], cwd=ROOT, capture_output=True, text=True)
    return Ended(done.returncode, done.stdout, done.stderr)


def named_command(text: str) -> str | None:
    """The command to go on with that was printed, or that an error names."""
    found = re.search(r"go on with(?: it by)?: (.*?)(?:, or name another folder.*)?$", text, re.M)
    return found and found[1]


def content(folder: Path) -> dict[str, Any]:
    """All that a run leaves and that is not a time."""
    checkpoint = Checkpoint.load(folder)
    training = dict(checkpoint.training)
    training["history"] = {
        k: v for k, v in Progress.of(checkpoint.training).history.items() if "time/" not in k
    }
    tables = (folder / "tables.txt").read_text()
    with (folder / "training.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row.pop("frames_per_second")
    names = {path.name for path in folder.iterdir()}
    return {
        "names": sorted(names),
        "weights": flat(checkpoint.weights),
        "training": flat(training),
        "settings": flat(checkpoint.settings),
        "tables": re.sub(r"\S+$", "", tables, flags=re.M),  # the last column is a time
        "table": rows,
        **{name: (folder / name).read_text() for name in ("curves.csv", "summary.json")},
        "pools": [(folder / f"{name}_pool.pt").read_bytes() for name in ("train", "test")],
    }


def flat(value: Any) -> str:
    """Nested plain data and tensors, every bit of them, as text."""
    if isinstance(value, torch.Tensor):
        return f"{value.dtype}{tuple(value.shape)}{value.contiguous().numpy().tobytes().hex()}"
    if isinstance(value, dict):
        return "".join(f"{key}:{flat(inner)};" for key, inner in sorted(value.items(), key=str))
    if isinstance(value, (list, tuple)):
        return ",".join(flat(inner) for inner in value)
    return repr(value)


def differences(folder: Path, expected: dict[str, Any]) -> list[str]:
    """What in a folder is not as expected."""
    try:
        found = content(folder)
    except Exception as error:
        return [f"{type(error).__name__}: {error}"]
    keys = found.keys() | expected.keys()
    return sorted(key for key in keys if found.get(key) != expected.get(key))


class Trials:
    """Trials in a folder of their own, and what came of them.

    Args:
        scratch: an empty folder.
        seed: of the moments.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.random = scratch, random.Random(seed)
        self.counts: dict[str, Counter[str]] = {}
        self.wrong: list[str] = []
        self.number = itertools.count()
        self.expected = content(self.undisturbed())  # the first may compile
        start = time.perf_counter()
        self.undisturbed()
        self.seconds = time.perf_counter() - start

    def undisturbed(self, *arguments: str) -> Path:
        """The folder of a run that nobody disturbs."""
        folder = self.new_folder("undisturbed")
        ended = self.start(folder, *arguments).wait()
        if ended.status:
            raise RuntimeError(f"a run that nobody disturbed failed: {ended.errors}")
        return folder

    def new_folder(self, name: str) -> Path:
        """A path at which there is nothing; it needs quoting, in the shell and for Hydra."""
        return self.scratch / f"{name}, it's = ${next(self.number)}"

    def start(self, folder: Path, *arguments: str, trap: Any = lambda: None) -> Process:
        """A run in a folder."""
        place = f"hydra.run.dir={json.dumps(str(folder))}"
        return Process([*TINY, place, *arguments], self.scratch, trap=trap)

    def judge(self, kind: str, outcome: str, wrong: Sequence[str], *seen: Ended) -> None:
        """Count a trial."""
        counts = self.counts.setdefault(kind, Counter())
        counts["trials"] += 1
        counts["wrong" if wrong else outcome] += 1
        if wrong:
            said = "\n".join(f"  {end.status} {end.output[-300:]} {end.errors}" for end in seen)
            self.wrong.append(f"{kind}, {outcome}: {', '.join(wrong)}\n{said}")

    def kill(self, kind: str) -> None:
        """A run that is killed, and what its user does then."""
        folder = self.new_folder("killed")
        if kind in WORK:
            # 4 files before the first checkpoint, 5 checkpoints, 6 files of the report.
            last = {"evaluation": 6, "write": 14}[kind]
            victim = self.start(folder, trap=kill_at(kind, self.random.randint(1, last)))
        else:
            victim = self.start(folder)
            time.sleep(self.random.uniform(0, self.seconds))
            os.kill(victim.pid, signal.SIGTERM if kind == "SIGTERM" else signal.SIGKILL)
        first = victim.wait()
        line = named_command(first.output)
        if line is None:  # nothing was printed: the user types the command again
            again = self.start(folder).wait()
            line = named_command(again.errors)
        else:
            again = first
        if line is None:
            outcome, last_end = "started anew", again
        else:
            checkpoint = (folder / "checkpoint.pt").exists()
            outcome = "from a checkpoint" if checkpoint else "before one"
            last_end = paste(line)
        wrong = [] if last_end.status == 0 else ["the command failed"]
        expected = {0, 143} if kind == "SIGTERM" else {0, -signal.SIGKILL}
        wrong += [] if first.status in expected else [f"status {first.status}"]
        self.judge(kind, outcome, wrong or differences(folder, self.expected), first, last_end)

    def start_twice(self, resume: bool) -> None:
        """Two processes for one folder, at once."""
        folder = self.new_folder("twice")
        kind = "two new runs" if not resume else "two resumes"
        if resume:
            self.start(folder, trap=kill_at("write", self.random.randint(5, 8))).wait()
            typed = f"resume={json.dumps(str(folder))}"
            both = [Process([typed], self.scratch) for _ in range(2)]
        else:
            both = [self.start(folder) for _ in range(2)]
        ends = [process.wait() for process in both]
        statuses = sorted(end.status for end in ends)
        refused = [end.errors for end in ends if end.status == 2]
        wrong = [] if statuses == [0, 2] else [f"statuses {statuses}"]
        wrong += [text for text in refused if not re.fullmatch(r"error: .*\n", text)]
        outcome = "one went on, one was refused"
        self.judge(kind, outcome, wrong or differences(folder, self.expected), *ends)

    def start_by_default(self, expected: Sequence[dict[str, Any]]) -> None:
        """Two processes that name no folder, at once, with the seeds 0 and 1."""
        cwd = self.new_folder("default")
        cwd.mkdir()
        both = [Process([*TINY, f"seed={seed}"], self.scratch, cwd) for seed in (0, 1)]
        ends = [process.wait() for process in both]
        folders = sorted((cwd / "outputs").glob("*/*"))
        wrong = [f"status {end.status}" for end in ends if end.status]
        wrong += [] if len(folders) == 2 else [f"{len(folders)} folders"]
        found = {f'"seed={seed}"': expected[seed] for seed in (0, 1)}
        for folder in [] if wrong else folders:
            summary = (folder / "summary.json").read_text()
            wrong += differences(folder, next(found[key] for key in found if key in summary))
        seconds = {folder.name[:8] for folder in folders}
        outcome = "a folder each" + (", same second" if len(seconds) == 1 else "")
        self.judge("two default starts", outcome, wrong, *ends)

    def rows(self) -> Iterator[dict[str, Any]]:
        """The table."""
        for kind, counts in self.counts.items():
            outcomes = [f"{n} {name}" for name, n in counts.items() if name not in KEPT]
            yield {
                "kind": TITLES.get(kind, kind),
                "trials": counts["trials"],
                "of them": ", ".join(sorted(outcomes)),
                "lost or mixed": counts["wrong"],
            }


KEPT = ("trials", "wrong")

TITLES = {
    "SIGKILL": "SIGKILL at a random moment",
    "write": "SIGKILL when a file is written and not yet named",
    "SIGTERM": "SIGTERM at a random moment",
    "evaluation": "SIGKILL in the evaluation",
}


def main() -> None:
    """All trials, and the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--starts", type=int, default=20, help="double starts")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    typed = common.start(parser)
    scratch = Path(tempfile.mkdtemp(prefix="kills-"))
    begun = time.perf_counter()
    try:
        trials = Trials(scratch, typed.seed)
        # Of ten kills five at a random moment, two by SIGTERM, two in a write, one in evaluation.
        kinds = ["SIGKILL", "write", "SIGTERM", "SIGKILL", "evaluation"]
        kinds += ["SIGKILL", "write", "SIGTERM", "SIGKILL", "SIGKILL"]
        for kind in itertools.islice(itertools.cycle(kinds), typed.kills):
            trials.kill(kind)
        by_seed: list[dict[str, Any]] = []
        for number in range(typed.starts):
            if number % 3 == 2:
                if not by_seed:
                    seeds = [f"seed={seed}" for seed in (0, 1)]
                    by_seed += [content(trials.undisturbed(seed)) for seed in seeds]
                trials.start_by_default(by_seed)
            else:
                trials.start_twice(resume=number % 3 == 1)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    common.report("Runs that were killed, or started twice", list(trials.rows()), typed.json)
    print(f"\n{time.perf_counter() - begun:.0f} s, seed {typed.seed}")
    for text in trials.wrong:
        print(f"\nWRONG: {text}", file=sys.stderr)
    raise SystemExit(bool(trials.wrong))


if __name__ == "__main__":
    main()
