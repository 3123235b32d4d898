"""The scripts as a user runs them, in forks of a process that has imported what takes long.

A run of its own takes four seconds of imports, and more until all machine code is loaded. A fork
server has them once (``warm.py``), and each fork of it is as new as a process that has just come so
far: nothing of a test is in it.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
from multiprocessing import get_context
from multiprocessing.context import ForkServerProcess
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


def start_in_terminal(
    script: str, *arguments: str, folder: Path, terminal: str, **environment: str
) -> ForkServerProcess:
    """``python <script> <arguments>`` in a session of its own, at a terminal."""
    given = script, arguments, str(folder), terminal, environment
    process = CONTEXT.Process(target=_be_script_in_terminal, args=given)
    process.start()
    return process


def _be_script_in_terminal(
    script: str,
    arguments: tuple[str, ...],
    folder: str,
    terminal: str,
    environment: dict[str, str],
) -> None:
    """Become the script; the terminal sends it no signals."""
    os.setsid()
    os.environ.update(environment)
    end = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    for number in range(3):
        os.dup2(end, number)
    os.close(end)
    # Tests that run in the background of a shell ignore Ctrl-C, which is not what they test.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _run_script(script, arguments, folder)


def _be_script(script: str, arguments: tuple[str, ...], folder: str, out: str, errors: str) -> None:
    """Become the script."""
    for number, path in ((1, out), (2, errors)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    _run_script(script, arguments, folder)


def _run_script(script: str, arguments: tuple[str, ...], folder: str) -> None:
    """Run it from a folder, with the files that the descriptors 0, 1 and 2 now are."""
    sys.stdin = os.fdopen(0, closefd=False)
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
