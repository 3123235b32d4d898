"""The scripts as a user runs them, in forks of a process that has imported what takes long.

A run of its own takes four seconds of imports, and more until all machine code is loaded. A fork
server has them once (``warm.py``), and each fork of it is as new as a process that has just come so
far: nothing of a test is in it.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import tempfile
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).parents[1]

CONTEXT = get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.warm"])  # Python 3.11 finds it from the root alone

TIMEOUT = 120.0
"""Seconds."""


def run_script(
    script: str, *arguments: str, folder: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    """What ``python <script> <arguments>`` says from a folder, and how it ends."""
    with tempfile.TemporaryDirectory() as place:
        files = [Path(place) / name for name in ("out", "errors")]
        given = script, arguments, str(folder), *map(str, files)
        process = CONTEXT.Process(target=_be_script, args=given)
        process.start()
        process.join(TIMEOUT)
        if process.is_alive():
            process.kill()
            process.join()
        said = [file.read_text(errors="replace") for file in files]
    return subprocess.CompletedProcess([script, *arguments], process.exitcode or 0, *said)


def _be_script(script: str, arguments: tuple[str, ...], folder: str, out: str, errors: str) -> None:
    """Become the script."""
    for number, path in ((1, out), (2, errors)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    os.chdir(folder)
    sys.argv = [str(ROOT / script), *arguments]
    # What pytest looks in, and the user's script does not, is not there.
    sys.path[:] = [str(ROOT), *(one for one in sys.path if not one.startswith(str(ROOT / "t")))]
    sys.path[:] = [one for one in sys.path if not one.startswith(str(ROOT / "examples"))]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
