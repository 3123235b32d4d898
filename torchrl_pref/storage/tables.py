"""Columns of numbers from files that strangers made, so that a hostile one does no harm.

A column holds one number for each of N trajectories, or K for each of N queries.

- ``.csv``: a header of names, then a line of numbers for each trajectory; UTF-8, commas.
- ``.parquet``: columns of numbers.
- ``.npz`` and ``.safetensors``: an array (N) or (N K) for each column; or one array ``features``,
  (N D) or (N K D), and the names of its columns in ``feature_names``: an array of texts in an NPZ,
  an entry of the metadata in Safetensors, with commas between them.

Nothing is unpickled. What a header claims is held against the bytes that are there before memory
is taken for it: a file of n bytes takes at most 100 n, or 64 MiB where that is more, and that is
with all texts, and with the copy by which a task puts columns together. A CSV takes less, whatever
is in it, as each cell of it has two letters or more.
"""

from __future__ import annotations

import csv
import math
import zipfile
from array import array
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch

from torchrl_pref.errors import InputError
from torchrl_pref.storage.columns import (
    ALWAYS,
    KIND,
    MAX_COLUMNS,
    NAMES,
    RATIO,
    Choice,
    Columns,
    Refused,
    Room,
    of_arrays,
)
from torchrl_pref.storage.files import MAX_FILE, PIECE, Piecewise, size_of
from torchrl_pref.storage.parquet import read_parquet


def read_columns(
    path: str | Path, wanted: Collection[str] | None = None, texts: str | None = None
) -> Columns:
    """Columns of finite numbers, and one of texts, from a file.

    Args:
        path: the file, of a kind that its ending tells.
        wanted: the columns of numbers; None: all but that of texts.
        texts: the column of texts; None: there is none.

    Raises:
        InputError: the file is missing, unreadable, spoiled or too large, or a column is missing,
            is there twice, or holds something else.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in READERS:
        raise InputError(
            f"path={path}: expected a file whose name ends in {', '.join(READERS)}; save it as one"
        )
    size = size_of(path, KIND)
    if size > MAX_FILE:
        raise InputError(
            f"{path}: a file of {size / 2**30:.1f} GiB; expected at most {MAX_FILE // 2**30} GiB; "
            "leave columns or trajectories out"
        )
    choice, limit = Choice(wanted, texts), min(2 * MAX_FILE, max(ALWAYS, RATIO * size))
    try:
        return _checked(READERS[suffix](str(path), limit, choice), choice)
    except ImportError as error:
        raise InputError(
            f"{path}: {error.name} is not installed; install it by "
            f"pip install -c constraints.txt -e '.[{suffix[1:]}]'"
        ) from None
    except Refused as error:
        raise InputError(f"{path}: {error}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not in UTF-8; save it as UTF-8") from None
    except Exception as error:  # whatever the reader trips over, the file is at fault
        raise InputError(
            f"{path}: cannot be read as {suffix} (cut off, spoiled, or something else: "
            f"{type(error).__name__}: {error!s:.200}); save it again or restore a copy"
        ) from error


def _checked(columns: Columns, choice: Choice) -> Columns:
    """The columns, those of numbers as float64.

    Raises:
        Refused: they differ in shape, or hold what is no finite number.
    """
    shape = next(iter(columns.values())).shape if columns else (0,)
    if len(shape) in (1, 2) and shape[0] == 0:
        raise Refused("holds no trajectories; expected names, and a line of numbers for each")
    if len(shape) not in (1, 2) or 0 in shape:
        raise Refused(f"columns of shape {shape}; expected (N) or (N, K), with N at least 1")
    checked: Columns = {}
    for name, values in columns.items():
        if values.shape != shape:
            raise Refused(f"column {name!r} of shape {values.shape}; expected {shape}, as others")
        if name == choice.texts:
            if values.dtype.kind not in "UO":
                raise Refused(f"column {name!r} holds {values.dtype}; expected texts")
            checked[name] = values
            continue
        if values.dtype.kind not in "biuf":
            raise Refused(
                f"column {name!r} holds {values.dtype}; expected numbers; name those that do by "
                "columns=[…]"
            )
        checked[name] = values.astype(np.float64, copy=False)
        bad = np.argwhere(~np.isfinite(checked[name]))
        if len(bad):
            raise Refused(
                f"column {name!r} holds NaN or infinity in row {bad[0][0] + 1} (and {len(bad) - 1} "
                "more); expected finite numbers; mend or remove these rows"
            )
    return checked


def _csv(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a CSV."""
    numbers, named, room = array("d"), [], Room(limit)
    with open(path, encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(_lines(file), strict=True)
        header = [name.strip() for name in next(lines, [])]
        other = [
            name for mark, name in SEPARATORS.items() if len(header) == 1 and mark in header[0]
        ]
        if other:
            raise Refused(f"has {other[0]} between its columns; expected commas; save it so")
        if header and all(is_number(name) for name in header):
            raise Refused(
                f"has no names in its first line ({', '.join(header)!s:.80}); expected a header of "
                "names, with commas"
            )
        chosen = [name for name in choice.pick(header) if name != choice.texts]
        if nameless := [name for name in chosen if not name.strip()]:
            place = header.index(nameless[0]) + 1
            raise Refused(f"column {place} has no name in the first line; name it, or remove it")
        places = [header.index(name) for name in chosen]
        named_in = None if choice.texts is None else header.index(choice.texts)
        for cells in lines:
            if not cells:
                continue
            if len(cells) != len(header):
                raise Refused(
                    f"line {lines.line_num} has {len(cells)} cells; expected {len(header)}, as in "
                    "the header; mend it"
                )
            for name, place in zip(chosen, places, strict=True):
                try:
                    numbers.append(_number(cells[place]))
                except ValueError:
                    raise Refused(
                        f"line {lines.line_num} has {cells[place]!r:.40} in column {name!r:.80}; "
                        "expected a number; mend it, or name those of numbers by columns=[…], "
                        "one of images by images="
                    ) from None
            if named_in is not None:
                named.append(room.text(header[named_in], cells[named_in].strip()))
    table = np.array(numbers).reshape(-1, len(chosen)) if chosen else np.empty((len(named), 0))
    columns: Columns = {name: table[:, place] for place, name in enumerate(chosen)}
    if choice.texts is not None:
        columns[choice.texts] = np.array(named, dtype=object)
    return columns


SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}


