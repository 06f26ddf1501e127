"""EXIF blocks, which are kept byte for byte, and rotation of pictures by their EXIF orientation.

A block is a TIFF file without pixels: tables of fields, whose values lie anywhere in it. The notes of camera makers
hold offsets of their own, which nobody documents, so a block is not written anew. Only the orientation, the sizes and
the thumbnail change, in their places. This also keeps the type and the bytes of every field, and unknown fields.
Libraries that parse and write blocks were tried: Pillow changes types and moves the notes, libexif (in libvips) adds
fields and moves the notes, piexif knows fixed lists of fields, and Exiv2 is under the GPL.
"""

import io
import struct
from collections.abc import Callable, Container, Iterable, Sequence
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import Base

from nlfilter_torch.photo.files.metadata import CENTIMETRES
from nlfilter_torch.photo.files.tables import (
    EXIF,
    INTEGERS,
    LONG,
    ORIENTATION,
    POINTERS,
    RESOLUTION,
    SHORT,
    Field,
    Range,
    TiffTables,
)

Scalar = TypeVar("Scalar", bound=np.generic)

PREFIX = b"Exif\0\0"
IN_EXIF = (Base.ExifImageWidth, Base.ExifImageHeight)  # those that cameras write
IN_PIXELS = (Base.ImageWidth, Base.ExifImageWidth)
FOCAL_PLANE = (Base.FocalPlaneXResolution, Base.FocalPlaneYResolution)
#: Horizontal and vertical; swapped by a quarter turn.
SIZES = ((Base.ImageWidth, Base.ImageLength), IN_EXIF, RESOLUTION[:2], FOCAL_PLANE)
IN_INCHES: dict[int, float] = {tifffile.RESUNIT.INCH: 1.0, tifffile.RESUNIT.CENTIMETER: CENTIMETRES}
AREAS = (37396, Base.SubjectLocation)  # places of the main subject: centre, and perhaps diameter, or width and height
NO_TAG = 0xFFFE  # the number of no tag
COMPRESSION, PLACE, LENGTH = Base.Compression, Base.JpegIFOffset, Base.JpegIFByteCount  # of a thumbnail
OJPEG = tifffile.COMPRESSION.OJPEG
THUMBNAIL_SIDES = (160, 80, 40)  # the longest side of thumbnails, until one fits
QUALITIES = (85, 70, 50, 30)  # of each


def upright(channels: NDArray[Scalar], orientation: int) -> NDArray[Scalar]:
    """Rotate or flip an array (H, W, S) stored with an EXIF orientation to the upright position.

    >>> import numpy as np
    >>> upright(np.array([[[1], [2]]]), 6)[..., 0].tolist()
    [[1], [2]]
    """
    if orientation >= 5:
        channels = channels.swapaxes(0, 1)
    return channels[:: -1 if orientation in (3, 4, 7, 8) else 1, :: -1 if orientation in (2, 3, 6, 7) else 1]


