"""Image files in memory: PNG, JPEG, TIFF, WebP and AVIF at their own depth, with alpha, EXIF and colour profile.

Needs the ``cli`` extra (Pillow, tifffile, imagecodecs, psutil).
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import psutil
import torch
from PIL import Image
from torch import Tensor

from nlfilter_torch.photo.io import cameras, tiff
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io.by_pillow import read_by_pillow
from nlfilter_torch.photo.io.decoded import Channels
from nlfilter_torch.photo.io.extras import NO_EXTRAS, Extras, encode_deep_png, read_extras
from nlfilter_torch.photo.io.writing import check_file, open_beside
from nlfilter_torch.photo.tiled.pictures import Picture, stored_as

Depth = Literal["uint8", "uint16", "float16", "float32", "float64"]

BITS = {"uint8": "8 bits", "uint16": "16 bits", "float16": "floats", "float32": "floats", "float64": "floats"}
# Depths supported by each file type. JPEG has no alpha, PNG no floats.
DEPTHS: dict[str, tuple[str, ...]] = {
    "PNG": ("uint8", "uint16"),
    "JPEG": ("uint8",),
    "WebP": ("uint8",),
    "AVIF": ("uint8",),
    "TIFF": ("uint8", "uint16", "float16", "float32", "float64"),
}
ENCODING: dict[str, dict[str, object]] = {
    "JPEG": {"quality": 95, "subsampling": 0},
    "WebP": {"lossless": True, "exact": True},  # exact: also where it is transparent
    "AVIF": {"quality": 90, "subsampling": "4:4:4"},
}
LONGEST_SIDE = {"WebP": 16383, "JPEG": 65500}  # pixels
LONGEST_EXIF = 65533  # bytes, in JPEG
CONVERTED = 1 << 18  # pixels that are converted at a time between files and floats
SUFFIXES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WebP", ".avif": "AVIF"}
SUFFIXES |= {".tif": "TIFF", ".tiff": "TIFF"}


@dataclass(frozen=True)
class Photograph:
    """An image file in memory: pixels to compute with, and the metadata to write back.

    Attributes:
        pixels: (1, C, H, W), C = 1 or 3, upright. Integer files are scaled to [0, 1]; float files keep their own
            values. float32, or float64 for a file of 64-bit floats.
        depth: How a channel is stored in the file, as the name of a numpy dtype.
        alpha: (1, 1, H, W), scaled like the pixels, or None. It is not edited.
        icc: The colour profile, or None. Pixels are not converted.
        exif: The EXIF block, with orientation 1 since the pixels are upright, or None.
        extras: XMP and print resolution.
    """

    pixels: Tensor
    depth: Depth = "uint8"
    alpha: Tensor | None = None
    icc: bytes | None = None
    exif: bytes | None = None
    extras: Extras = NO_EXTRAS

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        return self.pixels.shape[-2], self.pixels.shape[-1]

    def with_pixels(self, pixels: Tensor) -> "Photograph":
        """Return a copy with other pixels (1, C, H, W), from any device; a different C drops the profile."""
        icc = self.icc if pixels.shape[1] == self.pixels.shape[1] else None
        return replace(self, pixels=pixels.detach().to(self.pixels), icc=icc)


class TooLarge(MemoryError):
    """A picture that needs more memory to be edited whole than is available."""


def read_photograph(path: str | Path, *, bytes_per_pixel: int = 0, memory: int | None = None) -> Photograph:
    """Read an image file.

    Args:
        path: A PNG, JPEG, TIFF, WebP or AVIF file, recognised by its content: grey or RGB, with or without alpha, 8 or
            16 bits, 10 or 12 (AVIF, read as 16) or floats (TIFF). Of several pages or pictures in a TIFF or JPEG file,
            the first is read. With the extras ``raw`` and ``heic`` also HEIC files, and RAW files, which are recognised
            by their suffix and read as 16 bits.
        bytes_per_pixel: Memory that editing will need per pixel in float32, checked before decoding; doubled for files
            of 64-bit floats.
        memory: Bytes that may be used; None is the free memory.

    Returns:
        The photograph, turned upright.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is empty, damaged, not an image, or of an unsupported kind.
        TooLarge: ``bytes_per_pixel`` for all pixels exceeds the memory. It is a MemoryError.
    """
    path = Path(path)
    channels, icc, exif = read_channels(path, bytes_per_pixel=bytes_per_pixel, memory=memory)

    depth = check_depth(path, channels.dtype)
    planes = _planes(Picture(channels, str(path), channels=channels.shape[2]))
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], depth, alpha, icc, exif, read_extras(path))  # type: ignore[arg-type]


def _planes(picture: Picture) -> Tensor:
    """All channels (1, S, H, W) of a picture, converted a few rows at a time, which takes the least memory."""
    planes = torch.empty(1, picture.samples, *picture.size, dtype=picture.dtype)
    for tile in picture.tiles(0, max(1, CONVERTED // picture.size[1])):
        planes[:, :, tile.start : tile.start + tile.pixels.shape[2]] = tile.pixels
    return planes


def check_depth(path: str | Path, dtype: np.dtype[np.generic]) -> str:
    """Return the depth of a file whose channels have that dtype; raises ValueError if it is not supported."""
    if dtype.name not in BITS:
        raise ValueError(
            f"{path} stores its channels as {dtype.name}, which is not supported; convert it to 8 or 16 bits or floats"
        )
    return dtype.name


def first_bytes(path: Path) -> bytes:
    """Read the first bytes of a file, which identify its type.

    Raises:
        FileNotFoundError, ValueError: see :func:`read_photograph`.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; check the name and the folder")
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not an image file; name a file in it")
    if not path.is_file():  # opening a pipe would block
        raise ValueError(f"{path} is a pipe, a socket or a device, not a file; save the picture in a file first")
    try:
        with path.open("rb") as stream:
            head = stream.read(32)
    except PermissionError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}; check its permissions, or copy it") from error
    if not head:
        raise ValueError(f"{path} is empty; copy it again from its source")
    return head


