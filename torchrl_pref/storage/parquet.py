"""Columns of numbers from Parquet files. The package ``pyarrow`` is an extra."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from torchrl_pref.storage.columns import Choice, Columns, Refused
from torchrl_pref.storage.pages import check_pages


def read_parquet(path: str, limit: int, choice: Choice) -> Columns:
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
                    "task.columns=[…]"
                )
        groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
        claimed = sum(group.total_byte_size for group in groups)
        claimed = max(claimed, 8 * metadata.num_rows * len(chosen))
        if not 0 <= claimed <= limit:
            raise Refused(
                f"says that it unpacks to {claimed / 1e6:.0f} MB; expected at most "
                f"{limit / 1e6:.0f} MB from a file of its size"
            )
        check_pages(path, [place for group in groups for place in _places(group)], limit)
        table = file.read(columns=chosen, use_threads=False)
    if table.num_rows != metadata.num_rows:
        raise Refused(
            f"says that it has {metadata.num_rows:,} rows, and {table.num_rows:,} are there; save "
            "it again"
        )
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


def _places(group: Any) -> Iterator[tuple[int, int]]:
    """Of each column of a group of rows where its first page begins, and its bytes in the file."""
    for number in range(group.num_columns):
        column = group.column(number)
        first, names = column.data_page_offset, column.dictionary_page_offset
        # A place of 0 is none; pyarrow begins at the texts where these stand before the numbers.
        yield names if names and 0 < names < first else first, column.total_compressed_size