def exif_orientation(value: object) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if ``value`` is invalid.

    >>> exif_orientation(6), exif_orientation("upside down")
    (6, 1)
    """
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


class ExifBlock(TiffTables):
    """The tables of an EXIF block, whose bytes may be changed in place."""

    data: bytearray


def parsed(block: bytes | None) -> ExifBlock | None:
    """The tables of a block; None if it is empty, or damaged from the start."""
    try:
        tables = ExifBlock(bytearray((block or b"").removeprefix(PREFIX)))
    except (ValueError, struct.error):
        return None
    return tables if not tables.big and tables.fields(tables.first) else None


class Upright(NamedTuple):
    """An EXIF block of a picture that is turned upright.

    Attributes:
        orientation: of the picture as it is stored.
        block: with orientation 1, or None if nothing else is in it.
        left_out: names of what was damaged.
    """

    orientation: int
    block: bytes | None = None
    left_out: tuple[str, ...] = ()


def read_upright(block: bytes | None, orientation: int | None = None, size: tuple[int, int] | None = None) -> Upright:
    """Set the orientation of a block to 1, and its sizes to those of the upright picture.

    Args:
        block: as it stands in the file, or None.
        orientation: of the pixels, where the format does not say it in the block. None is that of the block.
        size: (width, height) of the upright picture, where it is not that of the stored one turned by the orientation.
    """
    tables = parsed(block)
    if tables is None:
        return Upright(orientation or 1, None, ("a damaged EXIF block",) if block else ())
    first = [field for field in tables.fields(tables.first) if field.code == ORIENTATION]
    if orientation is None:
        orientation = exif_orientation(tables.number(first[0])) if first else 1
    for field in first:
        _straighten(tables, field)
    damaged = _drop(tables)
    lost = orientation > 1 and not _turn_areas(tables, orientation) and _drop(tables, AREAS)
    fields = list(tables.walk())
    _resize(tables, {field.code: field for field in fields}, orientation >= 5, size)
    only = all(field.code == ORIENTATION for field in fields) and not _thumbnail(tables)
    left_out = ["damaged fields of EXIF"] * damaged + ["the place of the subject, as the picture is turned"] * lost
    return Upright(orientation, None if only else PREFIX + bytes(tables.data), tuple(left_out))


def with_description(block: bytes | None, changed: Callable[[bytes], bytes]) -> bytes | None:
    """A block with other descriptions of the picture, each of which is as long at most; empty ones are removed."""
    tables = parsed(block)
    if tables is None:
        return block
    fields = [field for field in tables.fields(tables.first) if field.code == Base.ImageDescription]
    texts = [tables.raw(field).rstrip(b"\0") for field in fields]
    new = [changed(text) for text in texts]
    if new == texts:
        return block
    if not any(new):
        _drop(tables, (Base.ImageDescription,))
        return PREFIX + bytes(tables.data) if tables.fields(tables.first) else None
    for field, text in zip(fields, new, strict=True):
        tables.data[field.place : field.end] = text.ljust(field.count, b"\0")
        tables.data[field.entry + 4 : field.entry + 8] = tables.packed(LONG, min(len(text) + 1, field.count))
    return PREFIX + bytes(tables.data)


def of_part(block: bytes | None, size: tuple[int, int]) -> bytes | None:
    """The upright block of a part (width, height) of a picture, without the place of the subject."""
    tables = parsed(block)
    if tables is None:
        return None
    _drop(tables, AREAS)
    return read_upright(PREFIX + bytes(tables.data), size=size).block


def _turn_areas(tables: ExifBlock, orientation: int) -> bool:
    """Turn the places of the subject with the picture, whose stored size the block says; False if that fails."""
    fields = {field.code: field for field in tables.walk()}
    numbers = [tables.number(fields[code]) for code in IN_EXIF if code in fields]
    size = [number for number in numbers if number is not None]
    areas = [fields[code] for code in AREAS if code in fields]
    if len(size) != 2 or any(f.kind != SHORT or f.count not in (2, 3, 4) for f in areas):
        return False
    for field in areas:
        code = f"{tables.order}{field.count}H"
        place = struct.unpack(code, tables.raw(field))
        tables.data[field.place : field.end] = struct.pack(code, *turned_place(place, orientation, *size))
    return True


def turned_place(place: Sequence[int], orientation: int, width: int, height: int) -> list[int]:
    """A place in a stored picture as it is in the upright one: the centre, and perhaps a diameter, or width and height.

    >>> turned_place((10, 20, 3, 4), 6, 100, 50)
    [29, 10, 4, 3]
    """
    across, down, *extent = place
    if orientation >= 5:
        across, down, width, height, extent = down, across, height, width, extent[::-1]
    across = width - 1 - across if orientation in (2, 3, 6, 7) else across
    down = height - 1 - down if orientation in (3, 4, 7, 8) else down
    return [max(across, 0), max(down, 0), *extent]


def _drop(tables: ExifBlock, unwanted: Container[int] = ()) -> bool:
    """Remove fields without a valid value, or unwanted, from the first table and that of EXIF; whether any were."""
    starts = [tables.first, *(tables.number(f) or 0 for f in tables.fields(tables.first) if f.code == EXIF)]
    damaged = False
    for start in starts[::-1]:
        fields = [
            f for f in tables.fields(start) if (f.code not in POINTERS or tables.inner(f)) and f.code not in unwanted
        ]
        pointer, count = tables.next(start), tables.count(start)
        if len(fields) == count:
            continue
        damaged = True
        entries = b"".join(bytes(tables.data[f.entry : f.entry + tables.step]) for f in fields)
        rest = bytes(tables.data[pointer : pointer + 4]) if pointer is not None else b""
        table = tables.packed(SHORT, len(fields)) + entries + rest
        tables.data[start : start + 2 + count * tables.step + len(rest)] = table.ljust(
            2 + count * tables.step + len(rest), b"\0"
        )
    return damaged


def resolution(block: bytes | None) -> tuple[float, float] | None:
    """The pixels per inch that a block says, or None."""
    tables = parsed(block)
    if tables is None:
        return None
    fields = {field.code: field for field in tables.fields(tables.first) if field.code in RESOLUTION}
    values = [tables.ratio(fields[code]) for code in RESOLUTION[:2] if code in fields]
    scale = IN_INCHES.get(tables.number(fields[RESOLUTION[2]]) or 0) if RESOLUTION[2] in fields else 1.0
    return (values[0] * scale, values[1] * scale) if scale is not None and len(values) == 2 else None


def hidden_orientation(block: bytes) -> bytes:
    """The block with its orientation under the number of no tag."""
    tables = parsed(block)
    if tables is None:
        return block
    for field in tables.fields(tables.first):
        if field.code == ORIENTATION:
            tables.data[field.entry : field.entry + 2] = struct.pack(tables.order + "H", NO_TAG)
    return block[: len(block) - len(tables.data)] + bytes(tables.data)


def _straighten(tables: ExifBlock, field: Field) -> None:
    """Set an orientation to 1; as a short integer if it was no integer."""
    kind = field.kind if field.count == 1 and field.kind in INTEGERS else SHORT
    struct.pack_into(tables.order + "HHI4x", tables.data, field.entry, field.code, kind, 1)
    struct.pack_into(tables.order + INTEGERS[kind], tables.data, field.entry + 8, 1)


def _resize(tables: ExifBlock, fields: dict[int, Field], turned: bool, size: tuple[int, int] | None) -> None:
    """Set the sizes in a block, or swap those that a quarter turn swaps."""
    for across, down in SIZES:
        pair = [fields[code] for code in (across, down) if code in fields and fields[code].count == 1]
        values = [tables.raw(field) for field in pair]
        if size is not None and across in IN_PIXELS and all(field.kind in INTEGERS for field in pair):
            values = [tables.packed(field.kind, length) for field, length in zip(pair, size, strict=False)]
        elif turned and len(pair) == 2 and pair[0].kind == pair[1].kind:
            values = values[::-1]
        for field, value in zip(pair, values, strict=len(pair) == 2):
            tables.data[field.place : field.end] = value


def _thumbnail(tables: TiffTables) -> int:
    """Offset of the table of the thumbnail, or 0."""
    pointer = tables.next(tables.first)
    return tables.unpack("I", pointer) if pointer is not None else 0


def has_thumbnail(block: bytes) -> bool:
    """Whether a block has a table of a thumbnail."""
    tables = parsed(block)
    return tables is not None and _thumbnail(tables) != 0


def refreshed(block: bytes, picture: NDArray[np.generic] | None) -> bytes:
    """The block with a thumbnail of a picture (H, W, S) of 8 or 16 bits in the place of the one that it has, if any.

    Without a picture, or where the new thumbnail does not fit in the place, the block has none.
    """
    tables = parsed(block)
    if tables is None or not (start := _thumbnail(tables)):
        return block
    fields = {field.code: field for field in tables.fields(start)}
    place, length = (tables.number(fields[code]) if code in fields else None for code in (PLACE, LENGTH))
    compression = tables.number(fields[COMPRESSION]) if COMPRESSION in fields else OJPEG
    room = (place or 0, (place or 0) + (length or 0))
    free = room[1] <= len(tables.data) and not _overlaps(room, tables.ranges())
    jpeg = None if picture is None or compression != OJPEG or not free else _small_jpeg(picture, length or 0)
    if free:
        tables.data[slice(*room)] = (jpeg or b"").ljust(length or 0, b"\0")
    if jpeg is None:
        return PREFIX + _without_table(tables, start, room if free else (0, 0))
    tables.data[fields[LENGTH].place : fields[LENGTH].end] = tables.packed(fields[LENGTH].kind, len(jpeg))
    if ORIENTATION in fields:
        _straighten(tables, fields[ORIENTATION])
    return PREFIX + bytes(tables.data)


def _overlaps(place: Range, ranges: Iterable[Range]) -> bool:
    return any(start < place[1] and place[0] < stop for start, stop in ranges)


def _without_table(tables: ExifBlock, start: int, room: Range) -> bytes:
    """The bytes of a block without the table of its thumbnail, cut where nothing follows."""
    pointer = tables.next(tables.first)
    assert pointer is not None  # it led to the table
    tables.data[pointer : pointer + 4] = bytes(4)
    end = max(stop for _, stop in tables.ranges())
    return bytes(tables.data[: max(end, pointer + 4)] if min(start, room[0] or start) >= end else tables.data)


def _small_jpeg(picture: NDArray[np.generic], longest: int) -> bytes | None:
    """A thumbnail of a picture (H, W, S) in at most so many bytes, or None."""
    step = max(1, max(picture.shape[:2]) // (4 * THUMBNAIL_SIDES[0]))
    levels = np.asarray(picture[::step, ::step, : 3 if picture.shape[2] > 2 else 1])
    levels = (levels / (np.iinfo(levels.dtype.name).max / 255)).astype(np.uint8)
    small = Image.fromarray(levels.squeeze(2) if levels.shape[2] == 1 else levels)
    for side, quality in product(THUMBNAIL_SIDES, QUALITIES):
        small.thumbnail((side, side))
        stream = io.BytesIO()
        small.save(stream, "JPEG", quality=quality)
        if len(stream.getvalue()) <= longest:
            return stream.getvalue()
    return None