def read_channels(
    path: Path, *, bytes_per_pixel: int, memory: int | None
) -> tuple[Channels, bytes | None, bytes | None]:
    """Read upright channels (H, W, S) in the stored dtype, profile and EXIF; see :func:`read_photograph`."""
    head = first_bytes(path)
    check_size = partial(_check_size, path, bytes_per_pixel, memory)
    if cameras.is_raw(path):
        decoded = cameras.read_raw(path, check_size)
    elif cameras.is_heic(head):
        decoded = cameras.read_heic(path, check_size)
    elif tiff.is_tiff(head):
        decoded = tiff.read(path, check_size)
    else:
        deep_png = head.startswith(b"\x89PNG") and head[24:25] == b"\x10"  # the bit depth in the header
        decoded = read_by_pillow(path, deep_png, check_size)
    return exif_tags.upright(decoded.channels, decoded.orientation), decoded.icc, decoded.exif


def _check_size(
    path: Path, bytes_per_pixel: int, memory: int | None, size: tuple[int, int], *, double: bool = False
) -> None:
    """Check the memory that a picture of (width, height) needs; twice as much for 64-bit pixels."""
    check_memory(path, *size, bytes_per_pixel * (1 + double), memory)


def write_photograph(photograph: Photograph, path: str | Path) -> None:
    """Write an image file at the photograph's depth; the extension of the name selects the type.

    Integer channels are clipped to their range and rounded. JPEG is written at quality 95 without chroma subsampling,
    AVIF at 90, WebP and TIFF without loss. The file appears complete or not at all.

    Raises:
        ValueError: See :func:`~nlfilter_torch.photo.io.check_output`.
        OSError: The file cannot be written.
    """
    path = Path(path)
    kind = check_output(path, photograph)
    planes = [photograph.pixels] if photograph.alpha is None else [photograph.pixels, photograph.alpha]
    rows = max(1, CONVERTED // photograph.size[1])
    parts = zip(*(plane.split(rows, dim=2) for plane in planes), strict=True)
    channels = np.concatenate([stored_as(torch.cat(part, dim=1), photograph.depth) for part in parts])  # (H, W, S)
    with open_beside(path) as stream:
        encode(stream, kind, channels, photograph.alpha is not None, photograph.icc, photograph.exif, photograph.extras)


def encode(
    stream: BinaryIO,
    kind: str,
    channels: Channels,
    alpha: bool,
    icc: bytes | None,
    exif: bytes | None,
    extras: Extras,
) -> None:
    """Write channels (H, W, S) in their dtype as an image file of a type in :data:`DEPTHS`."""
    channels = channels[..., 0] if channels.shape[2] == 1 else channels
    if kind == "TIFF":
        tiff.write(stream, channels, channels.shape, channels.dtype, alpha, icc, exif, extras.xmp, **extras.tags())
    elif channels.dtype == np.uint16:
        stream.write(encode_deep_png(channels, icc, exif, extras))
    else:
        if exif is not None and kind == "AVIF":  # Pillow would remove it, and write the block anew
            exif = exif_tags.without_orientation(exif)
        options: dict[str, object] = {"icc_profile": icc, "exif": exif or b""} | ENCODING.get(kind, {})
        options |= extras.options(kind)
        Image.fromarray(channels).save(stream, format=kind, **options)


def check_output(path: str | Path, photograph: Photograph) -> str:
    """Raise ValueError unless ``photograph`` can be written to ``path``; return the file type.

    Call it before long work, so that the error comes early.
    """
    return check_type(path, photograph.depth, photograph.alpha is not None, photograph.size, photograph.exif)


def check_type(
    path: str | Path, depth: str, alpha: bool, size: tuple[int, int] = (1, 1), exif: bytes | None = None
) -> str:
    """Check, as :func:`check_output`, a picture of that depth and size (H, W), with or without alpha."""
    path = Path(path)
    check_file(path)
    kind = SUFFIXES.get(path.suffix.lower())
    if kind is None:
        raise ValueError(
            f"{path} must end in .png, .jpg, .webp, .avif or .tif, got {path.suffix!r}; choose one of these"
        )
    if depth not in DEPTHS[kind]:
        others = " or ".join(name for name, depths in DEPTHS.items() if depth in depths)
        raise ValueError(
            f"{path} cannot hold this picture: {kind} has no {BITS[depth]} per channel; "
            f"write a {others} file or choose a depth of {BITS[DEPTHS[kind][-1]]}"
        )
    if alpha and kind == "JPEG":
        raise ValueError(
            f"{path} cannot hold this picture: JPEG has no alpha channel; write a PNG, TIFF, WebP or AVIF file"
        )
    if max(size) > LONGEST_SIDE.get(kind, max(size)):
        raise ValueError(
            f"{path} cannot hold this picture: {kind} has at most {LONGEST_SIDE[kind]} pixels per side, got "
            f"{size[1]}x{size[0]}; write a PNG or TIFF file"
        )
    if kind == "JPEG" and len(exif or b"") > LONGEST_EXIF:
        raise ValueError(
            f"{path} cannot hold this picture: JPEG has at most {LONGEST_EXIF} bytes of EXIF data, got "
            f"{len(exif or b'')}; write a PNG, TIFF or WebP file"
        )
    return kind


def check_memory(path: Path, width: int, height: int, bytes_per_pixel: int, memory: int | None = None) -> None:
    """Raise TooLarge if ``width * height * bytes_per_pixel`` exceeds ``memory``; None is the free memory."""
    needed = width * height * bytes_per_pixel
    free = psutil.virtual_memory().available if memory is None else memory
    if needed > free:
        limit = (
            f"only {_size(free)} is free; " if memory is None else f"only {_size(free)} may be used; allow more, or "
        )
        raise TooLarge(
            f"{path} has {width}x{height} pixels and needs about {_size(needed)} of memory, but {limit}"
            "use fewer landmarks, smaller patches or a smaller picture"
        )


def _size(count: int) -> str:
    """Format a number of bytes."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
