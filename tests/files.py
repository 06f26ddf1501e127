"""Pixels, metadata and comparisons for tests of image files."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch.photo.files.rows import open_picture
from nlfilter_torch.photo.files.tables import POINTERS, TiffTables
from nlfilter_torch.photo.picture.photographs import Photograph
from nlfilter_torch.photo.picture.pictures import stored_as

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
INTEGERS = ("uint8", "uint16")
CHANNELS = (1, 2, 3, 4)  # grey, grey + alpha, RGB, RGBA


def stored_values(channels: int, depth: str) -> np.ndarray:
    """Pseudo-random values (5, 7, channels) of ``depth``, including the extremes."""
    draw = np.random.default_rng(channels)
    if depth.startswith("float"):
        return draw.normal(0.5, 1, (5, 7, channels)).astype(depth)
    limit = np.iinfo(depth).max
    values = draw.integers(0, limit, (5, 7, channels), dtype=depth, endpoint=True)
    values[0, :2] = [[0], [limit]]
    return values


def photograph(values: np.ndarray, **fields: bytes) -> Photograph:
    """The photograph expected from a file with ``values``."""
    integer = np.issubdtype(values.dtype, np.integer)
    kind = np.float64 if values.dtype == np.float64 else np.float32
    scaled = values.astype(kind) / (np.iinfo(values.dtype).max if integer else 1)
    planes = torch.from_numpy(scaled.astype(kind)).permute(2, 0, 1)[None]
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], values.dtype.name, alpha, **fields)  # type: ignore[arg-type]


def exif_block(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    exif[ExifTags.Base.Orientation] = orientation
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.ExifImageWidth] = 7
    details[ExifTags.Base.ExifImageHeight] = 5
    details[ExifTags.Base.LensModel] = "a lens with a long name"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    return exif.tobytes()


def tags(block: bytes | None) -> tuple[dict[int, object], dict[int, object], dict[int, object]]:
    exif = Image.Exif()
    exif.load(block or b"")
    folders = (int(ExifTags.IFD.Exif), int(ExifTags.IFD.GPSInfo))
    main = {code: value for code, value in exif.items() if code not in folders}
    return main, dict(exif.get_ifd(folders[0])), dict(exif.get_ifd(folders[1]))


def same(opened: Photograph, wanted: Photograph) -> None:
    assert opened.depth == wanted.depth
    assert opened.pixels.dtype == wanted.pixels.dtype
    visible = torch.ones(opened.size, dtype=torch.bool)
    if opened.hidden is not None:
        visible = torch.from_numpy(~opened.hidden.places)
        stored = torch.from_numpy(stored_as(wanted.pixels, wanted.depth)[opened.hidden.places].astype(np.float64))
        assert torch.equal(torch.from_numpy(opened.hidden.colours.astype(np.float64)), stored)
    assert torch.equal(opened.pixels[..., visible], wanted.pixels[..., visible])
    assert (opened.alpha is None) == (wanted.alpha is None)
    assert opened.alpha is None or torch.equal(opened.alpha, wanted.alpha)
    assert opened.icc == wanted.icc
    assert tags(opened.exif) == tags(wanted.exif)


Array = NDArray[Any]
PLENTY = 1 << 30


def cat(height: int = 200, width: int = 150, channels: int = 3) -> Array:
    """(height, width, channels) of 8 bits; the fourth channel is a ramp."""
    picture = skimage.data.chelsea()[20 : 20 + height, 90 : 90 + width]
    ramp = np.broadcast_to(np.arange(width, dtype=np.uint8)[:, None], (height, width, 1))
    return np.ascontiguousarray(np.concatenate([picture, ramp], axis=2)[..., :channels])


def rows_of(path: Path, step: int = 37) -> Array:
    with open_picture(path, PLENTY) as picture:
        height = picture.shape[0]
        parts = [picture.rows[slice(top, min(top + step, height))] for top in range(0, height, step)]
        return np.concatenate(parts)


MAKER_NOTE = b"NOTE\0\1" + bytes(range(90))


def camera_block(order: str = "<", thumbnail: bool = True) -> bytes:
    """An EXIF block with every type of field, a maker note, GPS and a thumbnail, of a picture stored sideways."""
    jpeg = io.BytesIO()
    Image.new("RGB", (40, 30), (200, 10, 10)).save(jpeg, "JPEG")
    detail = [
        (37121, 7, 4, b"\1\2\3\0"),
        (37377, 10, 1, struct.pack(order + "ii", 7, 2)),
        (37380, 10, 1, struct.pack(order + "ii", 1, 3)),
        (37500, 7, len(MAKER_NOTE), MAKER_NOTE),
        (37510, 7, 12, b"ASCII\0\0\0note"),
        (40962, 4, 1, struct.pack(order + "I", 7)),
        (40963, 4, 1, struct.pack(order + "I", 5)),
        (41728, 7, 1, b"\3"),
        (41729, 7, 1, b"\1"),
        (50000, 12, 1, struct.pack(order + "d", 2.5)),
        (50001, 9, 2, struct.pack(order + "ii", -1, 4)),
        (50002, 6, 3, b"\xff\1\2"),
        (50003, 8, 1, struct.pack(order + "h", -7)),
        (50004, 11, 1, struct.pack(order + "f", 0.5)),
    ]
    gps = [(1, 2, 2, b"N\0"), (2, 5, 3, struct.pack(order + "6I", 52, 1, 30, 1, 1234, 100))]
    first = [(271, 2, 6, b"Maker\0"), (274, 3, 1, struct.pack(order + "H", 6)), (34665, 4, 1, b""), (34853, 4, 1, b"")]

    def table(fields: list[tuple[int, int, int, bytes]], base: int, pointers: dict[int, int], follows: int) -> bytes:
        entries, values = struct.pack(order + "H", len(fields)), b""
        for code, kind, count, raw in fields:
            data = struct.pack(order + "I", pointers[code]) if code in pointers else raw
            if len(data) > 4:
                place = base + 2 + 12 * len(fields) + 4 + len(values)
                values, data = values + data + bytes(len(data) % 2), struct.pack(order + "I", place)
            entries += struct.pack(order + "HHI", code, kind, count) + data.ljust(4, b"\0")
        return entries + struct.pack(order + "I", follows) + values

    start = 8 + len(table(first, 8, {34665: 0, 34853: 0}, 0))
    second = start + len(table(detail, start, {}, 0))
    third = second + len(table(gps, second, {}, 0))
    small = [(259, 3, 1, struct.pack(order + "H", 6)), (513, 4, 1, b""), (514, 4, 1, b"")]
    picture = third + len(table(small, third, {513: 0, 514: 0}, 0))
    block = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    block += table(first, 8, {34665: start, 34853: second}, third if thumbnail else 0)
    block += table(detail, start, {}, 0) + table(gps, second, {}, 0)
    if thumbnail:
        block += table(small, third, {513: picture, 514: len(jpeg.getvalue())}, 0) + jpeg.getvalue()
    return b"Exif\0\0" + block


def fields_of(block: bytes | None) -> dict[tuple[int, int], bytes]:
    """Values by code and type of all fields of a block but the pointers, and where the maker note stands."""
    tables = TiffTables((block or b"").removeprefix(b"Exif\0\0"))
    fields = [field for field in tables.walk() if field.code not in POINTERS]
    places = {(field.code, 0): bytes([field.place % 251]) for field in fields if field.code == 37500}
    return {(field.code, field.kind): tables.raw(field) for field in fields} | places
