"""Columns of numbers from Parquet files. The package ``pyarrow`` is an extra."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from torchrl_pref.storage.columns import Choice, Columns, Refused, Room
from torchrl_pref.storage.pages import check_pages

COPIES = 3
"""Of a column of texts while it is read: as it is unpacked, as it is collected, and as a column."""


def read_parquet(path: str, limit: int, choice: Choice) -> Columns:
    """Columns of a Parquet file."""
    import pyarrow.parquet as parquet
    from pyarrow import default_memory_pool

    texts = [] if choice.texts is None else [choice.texts]
    # Texts that come again and again are kept once, so that few bytes cannot become many.
    with parquet.ParquetFile(path, read_dictionary=texts) as file:
        n_rows, chosen = file.metadata.num_rows, _chosen(file.schema_arrow, choice)
        room = _room(path, file.metadata, chosen, choice, limit)
        table = file.read(columns=chosen, use_threads=False)
    if table.num_rows != n_rows:
        raise Refused(
            f"says that it has {n_rows:,} rows, and {table.num_rows:,} are there; save it again"
        )
    missing = [name for name in chosen if table.column(name).null_count]
    if missing:
        raise Refused(f"column {missing[0]!r} lacks values; expected one in each row")
    read = {name: table.column(name) for name in chosen}
    del table  # so that each column of it goes once it has been copied
    # What is free stays with pyarrow, beside all that is taken after, until it is told to let go.
    default_memory_pool().release_unused()
    columns: Columns = {}
    for name in chosen:
        column = read.pop(name)
        if name in texts:
            columns[name] = _texts(name, column, room)
        else:
            columns[name] = column.to_numpy().astype(np.float64)
    del column
    default_memory_pool().release_unused()
    return columns


def _chosen(schema: Any, choice: Choice) -> list[str]:
    """The columns to read.

    Raises:
        Refused: one is not there, or holds something else than it should.
    """
    from pyarrow import types

    # Pandas writes its row labels as a column.
    chosen = choice.pick([name for name in schema.names if not name.startswith("__index_level_")])
    for name in chosen:
        kind = schema.field(name).type
        if name == choice.texts:
            kind = kind.value_type if types.is_dictionary(kind) else kind
            if not types.is_string(kind) and not types.is_large_string(kind):
                raise Refused(f"column {name!r} holds {kind!s:.40}; expected texts")
        elif not (types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)):
            raise Refused(
                f"column {name!r} holds {kind!s:.40}; expected numbers; name those that do by "
                "columns=[…]"
            )
    return chosen


def _room(path: str, metadata: Any, chosen: list[str], choice: Choice, limit: int) -> Room:
    """What room is left beside the columns, before they are read.

    Raises:
        Refused: the file says that it holds more than there is room for, or its pages do.
    """
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    claimed = sum(group.total_byte_size for group in groups)
    if claimed > limit or min(claimed, metadata.num_rows) < 0:
        raise Refused(
            f"says that it unpacks {metadata.num_rows:,} rows to {claimed / 1e6:.0f} MB; expected "
            f"at most {limit / 1e6:.0f} MB from a file of its size"
        )
    room = Room(limit)
    for name in chosen:
        room.take(name, metadata.num_rows)
    places = [place for group in groups for place in _places(group)]
    check_pages(path, [place for _, place in places], limit)
    own = [place for name, place in places if name == choice.texts]
    unpacked = COPIES * check_pages(path, own, limit)
    room.take_bytes(f"the texts of column {choice.texts!r:.80}", unpacked)
    return room


def _texts(name: str, column: Any, room: Room) -> np.ndarray[Any, Any]:
    """A column (N) of texts, each of which is kept once."""
    texts, end = np.empty(len(column), object), 0
    for chunk in column.chunks:
        once = [room.text(name, text.as_py()) for text in chunk.dictionary]
        start, end = end, end + len(chunk)
        # Clipped, as it would take its result twice to check that all are there.
        np.array(once, object).take(chunk.indices.to_numpy(), out=texts[start:end], mode="clip")
    return texts


def _places(group: Any) -> Iterator[tuple[str, tuple[int, int]]]:
    """Of each column of a group of rows its name, where its first page begins, and its bytes in the
    file."""
    for number in range(group.num_columns):
        column = group.column(number)
        first, names = column.data_page_offset, column.dictionary_page_offset
        # A place of 0 is none; pyarrow begins at the texts where these stand before the numbers.
        start = names if names and 0 < names < first else first
        yield column.path_in_schema, (start, column.total_compressed_size)
