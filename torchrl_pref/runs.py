"""A folder belongs to one process at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from torchrl_pref.errors import InputError
from torchrl_pref.storage.writing import PARTIAL

LOCK = ".lock"

CHECKPOINT = "checkpoint.pt"
"""The file of a run's folder that holds its policy."""

TABLES = "tables.txt"
"""The file of an evaluation's folder that holds what it found."""

STUDY = "study.db"
"""The file of a study's folder that holds what people answered."""


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep a folder to this process until the end of the block.

    The claim is a lock of the operating system and dies with its holder, also by ``kill -9``. What
    a killed holder was writing is removed.

    Args:
        folder: an existing folder.

    Raises:
        InputError: another process has claimed it.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise InputError(
            f"{folder}: another process is at work there; wait for its end, or name another folder "
            "by hydra.run.dir= (of a sweep: hydra.sweep.dir=)"
        ) from None
    try:
        for left in folder.glob(f".*{PARTIAL}*"):
            left.unlink(missing_ok=True)
        yield
    finally:
        # First the name, then the lock: whoever waits for the lock of a nameless file tries anew.
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()
