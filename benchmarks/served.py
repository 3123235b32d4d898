"""``ask.py`` as its users run it, in a process that can be killed, and talked to over HTTP."""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import re
import runpy
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["hydra", "uvicorn", "torchrl_pref.study.serve", "torchrl_pref.pretrained"]
)

SLOWEST = 120
"""Seconds within which a server has to be there, and to reply."""

GONE = (OSError, http.client.HTTPException)
"""What is raised where the server was killed."""

WATCHED = {"seconds": 1.0, "replays": 0}
"""What the page tells beside an answer."""


class Server:
    """``ask.py`` in a process of its own; forked from one that has imported everything."""

    def __init__(self, *arguments: str) -> None:
        number, name = tempfile.mkstemp(suffix=".log")
        os.close(number)
        self.log = Path(name)
        self.process = CONTEXT.Process(target=be_server, args=(name, arguments), daemon=True)
        self.process.start()
        self.port = self._wait_for_port()

    @property
    def link(self) -> str:
        """To the page."""
        return f"http://127.0.0.1:{self.port}/"

    def _wait_for_port(self) -> int:
        until = time.monotonic() + SLOWEST
        while time.monotonic() < until and self.process.is_alive():
            found = re.search(r"http://127\.0\.0\.1:(\d+)/", self.log.read_text())
            if found:
                return int(found[1])
            time.sleep(0.005)
        raise SystemExit(f"the server did not start: {self.log.read_text()}")

    def kill(self) -> None:
        """By SIGKILL, which nothing survives."""
        with suppress(ProcessLookupError):
            os.kill(self.process.pid or 0, signal.SIGKILL)

    def close(self) -> None:
        """Kill it, and wait until it is gone."""
        self.kill()
        self.process.join()
        self.log.unlink()

    def post(self, path: str, **body: Any) -> tuple[int, dict[str, Any]]:
        """Status and JSON of a request."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=SLOWEST)
        try:
            headers = {"Content-Type": "application/json"}
            connection.request("POST", path, json.dumps(body), headers)
            reply = connection.getresponse()
            return reply.status, json.loads(reply.read())
        finally:
            connection.close()


def be_server(log: str, arguments: tuple[str, ...]) -> None:
    """Become ``ask.py``."""
    out = os.open(log, os.O_WRONLY)
    os.dup2(out, 1)
    os.dup2(out, 2)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    os.chdir(tempfile.gettempdir())
    sys.argv = [str(ROOT / "ask.py"), *arguments, "open=false"]
    sys.path[0] = str(ROOT)
    runpy.run_path(sys.argv[0], run_name="__main__")
