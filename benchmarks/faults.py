"""Plant faults in a copy of the package, one at a time: does a test notice each of them?

Each fault of ``planted.py`` is written into a copy of the tracked files. The tests that ought to
notice it run there until one fails, and the file is put back. The exit status is 1 where none does.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)  # this folder's select.py hides Python's

import argparse
import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from benchmarks.common import Row, copy_to, report
from benchmarks.planted import FAULTS, Fault

PACKAGE = "torchrl_pref"

LONGEST = 300
"""Seconds that the tests of a fault may take."""

PYTEST = ("-m", "pytest", "-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider")


def changed(fault: Fault, text: str) -> str:
    """The text of its file with a fault in it.

    Raises:
        ValueError: what it is to replace is not there, or there more than once.
    """
    count = text.count(fault.old)
    if count != 1:
        raise ValueError(
            f"{fault.what}: {fault.file} has {fault.old!r} {count} times; expected it once"
        )
    return text.replace(fault.old, fault.new)


@contextmanager
def planted(fault: Fault, folder: Path) -> Iterator[None]:
    """Within the block the copy has the fault."""
    path = folder / PACKAGE / fault.file
    text, times = path.read_text(), path.stat()
    path.write_text(changed(fault, text))
    try:
        yield
    finally:
        path.write_text(text)
        # Python and Numba tell by its time whether what they keep of a file is still right.
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def caught_by(fault: Fault, folder: Path) -> str | None:
    """The first of its tests that fails in the copy; None where all pass.

    Raises:
        RuntimeError: the tests cannot be run.
    """
    tests = [f"tests/{test}" for test in fault.tests.split()]
    done = subprocess.run(
        [sys.executable, *PYTEST, *tests],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        timeout=LONGEST,
    )
    failed = re.search(r"^(?:FAILED|ERROR) \S+?::(\w+)", done.stdout, re.M)
    if done.returncode not in (0, 1) or bool(done.returncode) != bool(failed):
        raise RuntimeError(f"{fault.what}: the tests do not run\n{done.stdout}{done.stderr}")
    return failed[1] if failed else None


def main() -> None:
    """Plant them, and tell which are caught."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", help="numbers of faults, by commas; default all")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    typed = parser.parse_args()
    numbers = range(1, len(FAULTS) + 1)
    chosen = [int(number) for number in typed.only.split(",")] if typed.only else list(numbers)
    if not set(chosen) <= set(numbers):
        parser.error(f"--only {typed.only}: expected numbers from 1 to {len(FAULTS)}")
    for fault in FAULTS:
        changed(fault, (ROOT / PACKAGE / fault.file).read_text())
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        copy_to(folder)
        bar = tqdm(chosen, unit="fault")
        for number in bar:
            fault = FAULTS[number - 1]
            bar.set_description(fault.file)
            with planted(fault, folder):
                test = caught_by(fault, folder)
            rows.append(
                {
                    "number": number,
                    "fault": fault.what,
                    "file": fault.file,
                    "caught by": test or "NOT CAUGHT",
                }
            )
    missed = sum(row["caught by"] == "NOT CAUGHT" for row in rows)
    report(f"{len(rows) - missed} of {len(rows)} faults caught", rows, typed.json)
    raise SystemExit(bool(missed))


if __name__ == "__main__":
    main()
