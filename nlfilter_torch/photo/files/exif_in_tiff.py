"""EXIF blocks of TIFF files: read from their tables, and written so that nothing in a block moves.

A TIFF file may begin with a whole block, whose first table is then replaced by that of the picture. The nested tables,
the values and the notes of the camera's maker keep their offsets.
"""

import struct
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from PIL.ExifTags import Base

from nlfilter_torch.photo.files.exif import PREFIX, parsed, refreshed
from nlfilter_torch.photo.files.metadata import STORAGE_TAGS, Tag
from nlfilter_torch.photo.files.tables import (
    EXIF,
    GPS,
    INTEROP,
    LONG,
    LONG8,
    MAKER_NOTE,
    ORIENTATION,
    POINTERS,
    RESOLUTION,
    Field,
    TiffTables,
)

# Fields of the first table that describe the photograph and belong to the EXIF block.
DESCRIPTIVE = (
    *(ORIENTATION, EXIF, GPS, Base.DocumentName, Base.ImageDescription, Base.Make, Base.Model, Base.PageName),
    *(Base.Software, Base.DateTime, Base.Artist, Base.HostComputer, Base.Rating, Base.RatingPercent, Base.Copyright),
    *(Base.XPTitle, Base.XPComment, Base.XPAuthor, Base.XPKeywords, Base.XPSubject),
)
NEAR_START = 1 << 20  # bytes of a TIFF file in which tables can keep their place
START = 16  # of tables that are moved, after the longest header
MOVED = "the offsets inside the maker note, which is moved"


def block_of(tables: TiffTables) -> tuple[bytes | None, bool]:
    """The EXIF block of a TIFF file, and whether the maker note in it was moved."""
    kept = [field for field in tables.fields(tables.first) if field.code in DESCRIPTIVE]
    if not kept:
        return None, False
    has_note = any(field.code == MAKER_NOTE for field in tables.walk())
    end = max(stop for _, stop in tables.ranges(DESCRIPTIVE))
    if has_note and not tables.big and end <= NEAR_START:
        return PREFIX + _copied(tables, kept, end), False
    return PREFIX + packed(tables, DESCRIPTIVE), has_note


def _copied(tables: TiffTables, kept: list[Field], end: int) -> bytes:
    """The tables and their values at the offsets that they have, with zeros between them."""
    block = bytearray(end)
    for start, stop in tables.ranges(DESCRIPTIVE):
        block[start:stop] = tables.data[start:stop]
    block[:8] = _header(tables.order, tables.first)
    first = struct.pack(tables.order + "H", len(kept))
    first += b"".join(bytes(tables.data[field.entry : field.entry + tables.step]) for field in kept) + bytes(4)
    block[tables.first : tables.first + len(first)] = first
    return bytes(block)


