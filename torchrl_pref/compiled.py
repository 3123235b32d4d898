"""Functions compiled by Numba for the CPU, whose machine code is kept from one process to the next.

It is kept in ``NUMBA_CACHE_DIR`` where that is set, else in ``__pycache__`` beside the source, else
in the user's cache; where none of these can be written, each process compiles anew. What is kept is
made anew when its own file changes and not when another does: a compiled function calls only those
of its own file, or of one whose digest its own file holds (``beliefs/slice_cpu.py``).

The long loops over sessions, of moves and of scores, are shared out among threads, each of which
takes some of the sessions: as many as ``NUMBA_NUM_THREADS``, by default one for each core. No
number depends on how many there are.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any, TypeVar

from numba import config, njit

R = TypeVar("R")

# Sums may be reordered; infinities keep their meaning.
OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "contract"}}


def compiled(function: Callable[..., R]) -> Callable[..., R]:
    """Compile a function at its first call; it may call others that are compiled."""
    try:
        return njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # no place for the cache can be written
        return njit(**OPTIONS)(function)


FEWEST = 6
"""Sessions that a thread is worth."""

_threads = config.NUMBA_NUM_THREADS
"""Numba's own may be set again at any compilation."""


def n_threads() -> int:
    """How many threads long loops are shared out among."""
    return _threads


def share_out(threads: int) -> None:
    """From now on, in this process, share long loops out among so many threads."""
    global _threads
    _threads = threads
    _executor.cache_clear()


def over_sessions(loop: Callable[..., None], n_sessions: int, *arguments: Any) -> None:
    """Run a compiled loop over sessions, in threads where there are many.

    Args:
        loop: of the first session, the one after the last, and the arguments; it writes into them.
        n_sessions: how many there are.
        arguments: what else the loop takes.
    """
    parts = min(_threads, n_sessions // FEWEST)
    if parts < 2:
        loop(0, n_sessions, *arguments)
        return
    ends = [part * n_sessions // parts for part in range(parts + 1)]
    others = [_executor().submit(loop, *ends[p : p + 2], *arguments) for p in range(1, parts)]
    try:
        loop(0, ends[1], *arguments)
    finally:  # no thread writes on once this has ended, however it does
        wait(others)
    for other in others:
        other.result()


@lru_cache(maxsize=1)
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_threads, "over_sessions")


if hasattr(os, "register_at_fork"):  # not on Windows
    # A fork has none of the threads of the process that it comes from.
    os.register_at_fork(after_in_child=_executor.cache_clear)
