"""The main jobs as a user runs them: training, evaluation, tables and figures, as whole processes.

``python benchmarks/main_job.py``. Wall and CPU seconds of ``train.py`` in each of the four cells,
one after the other. With ``--folder`` the runs are kept, for ``benchmarks/quality.py`` to judge.
The compiled code must be there already (any run before makes it), as on every day but the first.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # this folder's select.py hides Python's

import os
import resource
import subprocess
import tempfile
import time

from benchmarks import common

CELLS = [(setup, tau) for setup in ("feed", "query") for tau in ("noisy", "optimal")]

LIMITS = {("feed", "noisy"): 120, ("query", "noisy"): 90}
"""Seconds of wall time that a job may take on two idle cores; all four may take 360."""


def main() -> None:
    """Print the table."""
    parser = common.arguments(__doc__)
    parser.add_argument("--folder", type=Path, help="keep the runs here")
    parser.add_argument("overrides", nargs="*", help="further keys of train.py")
    options = common.start(parser)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) if options.folder is None else options.folder.resolve()
        rows = [run_job(folder, *cell, options.overrides) for cell in CELLS]
    total = {key: sum(row[key] for row in rows) for key in ("wall s", "CPU s")}
    common.report("Main jobs", [*rows, {"job": "all four", "at most": 360, **total}], options.json)


def run_job(folder: Path, setup: str, tau: str, overrides: list[str]) -> common.Row:
    """One training and its evaluation in a process of its own."""
    keys = [f"setup={setup}", f"tau={tau}", f"hydra.run.dir={folder / f'{setup}-{tau}'}"]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "train.py", *keys, *overrides]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}: ended with status {done.returncode}\n{done.stderr}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    row: common.Row = {"job": f"setup={setup} tau={tau}", "wall s": wall, "CPU s": cpu}
    return row | {"at most": LIMITS.get((setup, tau), "")}


if __name__ == "__main__":
    main()
