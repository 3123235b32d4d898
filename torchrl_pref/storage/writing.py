"""Files that are written whole or not at all, whatever becomes of the process that writes them."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PARTIAL = ".partial"
"""In the name of a file that is not yet whole. Where its process was killed, it lies about."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write a file, which takes the place of another once all of it is on the disk.

    Args:
        path: the file that is to be.

    Yields:
        The path of a file in the same folder, with the same ending, that no other process writes.
    """
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{PARTIAL}{path.suffix}")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