def _header(order: str, first: int) -> bytes:
    return (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", first)


def packed(tables: TiffTables, codes: Container[int] | None, without: Container[int] = ()) -> bytes:
    """A block with those fields of the first table, and what is nested in them, moved together.

    Fields of the codes ``without`` are left out in every table.
    """
    fields = [field for field in tables.fields(tables.first) if codes is None or field.code in codes]
    head = _header(tables.order, START).ljust(START, b"\0")
    return head + _packed_table(tables, fields, START, without, POINTERS)


def _packed_table(
    tables: TiffTables, fields: list[Field], base: int, without: Container[int], pointers: tuple[int, ...]
) -> bytes:
    """A table at the offset ``base``, followed by what its fields hold and point to."""
    fields = [field for field in fields if field.code not in without and (field.kind < LONG8 or field.code in POINTERS)]
    fields = [
        field for field in fields if field.code not in POINTERS or (field.code in pointers and tables.inner(field))
    ]
    values, entries = b"", []
    for field in fields:
        at = base + 2 + 12 * len(fields) + 4 + len(values)
        kind, count, raw = field.kind, field.count, tables.raw(field)
        if field.code in POINTERS:
            inner = (INTEROP,) if field.code == EXIF else ()
            values += _packed_table(tables, tables.inner(field), at, without, inner)
            kind, count, raw = LONG, 1, tables.packed(LONG, at)
        elif len(raw) > 4:
            values += raw + bytes(len(raw) % 2)
            raw = tables.packed(LONG, at)
        entries.append((field.code, kind, count, raw))
    return _table(tables.order, False, entries) + values


def _table(order: str, big: bool, entries: Sequence[tuple[int, int, int, bytes]]) -> bytes:
    """A table of fields with their number, type and count, and their values or the offset of these."""
    room, number = (8, "Q") if big else (4, "I")
    fields = (
        struct.pack(f"{order}HH{number}", code, kind, count) + value.ljust(room, b"\0")
        for code, kind, count, value in entries
    )
    return struct.pack(order + ("Q" if big else "H"), len(entries)) + b"".join(fields) + bytes(room)


def shortened(block: bytes, longest: int) -> bytes | None:
    """The block without thumbnail, and without maker note, in at most so many bytes; None if it needs more."""
    for smaller in (refreshed(block, None), _without_note(block)):
        if len(smaller) <= longest:
            return smaller
    return None


def _without_note(block: bytes) -> bytes:
    tables = parsed(block)
    return block if tables is None else PREFIX + packed(tables, None, (MAKER_NOTE,))


@dataclass(frozen=True)
class Opening:
    """What a TIFF file begins with to hold a block.

    Attributes:
        order: "<" or ">".
        body: the bytes after the header.
        tags: fields of the first table that the picture's table repeats.
        nested: offsets of the nested tables by the fields that point to them.
        moved: whether a maker note was moved.
    """

    order: str
    body: bytes
    tags: tuple[Tag, ...]
    nested: dict[int, int]
    moved: bool = False


def opening(block: bytes | None, order: str, big: bool) -> Opening:
    """What a TIFF or BigTIFF file begins with to hold a block; without a block it has that byte order."""
    tables: TiffTables | None = parsed(None if block is None else refreshed(block, None))
    if tables is None:
        return Opening(order, b"", (), {})
    moved = False
    if big and any(start < START for start, _ in tables.ranges()):
        moved = any(field.code == MAKER_NOTE for field in tables.walk())
        tables = TiffTables(packed(tables, None))
    fields = tables.fields(tables.first)
    kept = [field for field in fields if field.code not in (*POINTERS, *RESOLUTION, *STORAGE_TAGS, ORIENTATION)]
    tags = tuple(Tag(field.code, field.kind, tables.raw(field), tables.order) for field in kept)
    nested = {
        field.code: tables.number(field) or 0 for field in fields if field.code in POINTERS and tables.inner(field)
    }
    body = bytes(tables.data)
    if big:
        nested, body = _as_big(tables, fields, body)
    return Opening(tables.order, body[START if big else 8 :], tags, nested, moved)


def _as_big(tables: TiffTables, fields: list[Field], body: bytes) -> tuple[dict[int, int], bytes]:
    """Append the nested tables of a block in the form of a BigTIFF; their values stay where they are."""
    nested = {}
    for field in fields:
        if field.code not in POINTERS or not tables.inner(field):
            continue
        inner: dict[int, int] = {}
        if field.code == EXIF:
            inner, body = _as_big(tables, tables.inner(field), body)
        body += bytes(-len(body) % 2)
        nested[field.code] = len(body)
        body += _big_table(tables, tables.inner(field), inner)
    return nested, body


def _big_table(tables: TiffTables, fields: list[Field], inner: dict[int, int]) -> bytes:
    """A table of a BigTIFF, whose longer values stay where they are, with offsets of the tables nested in it."""
    entries = []
    for field in fields:
        kind, raw = field.kind, tables.raw(field)
        if field.code in inner:
            kind, raw = LONG8, tables.packed(LONG8, inner[field.code])
        elif field.code in POINTERS:
            continue
        elif len(raw) > 8:
            raw = tables.packed(LONG8, field.place)
        entries.append((field.code, kind, field.count, raw))
    return _table(tables.order, True, entries)


def point(stream: BinaryIO, order: str, big: bool, position: int, code: int, offset: int) -> None:
    """Write the field of a table at ``position`` that points to a nested table."""
    stream.seek(position)
    kind = LONG8 if big else LONG
    stream.write(struct.pack(order + ("HHQQ" if big else "HHII"), code, kind, 1, offset))
