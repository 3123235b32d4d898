"""Columns from files: what is written is read, and what is spoiled or hostile is refused."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from safetensors.numpy import save_file

from torchrl_pref.errors import InputError
from torchrl_pref.storage.columns import MAX_COLUMNS
from torchrl_pref.storage.tables import read_columns

X = np.random.default_rng(0).normal(size=(40, 3))
NAMES = ("speed", "lane", "jerk")
BY_NAME = dict(zip(NAMES, X.T, strict=True))
PATHS = ["one.png", "two.png"] * 20
RAN = "it_ran"
"""A file that hostile code would make."""


class Code:
    """Runs when it is unpickled."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return Path.touch, (Path(RAN),)  # type: ignore[return-value]


def csv_text(rows: np.ndarray = X, header: str = ",".join(NAMES)) -> str:
    return "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"


def table(**more: object) -> pa.Table:
    return pa.table({**BY_NAME, **more})


def write_columns(path: Path) -> None:
    if path.suffix == ".csv":
        path.write_text(csv_text())
    elif path.suffix == ".npz":
        np.savez(path, **BY_NAME)
    elif path.suffix == ".parquet":
        parquet.write_table(table(), path)
    else:
        save_file({name: np.ascontiguousarray(x) for name, x in BY_NAME.items()}, path)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".safetensors"])