def is_number(text: str) -> bool:
    """Whether it is a number and no name."""
    try:
        _number(text)
    except ValueError:
        return False
    return True


def _number(text: str) -> float:
    """The number that a cell is; Python would read 1_000 as one, too."""
    if "_" in text:
        raise ValueError(text)
    return float(text)


def _lines(file: TextIO) -> Iterator[str]:
    """The lines of a file, none of which is too long."""
    while line := file.readline(PIECE):
        if len(line) == PIECE:
            raise Refused(f"a line of more than {PIECE} letters; expected a table; is it one?")
        yield line


def _npz(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of an NPZ, which is a zip of arrays."""
    with Piecewise(path) as file, zipfile.ZipFile(file) as archive:
        members = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
        if len(members) != len(archive.infolist()):
            raise Refused("holds two arrays of one name; save it again")
        unpacked = sum(one.file_size for one in members.values())
        if unpacked > limit:
            raise Refused(
                f"would unpack to {unpacked / 1e6:.0f} MB; expected at most {limit / 1e6:.0f} MB "
                "from a file of its size; save it by numpy.savez, which does not pack"
            )

        room = Room(limit)

        def load(name: str) -> np.ndarray[Any, Any]:
            values = _array(archive, members[name], name, room)
            if values.dtype.kind != "U":
                return values.astype(np.float64, copy=False)
            if name != choice.texts:
                return values
            kept = [room.text(name, str(text)) for text in values.flat]
            return np.array(kept, object).reshape(values.shape)

        labels = load(NAMES).tolist() if NAMES in members else None
        return of_arrays([name for name in members if name != NAMES], load, labels, choice)


def _array(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, room: Room
) -> np.ndarray[Any, Any]:
    """One array of an NPZ, once its header fits the bytes that are there and the limit.

    Raises:
        Refused: it does not, or the array is one of Python objects, which is a pickle.
    """
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        else:  # a later one is refused by NumPy
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
        if dtype.hasobject or dtype.kind not in "biufU":
            raise Refused(
                f"array {name!r:.80} holds {dtype}; expected numbers, or texts as names; Python "
                "objects are pickles, which are never read"
            )
        # Of texts in several dimensions a list would be made of lists, which take more.
        too_many = name == NAMES and (len(shape) != 1 or shape[0] > MAX_COLUMNS)
        if not dtype.itemsize or too_many:
            raise Refused(
                f"array {name!r:.80} of shape {shape} holds {dtype}; expected numbers, or a row "
                f"of at most {MAX_COLUMNS} names"
            )
        if math.prod(shape) * dtype.itemsize + file.tell() != member.file_size:
            raise Refused(
                f"array {name!r:.80} says that it is {shape} of {dtype}, and {member.file_size} "
                "bytes are there; save it again"
            )
    room.take(name, math.prod(shape))
    if dtype.kind == "U":  # as long as the longest of them, each
        room.take_bytes(f"the texts of column {name!r:.80}", member.file_size)
    with archive.open(member) as file:
        values: np.ndarray[Any, Any] = np.lib.format.read_array(file, allow_pickle=False)
        file.read(1)  # the end, where the checksum is compared
    return values


def _safetensors(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a Safetensors file; the library holds its header against its bytes."""
    from safetensors import safe_open

    room = Room(limit)
    with safe_open(path, framework="pt") as file:

        def load(name: str) -> np.ndarray[Any, Any]:
            room.take(name, math.prod(file.get_slice(name).get_shape()))
            tensor = file.get_tensor(name)
            values: np.ndarray[Any, Any] = tensor.to(torch.float64, copy=True).numpy()
            return values

        labels = (file.metadata() or {}).get(NAMES)
        named = None if labels is None else [name.strip() for name in labels.split(",")]
        return of_arrays(list(file.keys()), load, named, choice)


READERS: dict[str, Callable[[str, int, Choice], Columns]] = {
    ".npz": _npz,
    ".csv": _csv,
    ".parquet": read_parquet,
    ".safetensors": _safetensors,
}
"""By ending: from a path, the bytes that it may unpack to, and the columns to read."""
