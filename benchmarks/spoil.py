"""Files that nobody should have to read: spoiled, cut, foreign, and made to do harm.

Each case writes one file, or something else in its place, and names the door that it is tried at.
"""

from __future__ import annotations

import gzip
import io
import os
import pickle
import random
import zipfile
from collections import OrderedDict
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


def of_pickle(kind: str, value: Callable[[], Any]) -> Make:
    """Such a zip whose pickle has a value where features or settings are looked for."""

    def make(folder: Path) -> Path:
        made = value()
        content = {"kind": kind, "features": made, "settings": made, "format": made}
        return of_zip({"data.pkl": pickled(content), "data/0": bytes(64)})(folder)

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


class _Call:
    """What unpickles by a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


class _Storage:
    """What unpickles as bytes of a part of the zip, as many as it says."""

    def __init__(self, kind: Any, key: str, count: int) -> None:
        self.identity = "storage", kind, key, "cpu", count


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: Any) -> Any:
        return obj.identity if isinstance(obj, _Storage) else None


def pickled(content: Any, protocol: int = 2) -> bytes:
    """As ``torch.save`` pickles."""
    file = io.BytesIO()
    _Pickler(file, protocol).dump(content)
    return file.getvalue()


def tensor(storage: _Storage, size: tuple[int, ...], stride: tuple[int, ...]) -> _Call:
    """A tensor of any size over some bytes."""
    arguments = storage, 0, size, stride, False, OrderedDict()
    return _Call(torch._utils._rebuild_tensor_v2, *arguments)


def payloads(door: str, kind: str) -> Iterator[Case]:
    """Pickles that run a command, in each dress."""
    command = f"touch {MARKER}"
    for what, call in (
        ("os.system", _Call(os.system, command)),
        ("eval", _Call(eval, f"__import__('os').system({command!r})")),
        ("os.mkdir", _Call(os.mkdir, MARKER)),
    ):
        content = {"kind": kind, "features": call, "settings": call}
        for protocol in (0, 2, 4):
            raw = pickle.dumps(content, protocol)
            yield Case("payloads", f"{what}, pickle {protocol}", door, of_bytes(raw))
            zipped = of_zip({"data.pkl": raw})
            yield Case("payloads", f"{what}, zip, pickle {protocol}", door, zipped)
        file = io.BytesIO()
        torch.save(content, file, _use_new_zipfile_serialization=False)
        yield Case("payloads", f"{what}, torch's old format", door, of_bytes(file.getvalue()))


def hostile(door: str, kind: str) -> Iterator[Case]:
    """Small files that would take much memory or time, or read what is not theirs."""
    for name, make in _bombs(kind).items():
        yield Case("hostile files", name, door, make)
    single, huge = torch.FloatStorage, 10**12
    stored = _Storage(single, "0", 16)
    tensors: dict[str, Any] = {
        "expanded to 10^12": tensor(stored, (10**5, 10**4, 10**3), (0, 0, 0)),
        "more sizes than fit": tensor(stored, (2**40, 2**40, 2), (0, 0, 0)),
        "beyond its bytes": tensor(stored, (100, 2, 4), (8, 4, 1)),
        "claims more bytes than it has": tensor(_Storage(single, "0", 10**6), (10**6,), (1,)),
        "claims 4 TB": tensor(_Storage(single, "0", huge), (huge,), (1,)),
        "claims a part that is not there": tensor(_Storage(single, "9", 16), (16,), (1,)),
        "bytes of another type": tensor(_Storage(torch.DoubleStorage, "0", 16), (16,), (1,)),
        "negative sizes": tensor(stored, (-1, 2, 4), (8, 4, 1)),
        "makes 40 GB of bytes": _Call(bytearray, 40 * 10**9),
        "makes 40 GB of storage": _Call(torch.FloatStorage, 10**10),
    }
    values: dict[str, Callable[[], Any]] = {
        **{name: lambda value=value: value for name, value in tensors.items()},  # type: ignore[misc]
        "one list, 2^60 times": lambda: nested(60, 2),
        "lists in lists": lambda: nested(300, 1),
        "a number of a million digits": lambda: 1 << 3_000_000,
        "a text of 20 MB": lambda: "x" * 20_000_000,
        "a million lists": lambda: [[] for _ in range(10**6)],
    }
    for name, value in values.items():
        yield Case("hostile files", name, door, of_pickle(kind, value))
    deep = b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."
    yield Case("hostile files", "100,000 lists deep", door, of_zip({"data.pkl": deep}))


def nested(depth: int, copies: int) -> list[Any]:
    """A list in a list, so many deep, each there so many times."""
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner] * copies
    return inner


def _bombs(kind: str) -> dict[str, Make]:
    """Zips that unpack to more than they are, or that are more than they seem."""
    deflated = zipfile.ZIP_DEFLATED
    good = pickled({"kind": kind, "features": torch.Size((3,))})
    lying = io.BytesIO()
    with zipfile.ZipFile(lying, "w") as archive:
        archive.writestr("archive/data.pkl", good)
        archive.filelist[0].file_size = archive.filelist[0].compress_size = 10**11
    twice = io.BytesIO()
    with zipfile.ZipFile(twice, "w") as archive:
        archive.writestr("archive/data.pkl", good)
        archive.writestr("other/data.pkl", good)
    return {
        "bomb in the pickle": of_zip({"data.pkl": BOMB}, deflated),
        "bomb in a tensor": of_zip({"data.pkl": good, "data/0": BOMB}, deflated),
        "bomb in what nobody reads": of_zip({"data.pkl": good, "more": BOMB}, deflated),
        "a harmless one, compressed": of_zip({"data.pkl": good}, deflated),
        "a part of 10^11 bytes, it says": of_bytes(lying.getvalue()),
        "two pickles": of_bytes(twice.getvalue()),
        "no pickle": of_zip({"data/0": bytes(4)}),
        "40,000 parts": of_zip({"data.pkl": good, **{f"data/{i}": b"" for i in range(40_000)}}),
        "a part outside": of_zip({"data.pkl": good, "../../outside": b"x"}),
        "the other byte order": of_zip({"data.pkl": good, "byteorder": b"big"}),
    }


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
