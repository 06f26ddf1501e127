"""Metadata of image files besides profile and EXIF: XMP, print resolution, tags of TIFF, and what is not copied."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.files.tables import LENGTHS

JPEG_LIMIT = 65_000  # bytes of XMP that fit in a JPEG segment; longer packets are not written
RESOLUTION = (282, 283, 296)  # horizontal, vertical, and their unit
SWAPPED = {282: 283, 283: 282}
# Tags that say how a TIFF file stores its pixels. The output has its own.
STORAGE = frozenset((*range(254, 260), 262, *range(263, 267), 273, *range(277, 280), 284, 288, 289, 292, 293))
STORAGE |= {317, 320, 321, *range(322, 329), 332, 333, 334, 336, 338, 339, 347, *range(512, 522), *range(529, 533)}
STORAGE |= {32995, 32996, 32997, 32998, 34675}
#: Tags of GeoTIFF and GDAL: where the pixels lie on the ground, notes, and the value without data.
GROUND = (33550, 33922, 34264, 34735, 34736, 34737)
GDAL_NOTES, NODATA = 42112, 42113
OF_A_DEPTH = (NODATA, 280, 281, 290, 291, 301, 340, 341)  # hold levels, or a value for each level
FRACTIONS = (5, 10)  # types of two numbers


@dataclass(frozen=True)
class Tag:
    """A tag of a TIFF file as it is stored.

    Attributes:
        code: its number.
        kind: number of its type.
        data: its values.
        order: "<" or ">", the byte order of the values.
    """

    code: int
    kind: int
    data: bytes
    order: str

    @property
    def count(self) -> int:
        """Number of values."""
        return len(self.data) // LENGTHS[self.kind]

    def stored(self, order: str) -> tuple[int, int, int, bytes, bool]:
        """The tag in a byte order, as tifffile takes it."""
        unit = LENGTHS[self.kind] // (2 if self.kind in FRACTIONS else 1)
        data = self.data if order == self.order else np.frombuffer(self.data, f"V{unit}").view(f"u{unit}")
        return self.code, self.kind, 0, data if isinstance(data, bytes) else data.byteswap().tobytes(), True


class Part(NamedTuple):
    """A part of a file that only files of the same type can hold.

    Attributes:
        kind: that type.
        name: what it is, in words.
        data: its bytes.
    """

    kind: str
    name: str
    data: bytes


@dataclass(frozen=True)
class Extras:
    """Metadata of a file to write back.

    Attributes:
        xmp: an XMP packet, or None.
        dpi: pixels per inch, horizontal and vertical, or None.
        tags: of a TIFF file, which only TIFF files can hold.
        size: (H, W) of the picture that the tags describe, or None if there are none.
        depth: of that picture.
        parts: of the file, which only files of the same type can hold.
        left_out: names of what was in the file and is not copied.
    """

    xmp: bytes | None = None
    dpi: tuple[float, float] | None = None
    tags: tuple[Tag, ...] = ()
    size: tuple[int, int] | None = None
    depth: str = ""
    parts: tuple[Part, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def nodata(self) -> float | None:
        """The value of pixels without data, by the tag of GDAL; None without one."""
        for tag in self.tags:
            if tag.code == NODATA:
                with suppress(ValueError):  # not a number
                    return float(tag.data.split(b"\0")[0].decode("ascii", "replace").replace(",", "."))
        return None

    def tags_for(self, size: tuple[int, int], depth: str) -> tuple[Tag, ...]:
        """The tags that are true of a picture of a size (H, W) and depth."""
        return tuple(
            tag
            for tag in self.tags
            if (tag.code not in GROUND or size == self.size) and (tag.code not in OF_A_DEPTH or depth == self.depth)
        )

    def lacking_tags(self, kept: Iterable[Tag] = ()) -> list[str]:
        """Names of the tags that are not among those kept."""
        gone = [tag.code for tag in self.tags if tag not in kept and not (tag.code in RESOLUTION and self.dpi)]
        return [] if not gone else [f"the TIFF {'tag' if len(gone) == 1 else 'tags'} {', '.join(map(str, gone))}"]


NO_EXTRAS = Extras()


def note_left_out(path: Path, names: Sequence[str]) -> None:
    """Warn that a file was written without something that the input holds."""
    if names:
        warn(f"{path} is written without some metadata of the input: {', '.join(dict.fromkeys(names))}")


def turned(pair: tuple[float, float], orientation: int) -> tuple[float, float]:
    """A horizontal and a vertical number after a picture stored with an EXIF orientation was turned upright."""
    return pair[::-1] if orientation >= 5 else pair


def turned_tag(tag: Tag, orientation: int) -> Tag:
    """A tag of a picture that was turned upright: a quarter turn swaps the two resolutions."""
    return replace(tag, code=SWAPPED.get(tag.code, tag.code)) if orientation >= 5 else tag


def sound(pair: Sequence[object] | None) -> tuple[float, float] | None:
    """Return a print resolution if it is two valid numbers, else None."""
    try:
        x, y = (float(value) for value in pair or ())  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):  # of damaged files
        return None
    return (x, y) if all(1 <= value <= 60_000 for value in (x, y)) else None  # 1 without a unit is not a resolution
