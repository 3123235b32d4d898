"""What the pages of a Parquet file unpack to, as their own headers say.

The footer says how large each column is, and pyarrow tells what it says. What is unpacked are
*pages*, one after another, and before each stands a header with a size of its own, which pyarrow
does not tell. A footer that says little may stand behind pages that take gigabytes.

A header is a struct of Thrift's compact protocol: fields, each with its number and kind, and a zero
at the end. Field 2 is the size of the page once unpacked, field 3 as it is stored.
Source: apache/parquet-format, ``parquet.thrift``; apache/thrift, ``thrift-compact-protocol.md``.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterable

from torchrl_pref.storage.columns import Refused

TRUE, FALSE, BYTE, SHORT, INT, LONG, BINARY, STRUCT = 1, 2, 3, 4, 5, 6, 8, 12
"""Kinds of field that are in headers of pages."""

UNPACKED, STORED = 2, 3
"""Fields of a header."""

MAX_FIELD = 100
"""Numbers of fields; a reader that counts in 16 bits would take larger ones for others."""


def check_pages(path: str, columns: Iterable[tuple[int, int]], limit: int) -> int:
    """Refuse columns whose pages unpack to more than a limit, all together; else, to how many
    bytes they do.

    Args:
        path: of the Parquet file.
        columns: of each, in each group of rows: where its first page begins, and how many bytes it
            has there.
        limit: in bytes.

    Raises:
        Refused: they do.
        ValueError, IndexError: there is something else where a header should be.
    """
    total = 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for start, length in columns:
            place, end = start, start + length
            while place < end:
                unpacked, stored, place = _sizes(data, place)
                total, place = total + unpacked, place + stored
                if total > limit:
                    raise Refused(
                        f"has pages that unpack to {total / 1e6:.0f} MB or more; expected at most "
                        f"{limit / 1e6:.0f} MB from a file of its size"
                    )
    return total


def _sizes(data: mmap.mmap, place: int) -> tuple[int, int, int]:
    """The bytes of a page, unpacked and as stored, and where it begins; from its header's place."""
    sizes: dict[int, int] = {}
    number = 0
    while data[place]:
        number, kind, place = _field(data, place, number)
        if number in (UNPACKED, STORED) and kind == INT:
            doubled, place = _number(data, place)
            # Negative numbers are the odd ones.
            if doubled & 1 or doubled >= 2**32:
                raise ValueError("a page of a size that none can have")
            sizes[number] = doubled // 2
        else:
            place = _skip(data, place, kind)
    if len(sizes) < 2:
        raise ValueError("a page without its size")
    return sizes[UNPACKED], sizes[STORED], place + 1


def _field(data: mmap.mmap, place: int, before: int) -> tuple[int, int, int]:
    """A field's number, its kind, and where its value begins; ``before`` is the number before."""
    step, kind = divmod(data[place], 16)
    place += 1
    if not step:
        doubled, place = _number(data, place)
        before, step = 0, doubled // 2
    if before + step > MAX_FIELD:
        raise ValueError("a header with fields that no page has")
    return before + step, kind, place


def _skip(data: mmap.mmap, place: int, kind: int) -> int:
    """Where the value of a field ends."""
    if kind in (TRUE, FALSE):
        return place
    if kind == BYTE:
        return place + 1
    if kind in (SHORT, INT, LONG):
        return _number(data, place)[1]
    if kind == BINARY:
        length, place = _number(data, place)
        return place + length
    if kind == STRUCT:
        number = 0
        while data[place]:
            number, inner, place = _field(data, place, number)
            place = _skip(data, place, inner)
        return place + 1
    raise ValueError("a header with a field of a kind that no page has")


def _number(data: mmap.mmap, place: int) -> tuple[int, int]:
    """A whole number, 7 bits a byte, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        byte = data[place]
        value, place = value | (byte & 0x7F) << shift, place + 1
        if byte < 0x80:
            return value, place
    raise ValueError("a number of more than 64 bits")
