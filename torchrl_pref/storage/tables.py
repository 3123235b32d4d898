"""Columns of numbers from files that strangers made, so that a hostile one does no harm.

A column holds one number for each of N trajectories, or K for each of N queries.

- ``.csv``: a header of names, then a line of numbers for each trajectory; UTF-8, commas.
- ``.parquet``: columns of numbers.
- ``.npz`` and ``.safetensors``: an array (N) or (N K) for each column; or one array ``features``,
  (N D) or (N K D), and the names of its columns in ``feature_names``: an array of texts in an NPZ,
  an entry of the metadata in Safetensors, with commas between them.

Nothing is unpickled. What a header claims is held against the bytes that are there before memory
is taken for it: a file of n bytes unpacks to at most 100 n, or 64 MiB where that is more.
"""

from __future__ import annotations

import csv
import math
import zipfile
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO, TypeAlias

import numpy as np
import torch

from torchrl_pref.errors import InputError
from torchrl_pref.storage.files import MAX_FILE, PIECE, Piecewise, size_of
from torchrl_pref.tensors import default_names

Columns: TypeAlias = dict[str, "np.ndarray[Any, Any]"]
"""By name, numbers or texts (N) or (N K)."""

RATIO, ALWAYS = 100, 2**26
"""A file may unpack to so many times its size, and always to so many bytes."""

ARRAY = "features"
NAMES = "feature_names"

KIND = "file of features"


MAX_COLUMNS = 10_000


class Refused(Exception):
    """Why a file is refused, without its path."""


class Choice(NamedTuple):
    """Which columns are read."""

    wanted: Collection[str] | None
    """Those of numbers; None: all but that of texts."""
    texts: str | None
    """That of texts; None: there is none."""

    def pick(self, there: Sequence[str]) -> list[str]:
        """The names to read, of those that are there.

        Raises:
            Refused: one is there twice, or is not there, or there are too many.
        """
        if len(there) > MAX_COLUMNS:
            raise Refused(f"holds {len(there)} columns; expected at most {MAX_COLUMNS}")
        for name, count in Counter(there).items():
            if count > 1:
                raise Refused(f"holds the column {name!r:.80} twice; rename one")
        wanted = list(there if self.wanted is None else self.wanted)
        if self.texts is not None:
            wanted = [name for name in wanted if name != self.texts] + [self.texts]
        missing = [name for name in wanted if name not in there]
        if missing:
            raise Refused(
                f"holds no column {missing[0]!r:.80}; expected one of {', '.join(there)!s:.300}"
            )
        return wanted


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
    choice, limit = Choice(wanted, texts), min(MAX_FILE, max(ALWAYS, RATIO * size))
    try:
        return _checked(READERS[suffix](str(path), limit, choice), choice)
    except ImportError as error:
        raise InputError(
            f"{path}: {error.name} is not installed; install it by "
            f"pip install -c constraints.txt -e '.[{suffix[1:]}]'"
        ) from None
    except Refused as error:
        raise InputError(f"{path}: {error}") from None
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
        checked[name] = values.astype(np.float64)
        bad = np.argwhere(~np.isfinite(checked[name]))
        if len(bad):
            raise Refused(
                f"column {name!r} holds NaN or infinity in row {bad[0][0] + 1} (and {len(bad) - 1} "
                "more); expected finite numbers; mend or remove these rows"
            )
    return checked


