"""Files that are spoiled, cut, foreign or hostile, each tried at the door that users open it at.

``python benchmarks/bad_files.py [--flips 120] [--seed 0]``. A pool is opened with
``QueryPool.load``, a checkpoint with ``Checkpoint.load`` and then resumed for one update, a CSV
table with the run that it belongs to. What may become of each:

- *refused*: one line, and the file is as it was;
- *harmless*: what was read is the undamaged content to the last bit (of a log: the file is again);
- and what must not be: *accepted*, read as something else; a *traceback*, or more than one line; a
  *hang* of 60 seconds; a *crash* of the process; *memory* beyond 64 MiB and four times the file's
  size; a payload *executed*; the file *changed*.

Each is tried in another process, whose address space is limited, so that none can harm the machine.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder's select.py hides Python's

import contextlib
import dataclasses
import io
import multiprocessing as mp
import os
import random
import resource
import shutil
import stat
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks import common, spoil, spoil_contents, spoil_hostile
from benchmarks.spoil import MARKER, Case
from torchrl_pref import build
from torchrl_pref.checkpoints.checkpoint import KIND, Checkpoint
from torchrl_pref.errors import InputError, check_count
from torchrl_pref.evaluation import comparison
from torchrl_pref.pool import QueryPool
from torchrl_pref.storage.files import MAX_FILE
from torchrl_pref.training.start import make_checkpoint, make_trainer
from torchrl_pref.training.trainer import Trainer

OUTCOMES = ("refused", "harmless", "accepted", "traceback", "hang", "crash", "memory", "executed")
COLUMNS = ("tried", *OUTCOMES, "changed")
GOOD = ("tried", "refused", "harmless")

SECONDS = 60
ROOM = 64 * 2**20
"""Bytes of memory that any file may take, beside four times its size."""

LIMIT = 4 * 2**30
"""Bytes of address space that a process may take while it opens a file."""

LOG = Path("training.csv")

SIZES = (
    *("setup=feed", "setup.budget=4", "pool.size=30", "belief.samples=10", "human.spread=1.0"),
    *("training.sessions=4", "training.updates=3", "training.steps=20", "training.warm_up=1"),
)


class Bench:
    """The undamaged files, what is in them, and the doors.

    Args:
        folder: where they are kept; made there where they are not.
    """

    def __init__(self, folder: Path) -> None:
        self.run = folder / "run"
        if not self.run.exists():
            make_run(self.run)
        self.files = {
            "pool": self.run / "train_pool.pt",
            "checkpoint": self.run / "checkpoint.pt",
            "log": self.run / LOG,
        }
        self.pool = dataclasses.asdict(QueryPool.load(self.files["pool"]))
        checkpoint = Checkpoint.load(self.files["checkpoint"])
        self.checkpoint = dataclasses.asdict(checkpoint)
        self.log = self.files["log"].read_bytes()
        self.trainer = resumed(checkpoint)

    def open(self, door: str, path: Path) -> bool:
        """Use a file as a user would; whether it held what it should.

        Raises:
            InputError: it is refused.
        """
        if door == "pool":
            return same(dataclasses.asdict(QueryPool.load(path)), self.pool)
        if door == "checkpoint":
            checkpoint = Checkpoint.load(path)
            if same(dataclasses.asdict(checkpoint), self.checkpoint):
                return True
            trainer = resumed(checkpoint)
            trainer.update(trainer.sessions.collect())
            return False
        with contextlib.redirect_stderr(io.StringIO()):
            self.trainer.run(path.parents[len(LOG.parents) - 1], lambda: None)
        return path.read_bytes() == self.log


def make_run(folder: Path) -> None:
    """A small run, as ``train.py`` leaves it."""
    conf = str(spoil.ROOT / "conf")
    with initialize_config_dir(conf, version_base="1.3"):
        config = compose("train", overrides=list(SIZES))
    settings: Any = OmegaConf.to_container(config, resolve=True)
    for key in ("resume", "checkpoint"):
        settings.pop(key)
    settings["overrides"] = list(SIZES)
    pools = build.make_pools(settings)
    task = build.make_task(*pools, settings["tau"], settings)
    trainer = make_trainer(settings, task)
    folder.mkdir(parents=True)
    pools[0].save(folder / "train_pool.pt")

    def save() -> None:
        make_checkpoint(settings, task, trainer).save(folder / "checkpoint.pt")

    with contextlib.redirect_stderr(io.StringIO()):
        trainer.run(folder, save)


def resumed(checkpoint: Checkpoint) -> Trainer:
    """All that ``train.py resume=`` does before its first update."""
    settings = checkpoint.settings
    check_count("threads", settings["threads"], 1)
    comparison.check_evaluation(settings)
    task = build.reload_task(checkpoint, Path("none"), Path("none"))
    checkpoint.check_fits(task.test)
    trainer = make_trainer(settings, task)
    build.load_weights(trainer.policy, checkpoint)
    if "optimizer" not in checkpoint.training:
        raise InputError("a policy without the state of its training")
    trainer.load_state_dict(checkpoint.training)
    return trainer


def same(first: Any, second: Any) -> bool:
    """Whether two nests of plain data and tensors are equal to the last bit; NaN equals NaN."""
    if type(first) is not type(second):
        return False
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[k], second[k]) for k in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    if isinstance(first, torch.Tensor):
        return first.shape == second.shape and torch.equal(first, second)
    return bool(first == second) or (first != first and second != second)


def all_cases(bench: Bench, flips: int, seed: int) -> Iterator[Case]:
    """Every bad file, made from the good ones."""
    rng = random.Random(seed)
    good = {door: path.read_bytes() for door, path in bench.files.items()}
    for door, data in good.items():
        yield from spoil.damaged(door, data, flips, rng)
    for door, kind, other in (("pool", "query pool", "checkpoint"), ("checkpoint", KIND, "pool")):
        yield from spoil.foreign(door, good[door], good[other])
        yield from spoil.in_its_place(door, good[door])
        yield from spoil_hostile.payloads(door, kind)
        yield from spoil_hostile.hostile(door, kind)
    yield from spoil.in_its_place("log", good["log"])
    yield from spoil.rows_of_logs()
    content = torch.load(bench.files["checkpoint"], weights_only=True)
    yield from spoil_contents.spoiled_settings(content)
    yield from spoil_contents.spoiled_content(content)
    yield from spoil_contents.spoiled_pools()


def outcome(bench: Bench, door: str, path: Path) -> str:
    """What becomes of a file: one of the first columns of ``OUTCOMES``."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            held = bench.open(door, path)
        except InputError as error:
            cause = error.__cause__
            memory = isinstance(cause, MemoryError) or "can't allocate memory" in str(cause)
            line = str(error).replace(str(path), "")
            if memory:
                return "memory"
            return "refused" if "\n" not in line and len(line) < 600 else "traceback"
        except MemoryError:
            return "memory"
        except Exception:
            return "traceback"
    return "traceback" if warned else "harmless" if held else "accepted"


