"""Files of plain data and tensors, read so that a spoiled, foreign or hostile one does no harm.

Such a file is what ``torch.save`` writes: a zip of one pickle and of the bytes of each tensor.
Before torch reads it,

- the checksum of every part is compared, so that a flipped bit is refused or changes nothing;
- nothing in it may be compressed, so that it unpacks to no more than its own size;
- the pickle is read instruction by instruction without being run: it may only build what this
  package writes, and may name no tensor of another size than the bytes that are there.

What was checked is then put into a new zip in memory, and that is what ``torch.load`` reads, with
``weights_only=True``: two readers of one zip need not agree on what is in it. Reading takes memory
of about three times the file's size.
"""

from __future__ import annotations

import io
import os
import pickletools
import shutil
import stat
import zipfile
from collections import deque
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_pref.errors import InputError

MAX_FILE = 4 * 2**30
"""Bytes of the largest file that is read."""

PIECE = 2**20
"""Bytes read at once; the zip's directory must be smaller, which is room for 10,000 tensors."""

MAX_PICKLE = 2**28
"""Bytes of the pickle, room for the history of millions of updates; a number takes 32 in memory."""

MAX_OBJECTS = 200_000
"""Instructions of the pickle, numbers of a training's history apart: each costs some 100 bytes."""

STORAGES = {
    "torch BoolStorage": 1,
    "torch ByteStorage": 1,
    "torch CharStorage": 1,
    "torch ShortStorage": 2,
    "torch HalfStorage": 2,
    "torch BFloat16Storage": 2,
    "torch IntStorage": 4,
    "torch FloatStorage": 4,
    "torch LongStorage": 8,
    "torch DoubleStorage": 8,
}
"""Bytes of one number, by the name that the pickle has for its type."""

DTYPES = frozenset(
    getattr(torch, name)
    for name in (
        *("bool", "uint8", "int8", "int16", "int32", "int64"),
        *("float16", "bfloat16", "float32", "float64"),
    )
)
"""Types of the tensors that can be in a file."""

GLOBALS = {*STORAGES, "torch._utils _rebuild_tensor_v2", "collections OrderedDict"}

PUTS, GETS = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}
WHOLE = {"BININT", "BININT1", "BININT2", "LONG1"}
ATOMS = {*WHOLE, "BINUNICODE", "GLOBAL"}
INSTRUCTIONS = {
    *(*PUTS, *GETS, *ATOMS, "BINFLOAT", "NONE", "NEWTRUE", "NEWFALSE"),
    *("EMPTY_DICT", "EMPTY_LIST", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "MARK"),
    *("SETITEM", "SETITEMS", "APPEND", "APPENDS", "BINPERSID", "REDUCE", "STOP"),
}