def _csv(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a CSV."""
    numbers, named = array("d"), []
    with open(path, encoding="utf-8-sig", newline="") as file:
        lines = csv.reader(_lines(file), strict=True)
        header = [name.strip() for name in next(lines, [])]
        chosen = [name for name in choice.pick(header) if name != choice.texts]
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
                    numbers.append(float(cells[place]))
                except ValueError:
                    raise Refused(
                        f"line {lines.line_num} has {cells[place]!r:.40} in column {name!r:.80}; "
                        "expected a number; mend it, or name the columns of numbers by columns=[…]"
                    ) from None
            if named_in is not None:
                named.append(cells[named_in].strip())
    table = np.array(numbers).reshape(-1, len(chosen)) if chosen else np.empty((len(named), 0))
    columns: Columns = {name: table[:, place] for place, name in enumerate(chosen)}
    if choice.texts is not None:
        columns[choice.texts] = np.array(named, dtype=object)
    return columns


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

        def load(name: str) -> np.ndarray[Any, Any]:
            return _array(archive, members[name], name)

        labels = load(NAMES).tolist() if NAMES in members else None
        return _of_arrays([name for name in members if name != NAMES], load, labels, choice)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> np.ndarray[Any, Any]:
    """One array of an NPZ, once its header fits the bytes that are there.

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
        if math.prod(shape) * dtype.itemsize + file.tell() != member.file_size:
            raise Refused(
                f"array {name!r:.80} says that it is {shape} of {dtype}, and {member.file_size} "
                "bytes are there; save it again"
            )
    with archive.open(member) as file:
        values: np.ndarray[Any, Any] = np.lib.format.read_array(file, allow_pickle=False)
        file.read(1)  # the end, where the checksum is compared
    return values


def _safetensors(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a Safetensors file; the library holds its header against its bytes."""
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:

        def load(name: str) -> np.ndarray[Any, Any]:
            tensor = file.get_tensor(name)
            values: np.ndarray[Any, Any] = tensor.to(torch.float64, copy=True).numpy()
            return values

        labels = (file.metadata() or {}).get(NAMES)
        named = None if labels is None else [name.strip() for name in labels.split(",")]
        return _of_arrays(list(file.keys()), load, named, choice)


def _of_arrays(
    there: list[str],
    load: Callable[[str], np.ndarray[Any, Any]],
    labels: list[str] | None,
    choice: Choice,
) -> Columns:
    """Columns from arrays: each is one, or one holds them all."""
    if ARRAY not in there:
        return {name: load(name) for name in choice.pick(there)}
    features = load(ARRAY)
    if features.ndim not in (2, 3) or features.shape[-1] > MAX_COLUMNS:
        raise Refused(
            f"{ARRAY} of shape {features.shape}; expected (N trajectories, D) or "
            f"(N queries, K options, D), with D at most {MAX_COLUMNS}"
        )
    names = default_names(features.shape[-1]) if labels is None else labels
    if not isinstance(names, (list, tuple)) or len(names) != features.shape[-1]:
        raise Refused(f"{NAMES} of other length than the {features.shape[-1]} features")
    names = [str(name) for name in names]
    beside = [name for name in there if name == choice.texts]
    chosen = choice.pick([*names, *beside])
    return {
        name: features[..., names.index(name)] if name in names else load(name) for name in chosen
    }


def _parquet(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a Parquet file."""
    import pyarrow.parquet as parquet
    from pyarrow import types

    texts = [] if choice.texts is None else [choice.texts]
    # Texts that come again and again are kept once, so that few bytes cannot become many.
    with parquet.ParquetFile(path, read_dictionary=texts) as file:
        schema, metadata = file.schema_arrow, file.metadata
        # Pandas writes its row labels as a column.
        there = [name for name in schema.names if not name.startswith("__index_level_")]
        chosen = choice.pick(there)
        for name in chosen:
            kind = schema.field(name).type
            number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
            if not number and name != choice.texts:
                raise Refused(
                    f"column {name!r} holds {kind!s:.40}; expected numbers; name those that do by "
                    "columns=[…]"
                )
        groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
        claimed = sum(group.total_byte_size for group in groups)
        claimed = max(claimed, 8 * metadata.num_rows * len(chosen))
        if not 0 <= claimed <= limit:
            raise Refused(
                f"says that it unpacks to {claimed / 1e6:.0f} MB; expected at most "
                f"{limit / 1e6:.0f} MB from a file of its size"
            )
        table = file.read(columns=chosen, use_threads=False)
    missing = [name for name in chosen if table.column(name).null_count]
    if missing:
        raise Refused(f"column {missing[0]!r} lacks values; expected a number in each row")
    columns: Columns = {}
    for name in chosen:
        column = table.column(name)
        if name == choice.texts:
            values: list[str] = []
            for chunk in column.chunks:
                once = chunk.dictionary.to_pylist()
                values += [once[code] for code in chunk.indices.to_pylist()]
            columns[name] = np.array(values, dtype=object)
        else:
            columns[name] = column.to_numpy()
    return columns


READERS: dict[str, Callable[[str, int, Choice], Columns]] = {
    ".npz": _npz,
    ".csv": _csv,
    ".parquet": _parquet,
    ".safetensors": _safetensors,
}
"""By ending: from a path, the bytes that it may unpack to, and the columns to read."""