def test_columns_come_as_they_were_written(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"x{suffix}"
    write_columns(path)
    found = read_columns(path)
    assert {name: x.tolist() for name, x in found.items()} == {
        name: x.tolist() for name, x in BY_NAME.items()
    }
    some = read_columns(path, ["jerk", "speed"])
    assert [(name, x.tolist()) for name, x in some.items()] == [
        (name, BY_NAME[name].tolist()) for name in ("jerk", "speed")
    ]
    for wanted in (["speed", "weight"], ["speed", ""]):
        with pytest.raises(InputError, match="holds no column"):
            read_columns(path, wanted)


@pytest.mark.parametrize("shape", [(40, 3), (20, 2, 3)])
def test_one_array_of_all_features(shape: tuple[int, ...], tmp_path: Path) -> None:
    features = X.reshape(shape).astype(np.float32)
    np.savez_compressed(tmp_path / "x.npz", features=features, feature_names=np.array(NAMES))
    named = {"feature_names": "speed,lane, jerk"}
    save_file({"features": features}, tmp_path / "x.safetensors", named)
    np.savez(tmp_path / "plain.npz", features=features, other=np.zeros(7))
    for name, names in (
        ("x.npz", NAMES),
        ("x.safetensors", NAMES),
        ("plain.npz", ("feature 1", "feature 2", "feature 3")),
    ):
        found = read_columns(tmp_path / name)
        assert tuple(found) == names
        assert np.array_equal(np.stack(list(found.values()), -1), features)


def test_a_column_of_texts(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", features=X, clip=np.array(PATHS))
    parquet.write_table(table(clip=PATHS), tmp_path / "x.parquet")
    ends = ["clip", *PATHS]
    lines = [f"{line},{end}" for line, end in zip(csv_text().split(), ends, strict=True)]
    (tmp_path / "x.csv").write_text("\ufeff" + "\r\n".join(lines), encoding="utf-8")
    for name in ("x.npz", "x.parquet", "x.csv"):
        found = read_columns(tmp_path / name, texts="clip")
        assert found["clip"].tolist() == PATHS
        assert len(found) == 4


def npz(**arrays: object) -> bytes:
    """An NPZ; of Python objects, pickled."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def zipped(members: dict[str, bytes], packed: bool = False) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if packed else 0) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def npy(shape: tuple[int, ...], content: bytes = b"", dtype: str = "<f8") -> bytes:
    """An array whose header claims a shape, whatever follows."""
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def lying_zip() -> bytes:
    """A small zip whose directory claims an array of 3 GB."""
    data = bytearray(zipped({"speed.npy": npy((4,), bytes(32)), "lane.npy": npy((4,), bytes(32))}))
    place = data.index(b"PK\x01\x02")
    data[place + 24 : place + 28] = struct.pack("<I", 3 * 10**9)
    return bytes(data)


def safetensors(header: object, content: bytes = b"", length: int | None = None) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + content


def of(rows: int, begin: int, end: int) -> dict[str, object]:
    return {"dtype": "F64", "shape": [rows], "data_offsets": [begin, end]}


def parquet_bytes(made: pa.Table, **options: object) -> bytes:
    file = io.BytesIO()
    parquet.write_table(made, file, **options)
    return file.getvalue()


def varint(number: int) -> bytes:
    """A whole number of 0 or more, as Thrift's compact protocol writes it."""
    doubled, found = 2 * number, []
    while doubled > 0x7F:
        found.append(doubled & 0x7F | 0x80)
        doubled >>= 7
    return bytes([*found, doubled])


def with_other_footer(data: bytes, instead: dict[int, int]) -> bytes:
    """A Parquet file whose footer says other numbers."""
    (length,) = struct.unpack("<I", data[-8:-4])
    body, footer = data[: -8 - length], data[-8 - length : -8]
    for there, claimed in instead.items():
        assert varint(there) in footer
        footer = footer.replace(varint(there), varint(claimed))
    return body + footer + struct.pack("<I", len(footer)) + b"PAR1"


def lying_parquet(claimed: int) -> bytes:
    """A small file whose footer claims more rows."""
    rows = 12345  # whose bytes stand for nothing else in the footer
    data = parquet_bytes(pa.table(dict.fromkeys("ab", np.arange(float(rows)))))
    return with_other_footer(data, {rows: claimed})


def large_pages() -> bytes:
    """A small file with a page of 240 MB in each column, of which its footer says nothing."""
    rows = 3 * 10**7
    data = parquet_bytes(
        pa.table(dict.fromkeys("ab", np.zeros(rows))),
        compression="zstd",
        use_dictionary=False,
        store_schema=False,
        write_statistics=False,
        row_group_size=rows,
        write_batch_size=rows,
        data_page_size=2**30,
        max_rows_per_page=rows,
    )
    group = parquet.ParquetFile(io.BytesIO(data)).metadata.row_group(0)
    column = group.column(0).total_uncompressed_size
    return with_other_footer(data, {rows: 100, column: 800, group.total_byte_size: 1600})


def with_nan() -> np.ndarray:
    spoiled = X.copy()
    spoiled[6, 1] = np.nan
    return spoiled


def bomb() -> bytes:
    """300 MB of zeros in some 300 kB."""
    file = io.BytesIO()
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
        archive.open("speed.npy", "w", force_zip64=True) as member,
    ):
        member.write(npy((3 * 10**8 // 8,)))
        for _ in range(300):
            member.write(bytes(10**6))
    return file.getvalue()


BAD: dict[str, tuple[str, Callable[[], bytes | str], str]] = {
    "csv: no name": (".csv", lambda: "a,\n1,2\n3,4\n", "column 2 has no name"),
    "csv: 1_000": (".csv", lambda: "a,b\n1,1_000\n3,4\n", "'1_000' in column 'b'"),
    "npz: many empty names": (
        ".npz",
        lambda: npz(features=X, feature_names=np.empty(10**7, "<U0")),
        "expected numbers",
    ),
    "npz: many names of no length": (
        ".npz",
        lambda: zipped({"feature_names.npy": npy((10**4, 0), dtype="<U9"), "a.npy": npy((2,))}),
        "a row of at most",
    ),
    "npz: columns that grow together": (
        ".npz",
        lambda: zipped(
            {f"{name}.npy": npy((10**6,), bytes(10**6), "<u1") for name in "abcdefghi"}, True
        ),
        "it would take 80 MB; expected at most",
    ),
    "npz: small numbers that grow": (
        ".npz",
        lambda: zipped({"features.npy": npy((2**22 + 1, 1), bytes(2**22 + 1), "|u1")}, packed=True),
        "would take 67 MB",
    ),
    "csv: nothing": (".csv", lambda: "", "holds no trajectories"),
    "csv: header alone": (".csv", lambda: "speed,lane\n", "holds no trajectories"),
    "csv: no header": (".csv", lambda: "1,2.5\n3,4\n", "no names in its first line"),
    "csv: Latin-1": (".csv", lambda: "länge,b\n1,2\n".encode("latin-1"), "save it as UTF-8"),
    "csv: NaN": (".csv", lambda: csv_text(with_nan()), "'lane' holds NaN or infinity in row 7"),
    "csv: infinite": (".csv", lambda: "a,b\n1,2\n1,1e999\n", "'b' holds NaN or infinity in row 2"),
    "csv: empty cell": (".csv", lambda: "a,b\n1,2\n1,\n", "line 3 has '' in column 'b'"),
    "csv: words": (".csv", lambda: "a,b\n1,fast\n", "'fast' in column 'b'"),
    "csv: ragged": (".csv", lambda: "a,b\n1,2\n3\n", "line 3 has 1 cells"),
    "csv: cut off": (".csv", lambda: csv_text()[: -len("0.123,") * 8], "cells|shape"),
    "csv: two of one name": (".csv", lambda: "a,b, a\n1,2,3\n", "'a' twice"),
    "csv: no comma": (".csv", lambda: "a;b\n1;2\n", "has semicolons between"),
    "csv: tabs": (".csv", lambda: "a\tb\n1\t2\n", "has tabs between its columns; expected commas"),
    "csv: a zip": (".csv", lambda: npz(**BY_NAME), "cannot be read|letters|column|cells|UTF-8"),
    "csv: zeros": (".csv", lambda: bytes(2**22), "cannot be read|letters"),
    "csv: one line": (".csv", lambda: "1," * 2**21, "a line of more than"),
    "csv: many columns": (".csv", lambda: ",".join(map(str, range(MAX_COLUMNS + 1))), "no names"),
    "csv: open quote": (".csv", lambda: 'a,b\n1,"2\n' + "1,2\n" * 10**5, "cannot be read"),
    "npz: cut off": (".npz", lambda: npz(**BY_NAME)[:-40], "cannot be read"),
    "npz: text": (".npz", lambda: csv_text(), "cannot be read"),
    "npz: NaN": (".npz", lambda: npz(features=with_nan()), "'feature 2' holds NaN"),
    "npz: a pickle": (".npz", lambda: npz(a=np.array([Code(), 1]), b=X), "never read"),
    "npz: a pickle as names": (
        ".npz",
        lambda: npz(features=X, feature_names=np.array([Code(), 1, 2])),
        "never read",
    ),
    "npz: structured": (
        ".npz",
        lambda: npz(a=np.zeros(4, "f8,i4"), b=X[:4, 0]),
        "expected numbers",
    ),
    "npz: complex": (".npz", lambda: npz(a=X[:, 0] + 1j, b=X[:, 0]), "expected numbers"),
    "npz: texts": (".npz", lambda: npz(a=np.array(PATHS), b=X[:, 0]), "'a' holds"),
    "npz: other lengths": (".npz", lambda: npz(a=X[:, 0], b=X[:7, 0]), "shape"),
    "npz: four dimensions": (".npz", lambda: npz(features=X[None, None]), "expected .N traj"),
    "npz: a scalar": (".npz", lambda: npz(a=1.0, b=2.0), "shape"),
    "npz: no rows": (".npz", lambda: npz(features=X[:0]), "no trajectories"),
    "npz: names too few": (
        ".npz",
        lambda: npz(features=X, feature_names=np.array(NAMES[:2])),
        "feature_names: . for . features",
    ),
    "npz: one name twice": (
        ".npz",
        lambda: npz(features=X, feature_names=np.array(["a", "b", "a"])),
        "'a' twice",
    ),
    "npz: one array twice": (
        ".npz",
        lambda: npz(a=X[:, 0], c=X[:, 0]).replace(b"c.npy", b"a.npy"),
        "two arrays",
    ),
    "npz: 10 GB claimed": (
        ".npz",
        lambda: zipped({"a.npy": npy((10**9 + 10**8,)), "b.npy": npy((1,), bytes(8))}),
        "bytes are there",
    ),
    "npz: a negative shape": (
        ".npz",
        lambda: zipped({"a.npy": npy((-2, -2), bytes(32)), "b.npy": npy((1,), bytes(8))}),
        "cannot be read|shape",
    ),
    "npz: 3 GB claimed by the zip": (".npz", lying_zip, "would unpack"),
    "npz: a bomb": (".npz", bomb, "would unpack to 300 MB"),
    "npz: a wide array": (
        ".npz",
        lambda: npz(features=np.zeros((1, 2**22), np.int8)),
        "D at most",
    ),
    "npz: a flipped bit": (
        ".npz",
        lambda: zipped({"a.npy": npy((2,), b"A" * 16), "b.npy": npy((2,), bytes(16))}).replace(
            b"A" * 16, b"A" * 15 + b"B"
        ),
        "cannot be read",
    ),
    "safetensors: 10 GB header": (
        ".safetensors",
        lambda: safetensors({}, length=10**10),
        "cannot be read",
    ),
    "safetensors: 10 GB claimed": (
        ".safetensors",
        lambda: safetensors({"a": of(10**9, 0, 8 * 10**9), "b": of(1, 0, 8)}, bytes(64)),
        "cannot be read",
    ),
    "safetensors: other bytes": (
        ".safetensors",
        lambda: safetensors({"a": of(100, 0, 16), "b": of(2, 16, 32)}, bytes(32)),
        "cannot be read",
    ),
    "safetensors: cut off": (
        ".safetensors",
        lambda: safetensors({"a": of(2, 0, 16), "b": of(2, 16, 32)}, bytes(20)),
        "cannot be read",
    ),
    "safetensors: a pickle": (".safetensors", lambda: b"\x80\x02}q\x00.", "cannot be read"),
    "safetensors: lengths": (
        ".safetensors",
        lambda: safetensors({"a": of(2, 0, 16), "b": of(1, 16, 24)}, bytes(24)),
        "shape",
    ),
    "safetensors: names": (
        ".safetensors",
        lambda: safetensors(
            {
                "__metadata__": {"feature_names": "a,b,c"},
                "features": {"dtype": "F64", "shape": [2, 2], "data_offsets": [0, 32]},
            },
            bytes(32),
        ),
        "feature_names: . for . features",
    ),
    "parquet: cut off": (".parquet", lambda: parquet_bytes(table())[:-30], "cannot be read"),
    "parquet: cut in half and ended": (
        ".parquet",
        lambda: (whole := parquet_bytes(table()))[: len(whole) // 2] + whole[-8:],
        "cannot be read",
    ),
    "csv: a name with a line break": (
        ".csv",
        lambda: 'a,"b\x1b[31m\nc"\n1,2\n3,nan\n',
        "column 'b.*c' holds NaN",
    ),
    "parquet: 3 billion rows claimed": (
        ".parquet",
        lambda: lying_parquet(3 * 10**9),
        "column 'a' of 3,000,000,000 values it would take 48000 MB",
    ),
    "parquet: a million rows claimed": (
        ".parquet",
        lambda: lying_parquet(10**6),
        "says that it has 1,000,000 rows, and 12,345 are there",
    ),
    "parquet: pages larger than claimed": (
        ".parquet",
        large_pages,
        "has pages that unpack to 240 MB",
    ),
    "parquet: text": (".parquet", lambda: csv_text(), "cannot be read"),
    "parquet: NaN": (".parquet", lambda: parquet_bytes(table(more=with_nan()[:, 1])), "holds NaN"),
    "parquet: missing": (
        ".parquet",
        lambda: parquet_bytes(table(more=[None, *X[1:, 0]])),
        "'more' lacks values",
    ),
    "parquet: texts": (".parquet", lambda: parquet_bytes(table(clip=PATHS)), "'clip' holds string"),
    "parquet: lists": (
        ".parquet",
        lambda: parquet_bytes(table(more=[[1.0, 2.0]] * 40)),
        "'more' holds list",
    ),
    "parquet: two of one name": (
        ".parquet",
        lambda: parquet_bytes(pa.table([X[:, 0], X[:, 1]], names=["a", "a"])),
        "'a' twice",
    ),
    "parquet: 320 MB of one number": (
        ".parquet",
        lambda: parquet_bytes(pa.table(dict.fromkeys("ab", np.zeros(2 * 10**7, bool)))),
        "it would take 320 MB",
    ),
    "other: a pickle": (".pkl", lambda: b"\x80\x02}q\x00.", "expected a file whose name ends in"),
}


def write_bad(name: str, path: Path) -> None:
    content = content_of(name)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


@cache
def content_of(name: str) -> bytes | str:
    return BAD[name][1]()


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    suffix, _, message = BAD[name]
    path = tmp_path / f"x{suffix}"
    write_bad(name, path)
    with pytest.raises(InputError, match=message) as refused:
        read_columns(path)
    text = str(refused.value)
    assert "x" + suffix in text
    assert len(text) < 1200
    assert text.isprintable()  # a line break is not
    assert not (tmp_path / RAN).exists()


@pytest.mark.parametrize("suffix", [".npz", ".parquet", ".safetensors"])
def test_every_cut_is_seen_but_of_a_csv(suffix: str, tmp_path: Path) -> None:
    """As docs/your_data.md has it."""
    path = tmp_path / f"x{suffix}"
    write_columns(path)
    whole = path.read_bytes()
    for length in {*range(0, len(whole), 41), *range(len(whole) - 9, len(whole))}:
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_columns(path)
    (tmp_path / "x.csv").write_text("speed,lane\n1,2\n3,0.4")  # of 0.41
    assert read_columns(tmp_path / "x.csv")["lane"].tolist() == [2, 0.4]


def test_a_pickle_would_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files above do hold code."""
    monkeypatch.chdir(tmp_path)
    loaded = np.lib.npyio.NpzFile(io.BytesIO(npz(a=np.array([Code(), 1]))), allow_pickle=True)
    assert len(loaded["a"]) == 2
    assert (tmp_path / RAN).exists()


MEASURE = """
import pathlib, resource, sys
from torchrl_pref.errors import InputError
from torchrl_pref.storage.tables import read_columns
import numpy, pyarrow.parquet, safetensors, torch
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, worst = peak(), {}
for path in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    start = peak()
    try:
        read_columns(path)
        raise SystemExit(f"{path} was read")
    except InputError as error:
        worst[path.name] = peak() - start
print(max(worst.values()), worst)
"""


def test_memory_stays_bounded(tmp_path: Path) -> None:
    """All of them one after another, in a process of their own: its peak says what they took."""
    for name, (suffix, _, _) in BAD.items():
        write_bad(name, tmp_path / f"{name.replace(':', '')}{suffix}")
    with (tmp_path / "sparse.csv").open("wb") as file:
        file.truncate(3 * 2**30)
    with (tmp_path / "sparse.npz").open("wb") as file:
        file.truncate(3 * 2**30)
    command = [sys.executable, "-c", MEASURE, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[0]) < 200, done.stdout


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "folder.csv").mkdir()
    for name, message in (("folder.csv", "is a folder"), ("nothing.npz", "no such file")):
        with pytest.raises(InputError, match=message):
            read_columns(tmp_path / name)