def looks(path: Path) -> Any:
    """What a file is like: its content, or of what is none its kind."""
    try:
        status = os.lstat(path)
    except (OSError, ValueError):
        return None
    whole = stat.S_ISREG(status.st_mode) and status.st_size < 2**28
    content = path.read_bytes() if whole and os.access(path, os.R_OK) else None
    return stat.S_IFMT(status.st_mode), status.st_size, content


def serve(pipe: Connection, folder: Path) -> None:
    """Open one file after another, as told through a pipe, and tell what became of each."""
    torch.set_num_threads(1)
    bench = Bench(folder)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + LIMIT, used + LIMIT))
    pipe.send("ready")
    while (told := pipe.recv()) is not None:
        door, path = told
        os.chdir(path.parent if os.path.isdir(path.parent) else folder)
        Path("/proc/self/clear_refs").write_text("5")  # the highest memory use is measured anew
        before = memory("VmRSS")
        if os.geteuid() == 0 and os.path.isfile(path) and not os.stat(path).st_mode & 0o400:
            os.seteuid(65534)  # the superuser may read anything
        became = outcome(bench, door, path)
        if os.geteuid() != os.getuid():
            os.seteuid(os.getuid())
        pipe.send((became, memory("VmHWM") - before))


def memory(name: str) -> int:
    """Bytes of memory in use (VmRSS) or at most in use (VmHWM)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(name)).split()[1])


class Opener:
    """Another process that opens files, started anew after each hang or crash."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.start()

    def start(self) -> None:
        """Start the process."""
        self.pipe, other = mp.Pipe()
        self.process = mp.get_context("spawn").Process(
            target=serve, args=(other, self.folder), daemon=True
        )
        self.process.start()
        other.close()
        self.pipe.recv()

    def stop(self) -> None:
        """Let it end."""
        self.pipe.send(None)
        self.process.join()

    def open(self, door: str, path: Path) -> tuple[str, int]:
        """What became of a file, and the memory that it took in bytes."""
        self.pipe.send((door, path))
        try:
            if self.pipe.poll(SECONDS):
                return self.pipe.recv()
            became = "hang"
        except (EOFError, ConnectionError):
            became = "crash"
        self.process.kill()
        self.process.join()
        self.start()
        return became, 0


def placed(case: Case, folder: Path) -> Path:
    """Make a bad file in an empty folder; where it is to be opened."""
    path = case.make(folder)
    if case.door != "log":
        return path
    log = folder / "run" / LOG
    log.parent.mkdir(parents=True)
    if "\0" not in str(path) and os.path.lexists(path) and path.parent == folder:
        os.rename(path, log)
    return log


def attempt(case: Case, opener: Opener) -> tuple[list[str], int]:
    """Make a bad file, try it, and say in which columns it counts and what memory it took."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    try:
        path = placed(case, folder)
        before = looks(path)
        size = os.path.getsize(path) if os.path.isfile(path) else 0
        became, taken = opener.open(case.door, path)
        if taken > ROOM + (4 * size if size <= MAX_FILE else 0):
            became = "memory"
        if any(folder.rglob(MARKER)):
            became = "executed"
        # What is harmless of a log has been mended, and is compared.
        left = became == "harmless" and case.door == "log"
        changed = [] if left or looks(path) == before else ["changed"]
        return [became, *changed], taken
    finally:
        shutil.rmtree(folder)


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--flips", type=int, default=120, help="flipped bits a kind (default 120)")
    parser.add_argument("--seed", type=int, default=0, help="of the damage (default 0)")
    options = common.start(parser)
    counts: dict[str, Counter[str]] = {}
    start, most = time.perf_counter(), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bench, opener = Bench(folder), Opener(folder)
        for case in all_cases(bench, options.flips, options.seed):
            columns, taken = attempt(case, opener)
            most = max(most, taken)
            counts.setdefault(case.group, Counter()).update(["tried", *columns])
            if not set(columns) <= set(GOOD):
                print(f"{case.group}: {case.door}, {case.name}: {', '.join(columns)}", flush=True)
        opener.stop()
    counts["all"] = sum(counts.values(), Counter())
    rows = [{"files": name, **{c: found[c] for c in COLUMNS}} for name, found in counts.items()]
    title = f"What became of bad files; at most {most / 2**20:.0f} MiB for one"
    common.report(title, rows, options.json)
    print(f"{time.perf_counter() - start:.0f} s")
    bad = sum(counts["all"][column] for column in COLUMNS if column not in GOOD)
    if bad or counts["all"]["tried"] < 650:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
