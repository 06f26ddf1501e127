"""The tables of TIFF files and of EXIF blocks: fields with their type and the place of their bytes."""

import math
import struct
from collections.abc import Container, Iterator
from dataclasses import dataclass
from mmap import mmap

from PIL.ExifTags import Base
from tifffile import DATATYPE, TIFF

Data = bytes | bytearray | mmap
Range = tuple[int, int]  # first byte, and the one after the last

ORIENTATION, EXIF, GPS, INTEROP = Base.Orientation, Base.ExifOffset, Base.GPSInfo, Base.ExifInteroperabilityOffset
MAKER_NOTE = Base.MakerNote
RESOLUTION = (Base.XResolution, Base.YResolution, Base.ResolutionUnit)
POINTERS = (EXIF, GPS, INTEROP)  # fields that point to a nested table
LENGTHS = {kind: struct.calcsize("<" + form) for kind, form in TIFF.DATA_FORMATS.items()}  # of a value
BYTE, SHORT, LONG, RATIONAL = DATATYPE.BYTE, DATATYPE.SHORT, DATATYPE.LONG, DATATYPE.RATIONAL
UNDEFINED, LONG8 = DATATYPE.UNDEFINED, DATATYPE.LONG8
#: Unsigned types, as :mod:`struct` calls them.
INTEGERS: dict[int, str] = {
    DATATYPE.BYTE: "B",
    SHORT: "H",
    LONG: "I",
    DATATYPE.IFD: "I",
    LONG8: "Q",
    DATATYPE.IFD8: "Q",
}
HEADERS = {b"II*\0": "<", b"MM\0*": ">", b"II+\0": "<", b"MM\0+": ">"}
HEADERS |= {b"IIRO": "<", b"IIRS": "<", b"IIU\0": "<", b"MMOR": ">"}  # RAW files of Olympus and Panasonic


@dataclass(frozen=True)
class Field:
    """A field of a table.

    Attributes:
        code: number of the tag.
        kind: number of the type.
        count: number of values.
        entry: offset of the field in the table.
        place: offset of the first value.
    """

    code: int
    kind: int
    count: int
    entry: int
    place: int

    @property
    def end(self) -> int:
        """Offset after the last value."""
        return self.place + LENGTHS[self.kind] * self.count


class TiffTables:
    """The tables of a block or of a TIFF file.

    Attributes:
        data: the bytes, without the prefix of JPEG.
        order: "<" or ">".
        big: whether it is a BigTIFF.
        first: offset of the first table.
    """

    def __init__(self, data: Data) -> None:
        """Read the header; raises ValueError or struct.error if there is none."""
        self.data = data
        magic = bytes(data[:4])
        if magic not in HEADERS:
            raise ValueError("no header of TIFF")
        self.order = HEADERS[magic]
        self.big = b"+" in magic
        self.first = self.unpack("Q", 8) if self.big else self.unpack("I", 4)

    def unpack(self, kind: str, place: int) -> int:
        """The unsigned integer at an offset."""
        return int(struct.unpack_from(self.order + kind, self.data, place)[0])

    def ratio(self, field: Field) -> float:
        """The value of a field with a single fraction, else NaN."""
        if (field.kind, field.count) != (RATIONAL, 1):
            return math.nan
        above, below = self.unpack("I", field.place), self.unpack("I", field.place + 4)
        return above / below if below else math.nan

    def packed(self, kind: int, value: int) -> bytes:
        """The bytes of an unsigned integer of a type in :data:`INTEGERS`."""
        return struct.pack(self.order + INTEGERS[kind], value)

    @property
    def step(self) -> int:
        """Length of a field in a table."""
        return 20 if self.big else 12

    def _length(self, start: int) -> tuple[int, int]:
        """Offset of the first field of a table, and the number of fields that the data has room for."""
        head, kind = (8, "Q") if self.big else (2, "H")
        if not 8 <= start <= len(self.data) - head:
            return start + head, 0
        room = (len(self.data) - start - head) // self.step
        return start + head, min(self.unpack(kind, start), room)

    def count(self, start: int) -> int:
        """The number of fields of a table, valid or not."""
        return self._length(start)[1]

    def fields(self, start: int) -> list[Field]:
        """The valid fields of the table at an offset; none if there is no table."""
        top, count = self._length(start)
        inline, number = (8, "Q") if self.big else (4, "I")
        fields, head, whole = [], struct.Struct(f"{self.order}HH{number}"), len(self.data)
        for entry in range(top, top + count * self.step, self.step):
            code, kind, values = head.unpack_from(self.data, entry)
            place, length = entry + 4 + inline, LENGTHS.get(kind, 0) * values
            if length > inline:
                place = self.unpack(number, place)
            if kind in LENGTHS and place + length <= whole:
                fields.append(Field(code, kind, values, entry, place))
        return fields

    def next(self, start: int) -> int | None:
        """Offset of the pointer to the table that follows a table, or None if the data ends before it."""
        top, count = self._length(start)
        place = top + count * self.step
        return place if count and place + 4 <= len(self.data) else None

    def raw(self, field: Field) -> bytes:
        """The bytes of the values of a field."""
        return bytes(self.data[field.place : field.end])

    def number(self, field: Field) -> int | None:
        """The value of a field with a single unsigned integer, else None."""
        return self.unpack(INTEGERS[field.kind], field.place) if field.count == 1 and field.kind in INTEGERS else None

    def inner(self, field: Field) -> list[Field]:
        """The fields of the table that a field points to."""
        return self.fields(self.number(field) or 0)

    def walk(self, start: int | None = None, codes: Container[int] | None = None) -> Iterator[Field]:
        """The fields of a table, by default the first one, and of the tables nested in it; ``codes`` of that table."""
        for field in self.fields(self.first if start is None else start):
            if codes is None or field.code in codes:
                yield field
                if field.code in POINTERS:  # no longer nested than one in another, since loops are possible
                    for inside in self.inner(field):
                        yield inside
                        if inside.code == INTEROP and field.code == EXIF:
                            yield from self.inner(inside)

    def ranges(self, codes: Container[int] | None = None) -> Iterator[Range]:
        """The bytes of the nested tables and of all values, see :meth:`walk`."""
        for field in self.walk(codes=codes):
            yield field.entry, field.entry + self.step
            yield field.place, field.end
            if field.code in POINTERS and (fields := self.inner(field)):
                yield self.number(field) or 0, fields[-1].entry + self.step + 4
