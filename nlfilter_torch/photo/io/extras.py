"""Metadata of image files besides profile and EXIF: XMP and print resolution."""

import io
import math
import re
import struct
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io import tiff

PNG_KEY = "XML:com.adobe.xmp"
JPEG_LIMIT = 65_000  # bytes of XMP that fit in a JPEG segment; longer packets are not written
INCH, CENTIMETRE = 2, 3  # values of the TIFF tag ResolutionUnit
# Pixels are turned upright when read, but XMP may repeat the original orientation.
ORIENTATION = re.compile(rb"(tiff:Orientation\s*(?:=\s*[\"']|>)\s*)[1-8]")


@dataclass(frozen=True)
class Extras:
    """Metadata of a file to write back.

    Attributes:
        xmp: an XMP packet, or None.
        dpi: pixels per inch, horizontal and vertical, or None.
    """

    xmp: bytes | None = None
    dpi: tuple[float, float] | None = None

    def options(self, kind: str) -> dict[str, object]:
        """Options for Pillow to write the metadata to a JPEG, WebP, AVIF or PNG file."""
        options: dict[str, object] = {}
        if self.dpi is not None and kind not in ("WebP", "AVIF"):
            options["dpi"] = self.dpi
        if self.xmp is None:
            return options
        if kind == "JPEG" and len(self.xmp) > JPEG_LIMIT:
            warn(
                f"XMP metadata of {len(self.xmp)} bytes is left out, as JPEG holds at most {JPEG_LIMIT}; write a PNG, "
                "TIFF, WebP or AVIF file to keep it"
            )
            return options
        if kind != "PNG":
            return options | {"xmp": self.xmp}
        info = PngImagePlugin.PngInfo()
        info.add_itxt(PNG_KEY, self.xmp.decode("utf-8", "replace"))
        return options | {"pnginfo": info}

    def chunks(self) -> list[tuple[bytes, bytes]]:
        """The metadata as chunks of a PNG file."""
        chunks = []
        if self.dpi is not None:
            chunks.append((b"pHYs", struct.pack(">IIB", *(round(value / 0.0254) for value in self.dpi), 1)))
        if self.xmp is not None:
            chunks.append((b"iTXt", PNG_KEY.encode() + bytes(5) + self.xmp))
        return chunks

    def tags(self) -> tiff.Resolution:
        """Options for tifffile to write the resolution; XMP is written with the extra tags."""
        return {} if self.dpi is None else {"resolution": self.dpi, "resolutionunit": INCH}


NO_EXTRAS = Extras()


def read_extras(path: Path) -> Extras:
    """Read the extras of an image file whose pixels can be read; invalid fields are dropped."""
    try:
        return _read(path)
    except Exception:  # decoders have no common base class for errors
        return NO_EXTRAS


def _read(path: Path) -> Extras:
    with path.open("rb") as stream:
        is_tiff = tiff.is_tiff(stream.read(4))
    if is_tiff:
        with tifffile.TiffFile(path) as file:
            tags = file.pages.first.tags
            values = {code: tags[code].value for code in (tiff.XMP, 282, 283, 296) if code in tags}
        scale = {INCH: 1.0, CENTIMETRE: 2.54}.get(values.get(296, INCH))
        pair = None if scale is None else tuple(_ratio(values.get(code)) * scale for code in (282, 283))
        return Extras(_upright(values.get(tiff.XMP)), _sound(pair))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns about sizes and damaged EXIF
        with Image.open(path) as image:
            if image.format == "PNG" and not _xmp(image) and _has_late_text(path):
                image.load()  # also reads what follows the pixels
            xmp = _xmp(image)
            return Extras(_upright(xmp.encode() if isinstance(xmp, str) else xmp), _sound(image.info.get("dpi")))


def _xmp(image: Image.Image) -> bytes | str | None:
    return image.info.get("xmp", image.info.get(PNG_KEY))


def _has_late_text(path: Path) -> bool:
    """Whether a PNG file has text behind its pixels, where some programs write XMP."""
    with path.open("rb") as stream:
        stream.seek(8)  # signature
        pixels = False
        while len(head := stream.read(8)) == 8:
            length, name = struct.unpack(">I4s", head)
            if pixels and name == b"iTXt":
                return True
            pixels = pixels or name == b"IDAT"
            stream.seek(length + 4, 1)  # content and checksum
    return False


def _ratio(value: object) -> float:
    """Convert a TIFF fraction to a float; NaN if it is invalid."""
    if isinstance(value, tuple) and len(value) == 2 and value[1]:
        return float(value[0]) / float(value[1])
    return math.nan


def _sound(pair: Sequence[float] | None) -> tuple[float, float] | None:
    """Return the resolution if it is two valid numbers, else None."""
    try:
        x, y = (float(value) for value in pair or ())
    except (TypeError, ValueError):  # of damaged files
        return None
    return (x, y) if all(1 <= value <= 60_000 for value in (x, y)) else None  # 1 without a unit is not a resolution


def _upright(xmp: object) -> bytes | None:
    """Set the orientation in an XMP packet to upright."""
    return ORIENTATION.sub(rb"\g<1>1", xmp) if isinstance(xmp, bytes) and xmp.strip() else None


def encode_deep_png(channels: NDArray[np.generic], icc: bytes | None, exif: bytes | None, extras: Extras) -> bytes:
    """Encode a 16-bit PNG file, with profile, EXIF and extras between header and pixels as the format requires."""
    encoded = imagecodecs.png_encode(channels)
    start = 8 + 25  # signature and header chunk, of fixed length
    chunks = io.BytesIO()
    if icc is not None:
        PngImagePlugin.putchunk(chunks, b"iCCP", b"ICC Profile\0\0", zlib.compress(icc))
    if exif is not None:
        PngImagePlugin.putchunk(chunks, b"eXIf", exif.removeprefix(exif_tags.PREFIX))
    for name, content in extras.chunks():
        PngImagePlugin.putchunk(chunks, name, content)
    return bytes(encoded[:start]) + chunks.getvalue() + bytes(encoded[start:])
