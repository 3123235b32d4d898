"""Processes that a command starts, whatever started the command."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def spawning() -> Iterator[None]:
    """Processes of the context ``spawn`` that are started in the block can start.

    Each is told the default way to start one. That of a worker of joblib is called ``loky``, which
    is not known there yet: it would end at once.
    """
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("spawn", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(before, force=True)


def track_resources() -> None:
    """Start what multiprocessing starts with the first process: it lets signals through again."""
    if os.name == "posix":
        from multiprocessing.resource_tracker import ensure_running

        ensure_running()
