"""What readers of image files return and writers take: pixels as they are stored, and what the file says of them.

That is colour profile, EXIF, XMP, print resolution, tags of TIFF, and what is not copied.
"""

import io
import re
import struct
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from mmap import mmap
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from PIL import ImageCms
from PIL.ExifTags import Base
from tifffile import DATATYPE, TIFF

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files.tables import LENGTHS, RESOLUTION

if sys.platform == "linux":
    from mmap import MADV_DONTNEED

SWAPPED: dict[int, int] = {Base.XResolution: Base.YResolution, Base.YResolution: Base.XResolution}
# Tags that say how a TIFF file stores its pixels. The output has its own.
STORAGE_TAGS = frozenset((*range(254, 260), 262, *range(263, 267), 273, *range(277, 280), 284, 288, 289, 292, 293))
STORAGE_TAGS |= {317, 320, 321, *range(322, 329), 332, 333, 334, 336, 338, 339, 347, *range(512, 522), *range(529, 533)}
STORAGE_TAGS |= {32995, 32996, 32997, 32998, 34675}
#: Tags of GeoTIFF and GDAL: where the pixels lie on the ground, notes, and the value without data.
GEO_KEYS = ("GeoKeyDirectoryTag", "GeoDoubleParamsTag", "GeoAsciiParamsTag")
TIES = ("ModelPixelScaleTag", "ModelTiepointTag", "ModelTransformationTag")
GROUND = tuple(int(TIFF.TAGS[name]) for name in (*TIES, *GEO_KEYS))
GDAL_NOTES, NODATA = 42112, 42113
#: Tags that hold levels, or a value for each level.
OF_A_DEPTH = (
    *(NODATA, Base.MinSampleValue, Base.MaxSampleValue, Base.SMinSampleValue, Base.SMaxSampleValue),
    *(Base.GrayResponseUnit, Base.GrayResponseCurve, Base.TransferFunction),
)
CENTIMETRES = 2.54  # in an inch
FRACTIONS = (DATATYPE.RATIONAL, DATATYPE.SRATIONAL)  # types of two numbers


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

    def in_order(self, order: str) -> bytes:
        """The values in a byte order."""
        if order == self.order:
            return self.data
        unit = LENGTHS[self.kind] // (2 if self.kind in FRACTIONS else 1)
        return np.frombuffer(self.data, f"V{unit}").view(f"u{unit}").byteswap().tobytes()


class FilePart(NamedTuple):
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
    parts: tuple[FilePart, ...] = ()
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


def turned_pair(pair: tuple[float, float], orientation: int) -> tuple[float, float]:
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


@dataclass(frozen=True)
class Metadata:
    """What a file says about its picture.

    Attributes:
        icc: colour profile, or None.
        exif: EXIF block with orientation 1, or None.
        extras: the rest.
    """

    icc: bytes | None = None
    exif: bytes | None = None
    extras: Extras = NO_EXTRAS


NO_METADATA = Metadata()


class UnhandledImage(ValueError):
    """A valid image file of an unsupported kind."""


class Decoded(NamedTuple):
    """The content of an image file.

    Attributes:
        channels: (H, W, S), as stored, so perhaps not upright.
        orientation: EXIF orientation, 1 to 8; 1 is upright.
        metadata: what the file says about them once they are upright.
    """

    channels: Stored
    orientation: int
    metadata: Metadata


@dataclass(frozen=True)
class Header:
    """What a file to write says of its picture.

    Attributes:
        shape: (H, W, S).
        dtype: of the channels.
        alpha: whether the last channel is transparency.
        metadata: the rest.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[np.generic]
    alpha: bool
    metadata: Metadata


class CheckSize(Protocol):
    """Raises TooLarge if a picture of that size needs more memory than may be used."""

    def __call__(self, size: tuple[int, int], /, *, double: bool = False) -> None:
        """Check the size (width, height); ``double`` if the pixels are 64-bit floats."""


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Report any error in the block as a damaged file, since decoders have no common base class for errors."""
    try:
        yield
    except (MemoryError, UnhandledImage, Warning):  # warnings that are errors are not damage
        raise
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path} is damaged or cut short ({reason}); copy it again from its source") from error


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the warnings of Pillow about damaged EXIF blocks, which it does not read for us."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def release(data: bytes | mmap) -> None:
    """Give back the memory for what was read of a file that is mapped to be read; it is read again when needed."""
    if sys.platform == "linux" and isinstance(data, mmap):
        data.madvise(MADV_DONTNEED)


