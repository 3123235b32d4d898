"""Files that nobody should have to read: spoiled, cut, foreign, and made to do harm.

Each case writes one file, or something else in its place, and names the door that it is tried at.
"""

from __future__ import annotations

import gzip
import io
import os
import random
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]

MARKER = "executed"
"""The file that a payload makes, in the folder where it is run."""

BOMB = b"bomb"

Make = Callable[[Path], Path]


@dataclass(frozen=True)
class Case:
    """One bad file.

    Attributes:
        group: the row of the table that it counts in.
        name: what was done.
        door: ``pool``, ``checkpoint`` or ``log``.
        make: writes it in an empty folder and returns the path to open.
    """

    group: str
    name: str
    door: str
    make: Make


def of_bytes(data: bytes) -> Make:
    """A file with this content."""

    def make(folder: Path) -> Path:
        path = folder / "file"
        path.write_bytes(data)
        return path

    return make


def of_content(content: Any) -> Make:
    """A file of ``torch.save``."""

    def make(folder: Path) -> Path:
        torch.save(content, folder / "file")
        return folder / "file"

    return make


def of_zip(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Make:
    """A zip that is laid out as those of ``torch.save``; a part named bomb is 300 MB of zeros."""

    def make(folder: Path) -> Path:
        parts = {"version": b"3\n", "byteorder": b"little", **members}
        with zipfile.ZipFile(folder / "file", "w", compression, compresslevel=1) as archive:
            for name, data in parts.items():
                archive.writestr(f"archive/{name}", bytes(300 * 2**20) if data == BOMB else data)
        return folder / "file"

    return make


def damaged(door: str, data: bytes, count: int, rng: random.Random) -> Iterator[Case]:
    """Bits flipped, bytes overwritten, dropped and doubled at random places, and ends cut off."""
    for _ in range(count):
        place, bit = rng.randrange(len(data)), rng.randrange(8)
        flipped = bytearray(data)
        flipped[place] ^= 1 << bit
        yield Case(f"{door}: a bit flipped", f"{place}.{bit}", door, of_bytes(bytes(flipped)))
    for _ in range(count // 3):
        start = rng.randrange(len(data))
        end = min(len(data), start + rng.choice((1, 2, 8, 64, 512, 4096)))
        noise = rng.choice((rng.randbytes(end - start), bytes(end - start)))
        for what, spoiled in (
            ("overwritten", data[:start] + noise + data[end:]),
            ("dropped", data[:start] + data[end:]),
            ("doubled", data[:end] + data[start:]),
        ):
            group = f"{door}: bytes overwritten, dropped, doubled"
            yield Case(group, f"{what} {start}:{end}", door, of_bytes(spoiled))
    for size in {0, 1, 4, len(data) - 1, *(rng.randrange(len(data)) for _ in range(count // 5))}:
        yield Case(f"{door}: cut off", f"at {size}", door, of_bytes(data[:size]))


def foreign(door: str, good: bytes, other: bytes) -> Iterator[Case]:
    """Files of another kind."""
    png = (ROOT / "docs" / "figure_1.png").read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("file.pt", good)
    tar = io.BytesIO()
    torch.save({"kind": "query pool"}, tar, _use_new_zipfile_serialization=False)
    files = {
        "text": b"hello\n",
        "rows": b"1,0.5\n2,0.6\n",
        "json": b'{"kind": "query pool", "features": [[[0, 1], [1, 0]]]}',
        "picture": png,
        "page": b"<!doctype html><html><body>404</body></html>",
        "gzip of a good one": gzip.compress(good),
        "zip of a good one": packed.getvalue(),
        "torch's old format": tar.getvalue(),
        "good one with a tail": good + b"tail",
        "good one of another kind": other,
        "safetensors with a header of 2^60 bytes": (2**60).to_bytes(8, "little") + b"{}",
        "noise": random.Random(7).randbytes(20_000),
        "an empty zip": b"PK\x05\x06" + bytes(18),
    }
    for name, data in files.items():
        yield Case("foreign files", name, door, of_bytes(data))
    contents: dict[str, Any] = {
        "a tensor": torch.zeros(3),
        "a list": [1, 2],
        "nothing": None,
        "no kind": {"features": torch.rand(3, 2, 2)},
        "kind a number": {"kind": 5},
        "kind a list": {"kind": [["query pool"]]},
        "kind a long text": {"kind": "x" * 100_000},
        "another kind": {"kind": "study"},
    }
    for name, content in contents.items():
        yield Case("foreign files", name, door, of_content(content))


def in_its_place(door: str, good: bytes) -> Iterator[Case]:
    """Something else than a file, or a file that cannot be opened."""

    def link(target: str) -> Make:
        def make(folder: Path) -> Path:
            (folder / "file").symlink_to(target)
            return folder / "file"

        return make

    def folder_of(folder: Path) -> Path:
        (folder / "file").mkdir()
        return folder / "file"

    def pipe(folder: Path) -> Path:
        os.mkfifo(folder / "file")
        return folder / "file"

    def locked(folder: Path) -> Path:
        path = of_bytes(good)(folder)
        path.chmod(0)
        return path

    def sparse(folder: Path) -> Path:
        path = of_bytes(good)(folder)
        os.truncate(path, 5 * 2**30)
        return path

    makers: dict[str, Make] = {
        "a link to itself": link("file"),
        "a link to nothing": link("nothing"),
        "a folder": folder_of,
        "a pipe": pipe,
        "a device": lambda folder: Path("/dev/zero"),
        "a link to a device": link("/dev/zero"),
        "no permission": locked,
        "5 GiB of nothing": sparse,
        "nothing there": lambda folder: folder / "nothing",
        "below a file": lambda folder: of_bytes(good)(folder) / "below",
        "a name too long": lambda folder: folder / ("x" * 300),
        "a name with a zero": lambda folder: folder / "a\0b",
    }
    for name, make in makers.items():
        yield Case("no file, or a locked one", name, door, make)


def rows_of_logs() -> Iterator[Case]:
    """Logs with rows that are torn, blank, doubled, missing, or none of a log."""
    png = (ROOT / "docs" / "figure_1.png").read_bytes()
    logs = {
        "empty": b"",
        "a blank row": b"1,0.5\n\n3,0.5\n",
        "a blank first row": b"\n1,0.5\n",
        "blanks": b"   \n \n",
        "a torn row": b"1,0.5\n2",
        "a torn number": b"1,0.5\n2,0.",
        "a row without a number": b"1,0.5\n2,\n",
        "words": b"step,value\n",
        "rows out of order": b"3,0.5\n1,0.5\n",
        "rows twice": b"1,0.5\n1,0.5\n",
        "rows to come": b"1,0.5\n2,0.5\n3,0.5\n4,0.5\n5,0.5\n",
        "steps below 0": b"-5,0.5\n",
        "a step of 5,000 digits": b"9" * 5000 + b",0.5\n",
        "other ends of line": b"1,0.5\r2,0.5\r",
        "zeros": bytes(4096),
        "no UTF-8": b"\xff\xfe1,0.5\n",
        "a picture": png,
        "a formula": b'=cmd|" /C calc"!A0,1\n',
    }
    for name, data in logs.items():
        yield Case("log: rows", name, "log", of_bytes(data))
