"""Functions compiled by Numba for the CPU, whose machine code is kept from one process to the next.

It is kept in ``NUMBA_CACHE_DIR`` where that is set, else in ``__pycache__`` beside the source, else
in the user's cache; where none of these can be written, each process compiles anew. What is kept is
made anew when its own file changes and not when another does: a compiled function calls only those
of its own file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

R = TypeVar("R")

# Sums may be reordered; infinities keep their meaning.
OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "contract"}}


def compiled(function: Callable[..., R]) -> Callable[..., R]:
    """Compile a function at its first call; it may call others that are compiled."""
    try:
        return njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # no place for the cache can be written
        return njit(**OPTIONS)(function)