def bands(rows: Iterable[Stored], height: int) -> Iterator[Stored]:
    """Regroup rows (h, W, S) into pieces of the same ``height``, the last one possibly shorter.

    >>> [len(band) for band in bands([np.zeros((3, 1, 1)), np.zeros((4, 1, 1))], 2)]
    [2, 2, 2, 1]
    """
    waiting: list[Stored] = []
    for piece in rows:
        waiting.append(piece)
        while sum(map(len, waiting)) >= height:
            # A single piece may be the whole picture, which is not copied.
            whole = waiting[0] if len(waiting) == 1 else np.concatenate(waiting)
            waiting = [whole[height:]]
            yield whole[:height]
    if waiting and sum(map(len, waiting)):
        yield np.concatenate(waiting)


# --- XMP packets

# Pixels are turned upright when read, but XMP may repeat the original orientation.
XMP_ORIENTATION = re.compile(rb"(tiff:Orientation\s*(?:=\s*[\"']|>)\s*)[1-8]")
MOTION = "the video of a motion photo"
FURTHER_PICTURES = "further pictures"
GAIN_MAP = "a gain map"
DEPTH = "a depth map"
GOOGLE = b"http://ns.google.com/photos/1.0/"
#: Statements by their namespace: the usual prefix, the names (None for all), and what they state to be in the file.
XMP_STATEMENTS: dict[bytes, tuple[bytes, bytes | None, str]] = {
    b"http://ns.adobe.com/hdr-gain-map/1.0/": (b"hdrgm", None, GAIN_MAP),
    b"http://ns.apple.com/HDRGainMap/1.0/": (b"HDRGainMap", None, GAIN_MAP),
    GOOGLE + b"camera/": (b"GCamera", rb"(?:MotionPhoto|MicroVideo)\w*", MOTION),
    GOOGLE + b"container/": (b"Container", None, FURTHER_PICTURES),
    GOOGLE + b"container/item/": (b"Item", None, FURTHER_PICTURES),
    GOOGLE + b"depthmap/": (b"GDepth", None, DEPTH),
    GOOGLE + b"image/": (b"GImage", None, FURTHER_PICTURES),
    GOOGLE + b"audio/": (b"GAudio", None, "sound"),
    b"http://ns.google.com/photos/dd/1.0/device/": (b"Device", None, FURTHER_PICTURES),
    b"http://ns.apple.com/pixeldatainfo/1.0/": (b"apdi", None, FURTHER_PICTURES),
    b"http://ns.adobe.com/xmp/note/": (b"xmpNote", b"HasExtendedXMP", "an extension of XMP"),
}
MARKED_REGIONS = "regions of the picture such as faces, as it is turned"
#: Statements about places in the picture.
XMP_PLACES: dict[bytes, tuple[bytes, bytes | None, str]] = {
    b"http://www.metadataworkinggroup.com/schemas/regions/": (b"mwg-rs", None, MARKED_REGIONS),
    b"http://ns.microsoft.com/photo/1.2/": (b"MP", b"RegionInfo", MARKED_REGIONS),
    b"http://ns.apple.com/faceinfo/1.0/": (b"apple-fi", None, MARKED_REGIONS),
}


def upright_packet(xmp: bytes | None, orientation: int = 1) -> tuple[bytes | None, list[str]]:
    """An XMP packet of an upright picture, and what was in it and is left out.

    Args:
        xmp: as it stands in the file. Its orientation is set to 1, and statements about other pictures are left out.
        orientation: of the picture as it is stored; of a turned one, places in it are left out.
    """
    if not isinstance(xmp, bytes) or not xmp.strip(b"\0 \r\n\t"):
        return None, []
    xmp = XMP_ORIENTATION.sub(rb"\g<1>1", xmp)
    named = []
    statements = XMP_STATEMENTS | (XMP_PLACES if orientation > 1 else {})
    for namespace, (usual, names, content) in statements.items():
        declared = re.findall(rb"xmlns:([\w.-]+)\s*=\s*[\"']" + re.escape(namespace) + rb"[\"']", xmp)
        for prefix in dict.fromkeys([*declared, usual]):
            shorter = _without(xmp, prefix, names or rb"[\w.-]+")
            if shorter != xmp:
                named.append(content)
                xmp = shorter
    return (_without_declarations(xmp) if named else xmp), named


def _without(xmp: bytes, prefix: bytes, names: bytes) -> bytes:
    """The packet without attributes and elements of these names."""
    name = re.escape(prefix) + rb":(" + names + rb")"
    # One space before it, since many of them at a time would take quadratic time in packets with padding.
    xmp = re.sub(rb"\s" + name + rb"\s*=\s*(?:\"[^\"]*\"|'[^']*')", b"", xmp)
    end = rb"</" + re.escape(prefix) + rb":\1\s*>"
    return re.sub(rb"<" + name + rb"(?=[\s/>])(?:[^<>]*/>|[^<>]*>.*?" + end + rb")\s*", b"", xmp, flags=re.DOTALL)


