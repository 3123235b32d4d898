"""Files that are made to do harm: payloads, bombs, and pickles that claim what is not there.

See ``spoil.py``.
"""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from benchmarks.spoil import BOMB, MARKER, Case, Make, of_bytes, of_zip


class Call:
    """What unpickles by a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


class Storage:
    """What unpickles as bytes of a part of the zip, as many as it says."""

    def __init__(self, kind: Any, key: str, count: int) -> None:
        self.identity = "storage", kind, key, "cpu", count


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj: Any) -> Any:
        return obj.identity if isinstance(obj, Storage) else None


def pickled(content: Any, protocol: int = 2) -> bytes:
    """As ``torch.save`` pickles."""
    file = io.BytesIO()
    _Pickler(file, protocol).dump(content)
    return file.getvalue()


def of_pickle(kind: str, value: Callable[[], Any]) -> Make:
    """Such a zip whose pickle has a value where features or settings are looked for."""

    def make(folder: Path) -> Path:
        made = value()
        content = {"kind": kind, "features": made, "settings": made, "format": made}
        return of_zip({"data.pkl": pickled(content), "data/0": bytes(64)})(folder)

    return make


def tensor(storage: Storage, size: tuple[int, ...], stride: tuple[int, ...]) -> Call:
    """A tensor of any size over some bytes."""
    arguments = storage, 0, size, stride, False, OrderedDict()
    return Call(torch._utils._rebuild_tensor_v2, *arguments)


def payloads(door: str, kind: str) -> Iterator[Case]:
    """Pickles that run a command, in each dress."""
    command = f"touch {MARKER}"
    for what, call in (
        ("os.system", Call(os.system, command)),
        ("eval", Call(eval, f"__import__('os').system({command!r})")),
        ("os.mkdir", Call(os.mkdir, MARKER)),
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
    stored = Storage(single, "0", 16)
    tensors: dict[str, Any] = {
        "expanded to 10^12": tensor(stored, (10**5, 10**4, 10**3), (0, 0, 0)),
        "more sizes than fit": tensor(stored, (2**40, 2**40, 2), (0, 0, 0)),
        "beyond its bytes": tensor(stored, (100, 2, 4), (8, 4, 1)),
        "claims more bytes than it has": tensor(Storage(single, "0", 10**6), (10**6,), (1,)),
        "claims 4 TB": tensor(Storage(single, "0", huge), (huge,), (1,)),
        "claims a part that is not there": tensor(Storage(single, "9", 16), (16,), (1,)),
        "bytes of another type": tensor(Storage(torch.DoubleStorage, "0", 16), (16,), (1,)),
        "negative sizes": tensor(stored, (-1, 2, 4), (8, 4, 1)),
        "makes 40 GB of bytes": Call(bytearray, 40 * 10**9),
        "makes 40 GB of storage": Call(torch.FloatStorage, 10**10),
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