def load_safely(path: str | Path, kind: str) -> dict[str, Any]:
    """Read plain data and tensors from a file that says of which kind it is.

    Args:
        path: the file.
        kind: what its key ``kind`` must say.

    Raises:
        InputError: the file is missing, unreadable, spoiled, or of another kind.
    """
    size = size_of(path, kind)
    if size > MAX_FILE:
        raise InputError(
            f"{path}: a file of {size / 2**30:.1f} GiB; expected a {kind} of at most "
            f"{MAX_FILE // 2**30} GiB; split it, or leave the trajectories out"
        )
    try:
        with Piecewise(path) as file:
            checked = _checked_copy(file, size)
        content = torch.load(checked, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the reader trips over, the file is at fault
        raise InputError(
            f"{path}: cannot be read as a {kind} (cut off, spoiled, or not a file of plain "
            "tensors); expected a file written by this package; make it again or restore a copy"
        ) from error
    found = content.get("kind") if isinstance(content, dict) else None
    if found != kind:
        named = found[:80] if isinstance(found, str) and found else "something else"
        raise InputError(f"{path}: holds {named}; expected a {kind}")
    return content


def is_dense(tensor: Any) -> bool:
    """Whether something is a tensor that is no larger than the memory behind it.

    A few bytes can be expanded to a tensor of any size; a copy of it would take that size.
    """
    if not isinstance(tensor, Tensor) or tensor.layout != torch.strided:
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def without_rest(tensor: Tensor) -> Tensor:
    """The tensor, copied if it is a view of a larger one: a file would hold all of that."""
    whole = tensor.numel() * tensor.element_size() == tensor.untyped_storage().nbytes()
    return tensor if whole else tensor.clone(memory_format=torch.contiguous_format)


def size_of(path: str | Path, kind: str) -> int:
    """The size of a regular file, in bytes."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a {kind}; check the path") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"{path}: cannot be opened ({reason}); expected a {kind}; check the path"
        ) from None
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "a device or a pipe"
        raise InputError(f"{path}: is {what}; expected a {kind}, a file; check the path")
    return status.st_size


class Piecewise(io.FileIO):
    """A file that is never read in large pieces, so that nothing in it decides how large."""

    def read(self, size: int | None = -1, /) -> bytes:
        """At most ``PIECE`` bytes; more cannot be asked for."""
        wanted = PIECE + 1 if size is None or size < 0 else size
        data = super().read(min(wanted, PIECE + 1))
        if len(data) > PIECE:
            raise zipfile.BadZipFile("its directory is too large")
        return data


def _checked_copy(file: Piecewise, size: int) -> io.BytesIO:
    """A new zip in memory with what torch needs of the old one, once all of it has been checked."""
    copy = io.BytesIO()
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(copy, "w") as new:
        members = {member.filename.partition("/")[2]: member for member in old.infolist()}
        sizes = {name: member.file_size for name, member in members.items()}
        packed = [m for m in old.infolist() if m.compress_type or m.file_size != m.compress_size]
        if packed or len(members) != len(old.infolist()) or sum(sizes.values()) > size:
            raise zipfile.BadZipFile("its parts are compressed, or named or stored twice")
        if sizes["data.pkl"] > MAX_PICKLE:
            raise zipfile.BadZipFile("its pickle is too large")
        for name, member in members.items():
            # Reading a member to its end compares its checksum.
            with old.open(member) as source:
                if name in ("data.pkl", "version", "byteorder") or name.startswith("data/"):
                    with new.open(f"archive/{name}", "w", force_zip64=True) as target:
                        shutil.copyfileobj(source, target, PIECE)
                else:
                    while source.read(PIECE):
                        pass
    with zipfile.ZipFile(copy) as new:
        _check_pickle(new.read("archive/data.pkl"), sizes)
    copy.seek(0)
    return copy


def _check_pickle(data: bytes, sizes: dict[str, int]) -> None:
    """Refuse a pickle that does anything else than those of this package.

    Args:
        data: the pickle.
        sizes: bytes of each part of the zip, by name.

    Raises:
        ValueError: it builds something else, too much, or tensors of bytes that are not there.
    """
    last: deque[tuple[str, Any]] = deque([("", None)], maxlen=7)
    memo: dict[int, tuple[str, Any]] = {}
    storages = loaded = objects = 0
    argument: Any
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        objects += name != "BINFLOAT"
        known = name in INSTRUCTIONS or (count, name, argument) == (0, "PROTO", 2)
        if not known or objects > MAX_OBJECTS or (name == "GLOBAL" and argument not in GLOBALS):
            raise ValueError(f"{name} {argument!r:.80}: not what this package writes")
        if name in PUTS:
            memo[argument] = last[-1]
            continue
        token = (name, argument)
        if name in GETS and memo[argument][0] in ATOMS:
            token = memo[argument]
        storages += token[0] == "GLOBAL" and token[1] in STORAGES
        if name == "BINPERSID":
            _check_storage(list(last), sizes)
            loaded += 1
        last.append(token)
    if storages != loaded:
        raise ValueError("a type of storage is used for something else than to load one")


def _check_storage(last: list[tuple[str, Any]], sizes: dict[str, int]) -> None:
    """Refuse to load bytes unless the seven instructions before name a part of its own size."""
    names = [name for name, _ in last]
    if names[:5] != ["MARK", "BINUNICODE", "GLOBAL", "BINUNICODE", "BINUNICODE"] or (
        names[5] not in WHOLE or names[6] != "TUPLE" or last[1][1] != "storage"
    ):
        raise ValueError("bytes are loaded in another way than by this package")
    storage, key, count = last[2][1], last[3][1], last[5][1]
    if sizes.get(f"data/{key}") != count * STORAGES.get(storage, 0):
        raise ValueError(f"part {key} has another size than its tensor")