def _without_declarations(xmp: bytes) -> bytes:
    """The packet without declarations of these namespaces that are not used any more."""
    for namespace in XMP_STATEMENTS | XMP_PLACES:
        declaration = rb"\sxmlns:([\w.-]+)\s*=\s*[\"']" + re.escape(namespace) + rb"[\"']"
        for prefix in re.findall(declaration, xmp):
            rest = re.sub(declaration, b"", xmp)
            xmp = xmp if re.search(rb"[\s<]" + re.escape(prefix) + rb":", rest) else rest
    return xmp


# --- colours that a file describes by numbers in place of a profile, which the output does not describe

# Numbers of ITU-T H.273 (CICP). None stands for those that are reserved, unspecified, or of sRGB, and for curves close
# to that of sRGB, which viewers treat alike.
PRIMARIES: dict[int, str | None] = {**dict.fromkeys((0, 1, 2)), 4: "BT.470", 5: "BT.601", 6: "BT.601"}
PRIMARIES |= {7: "SMPTE 240M", 9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}
TRANSFERS: dict[int, str | None] = {**dict.fromkeys((0, 1, 2, 4, 6, 13, 14, 15)), 5: "a gamma of 2.8"}
TRANSFERS |= {8: "linear light", 16: "PQ", 17: "SMPTE 428", 18: "HLG"}
HDR = (16, 18)

# Of PNG files.
SRGB = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # x and y of white, red, green and blue
NEAR_SRGB = 0.01
GAMMA = 1 / 2.2
NEAR_GAMMA = 0.05  # share


#: Chromaticities, x and y, of red, green and blue in profiles with these primaries, as adapted to their white (D50).
IN_PROFILES = {
    1: ((0.6485, 0.3309), (0.3212, 0.5979), (0.1559, 0.0660)),
    9: ((0.7084, 0.2935), (0.1902, 0.7754), (0.1293, 0.0471)),
    12: ((0.6820, 0.3194), (0.2846, 0.6746), (0.1559, 0.0661)),
}


def has_primaries(profile: bytes, primaries: int) -> bool:
    """Whether a colour profile has the primaries of a number of H.273, of those in :data:`IN_PROFILES`."""
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile)).profile
    except (OSError, ValueError):  # no profile
        return False
    colorants = (opened.red_colorant, opened.green_colorant, opened.blue_colorant)
    wanted = IN_PROFILES.get(primaries)
    if wanted is None or not all(colorants):
        return False
    given = [colorant[1][:2] for colorant in colorants if colorant]
    return bool(np.abs(np.subtract(given, wanted)).max() < NEAR_SRGB)


def check_profile(path: Path, profile: bytes | None) -> None:
    """Raise UnhandledImage if a colour profile says, by its tag of numbers, that the picture is an HDR picture."""
    if profile is None or len(profile) < 132:
        return
    (count,) = struct.unpack_from(">I", profile, 128)
    for place in range(132, min(132 + 12 * count, len(profile) - 11), 12):
        name, start = struct.unpack_from(">4sI", profile, place)
        numbers = profile[start + 8 : start + 10]
        if name == b"cicp" and len(numbers) == 2 and numbers[1] in HDR:
            check_colour_numbers(path, *numbers)


def check_colour_numbers(path: Path, primaries: int, transfer: int, unless: str = "") -> None:
    """Warn if colours described by these numbers are not close to sRGB; ``unless`` is which output says them.

    Raises:
        UnhandledImage: if they are those of an HDR picture.
    """
    if transfer in HDR:
        raise UnhandledImage(
            f"{path} is an HDR picture ({TRANSFERS[transfer]}), which is not supported; convert it to sRGB, or to a "
            "TIFF file with a colour profile"
        )
    names = (
        PRIMARIES.get(primaries, f"primaries number {primaries}"),
        TRANSFERS.get(transfer, f"transfer function number {transfer}"),
    )
    _warn_of_colours(path, [name for name in names if name is not None], unless)


def check_png_colours(path: Path, gamma: float | None, chromaticities: Sequence[float] | None) -> None:
    """Warn if the chunks gAMA and cHRM of a PNG file describe other colours than sRGB; None if a chunk is missing."""
    unusual = []
    if chromaticities is not None and max(abs(a - b) for a, b in zip(chromaticities, SRGB, strict=True)) > NEAR_SRGB:
        unusual.append("other primaries than sRGB")
    if gamma is not None and gamma > 0 and abs(gamma / GAMMA - 1) > NEAR_GAMMA:
        unusual.append(f"a gamma of {1 / gamma:.2g}")
    _warn_of_colours(path, unusual)


def _warn_of_colours(path: Path, unusual: Sequence[str], unless: str = "") -> None:
    if unusual:
        warn(
            f"{path} has {' and '.join(unusual)} without a colour profile, which the output will not say{unless}, so "
            "that its colours will look different; convert the photograph to sRGB, or embed a profile, before the edit"
        )
