"""Image files in memory: PNG, JPEG, TIFF, WebP and AVIF at their own depth, with alpha, EXIF and colour profile.

Needs the ``cli`` extra (Pillow, tifffile, imagecodecs, psutil).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.operator.hidden import REACH
from nlfilter_torch.photo.files import by_pillow, cameras, jpeg, png, tiff
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files.decoded import Channels, CheckSize, Decoded, Metadata, UnhandledImage, decoding
from nlfilter_torch.photo.files.exif_in_tiff import shortened
from nlfilter_torch.photo.files.extras import NO_EXTRAS, Extras, note_left_out
from nlfilter_torch.photo.files.writing import check_file, open_beside
from nlfilter_torch.photo.picture.pictures import (
    NodataRows,
    Picture,
    is_hidden,
    keep_apart,
    put_back,
    stored_as,
    transparency,
)

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
# Pixels. Those of libpng and libavif are what they decode.
LONGEST_SIDE = {"WebP": 16383, "JPEG": 65500, "PNG": png.LONGEST_SIDE, "AVIF": by_pillow.LONGEST_AVIF}
MOST_PIXELS = {"AVIF": by_pillow.MOST_AVIF}
LONGEST_EXIF = jpeg.LONGEST  # bytes, in JPEG
CONVERTED = 1 << 18  # pixels that are converted at a time between files and floats
SUFFIXES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WebP", ".avif": "AVIF"}
SUFFIXES |= {".tif": "TIFF", ".tiff": "TIFF"}


@dataclass(frozen=True)
class HiddenPixels:
    """The pixels of a file that do not count: transparent ones, and those without data.

    Attributes:
        places: where they are, (H, W).
        colours: as they are stored, (n, C).
        nodata: the value that says that there is no data, or None.
    """

    places: NDArray[np.bool_]
    colours: Channels
    nodata: float | None = None

    def put_back(self, channels: Channels) -> None:
        """Put them back into the channels (H, W, S) of the file; no other pixel gets the value of those without data.

        Several channels of one that is stored are colours.
        """
        colours = channels[..., : 3 if channels.shape[2] >= 3 else 1]
        put_back(colours, self.colours, self.places)
        if self.nodata is not None:
            keep_apart(colours, self.places, self.nodata)


@dataclass(frozen=True)
class Photograph:
    """An image file in memory: pixels to compute with, and the metadata to write back.

    Attributes:
        pixels: (1, C, H, W), C = 1 or 3, upright. Integer files are scaled to [0, 1]; float files keep their own
            values. float32, or float64 for a file of 64-bit floats. Hidden pixels have colours of pixels nearby.
        depth: How a channel is stored in the file, as the name of a numpy dtype.
        alpha: (1, 1, H, W), scaled like the pixels, or None. It is not edited.
        icc: The colour profile, or None. Pixels are not converted.
        exif: The EXIF block, with orientation 1 since the pixels are upright, or None.
        extras: XMP and print resolution.
        hidden: The pixels that do not count, which are written back as they were, or None.
    """

    pixels: Tensor
    depth: Depth = "uint8"
    alpha: Tensor | None = None
    icc: bytes | None = None
    exif: bytes | None = None
    extras: Extras = NO_EXTRAS
    hidden: HiddenPixels | None = None

    @property
    def weights(self) -> Tensor | None:
        """How much pixels count, (1, 1, H, W) in [0, 1]; None if all count, or none do."""
        weights = self.pixels.new_ones(1, 1, *self.size) if self.alpha is None else self.alpha.clamp(0, 1)
        if self.hidden is not None:
            weights = weights * torch.from_numpy(~self.hidden.places)
        return weights if 0 < float(weights.sum()) < weights.numel() else None

    @property
    def metadata(self) -> Metadata:
        """Profile, EXIF and the rest."""
        return Metadata(self.icc, self.exif, self.extras)

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
    decoded = read_channels(path, bytes_per_pixel=bytes_per_pixel, memory=memory)
    channels, metadata = decoded.channels, decoded.metadata
    depth = check_depth(path, channels.dtype)
    planes, hidden = _planes_of(channels, metadata.extras.nodata, str(path))
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], depth, alpha, metadata.icc, metadata.exif, metadata.extras, hidden)  # type: ignore[arg-type]


def _planes_of(channels: Channels, nodata: float | None, name: str) -> tuple[Tensor, HiddenPixels | None]:
    """All channels (1, S, H, W) of a picture, converted a few rows at a time to save memory, and what it hides."""
    marked = nodata is not None and channels.shape[2] in (1, 3)
    picture = Picture(NodataRows(channels, nodata) if marked and nodata is not None else channels, name)
    picture.accept_any_scale()  # until it is edited
    planes = torch.empty(1, channels.shape[2], *picture.size, dtype=picture.dtype)
    places = np.zeros(picture.size if picture.hides else (0, 0), np.bool_)
    rows = max(CONVERTED // picture.size[1], 4 * REACH if picture.hides else 1)
    for tile in picture.tiles(0, rows):
        part = slice(tile.start, tile.start + len(tile.stored))
        planes[:, : picture.colours, part] = tile.pixels
        if picture.hides:
            places[part] = is_hidden(tile.stored)
        if channels.shape[2] > picture.colours:
            planes[:, picture.colours :, part] = torch.from_numpy(
                transparency(tile, planes.numpy().dtype.name)
            ).movedim(2, 0)
    if not places.any():
        return planes, None
    return planes, HiddenPixels(places, channels[places][:, : picture.colours], nodata if marked else None)


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


def read_channels(path: Path, *, bytes_per_pixel: int, memory: int | None) -> Decoded:
    """Read upright channels (H, W, S) in the stored dtype, and metadata; see :func:`read_photograph`."""
    head = first_bytes(path)
    check_size = partial(_check_size, path, bytes_per_pixel, memory)
    if cameras.is_raw(path):
        decoded = cameras.read_raw(path, check_size)
    elif cameras.is_heic(head):
        decoded = cameras.read_heic(path, check_size)
    elif tiff.is_tiff(head):
        decoded = tiff.read(path, check_size)
    else:
        with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data, decoding(path):
            decoded = _read_mapped(path, data, check_size)
    return decoded._replace(channels=exif_tags.upright(decoded.channels, decoded.orientation), orientation=1)


def _read_mapped(path: Path, data: mmap, check_size: CheckSize) -> Decoded:
    """Read a PNG, JPEG, WebP or AVIF file that is mapped into memory."""
    head = data[:32]
    if is_png(head):
        picture = png.open_png(path, data)
        check_size(picture.size)
        return Decoded(picture.decode(data), picture.orientation, picture.metadata)
    if is_jpeg(head):
        photo = jpeg.open_jpeg(path, data)
        check_size(photo.size)
        return Decoded(photo.decode(path), photo.orientation, photo.metadata)
    if by_pillow.is_webp(head):
        return by_pillow.read_webp(path, data, check_size)
    if by_pillow.is_avif(head):
        return by_pillow.read_avif(path, data, check_size)
    raise UnhandledImage(f"{path} is not a PNG, JPEG, TIFF, WebP or AVIF image; convert it to one of these")


def is_png(head: bytes) -> bool:
    """Whether a file with these first bytes is PNG."""
    return head.startswith(png.SIGNATURE)


def is_jpeg(head: bytes) -> bool:
    """Whether a file with these first bytes is JPEG."""
    return head.startswith(b"\xff\xd8\xff")


def _check_size(
    path: Path, bytes_per_pixel: int, memory: int | None, size: tuple[int, int], *, double: bool = False
) -> None:
    """Check the memory that a picture of (width, height) needs; twice as much for 64-bit pixels."""
    check_memory(path, *size, bytes_per_pixel * (1 + double), memory)


def write_photograph(photograph: Photograph, path: str | Path, *, quality: int | None = None) -> None:
    """Write an image file at the photograph's depth; the extension of the name selects the type.

    Integer channels are clipped to their range and rounded. JPEG is written at quality 95 without chroma subsampling,
    AVIF at 90, WebP and TIFF without loss. The file appears complete or not at all.

    Args:
        photograph: what to write.
        path: name of the file.
        quality: of a JPEG file, 1 to 100; None is 95. Other types of file ignore it.

    Raises:
        ValueError: if the quality is out of range; see also :func:`~nlfilter_torch.photo.files.check_output`.
        OSError: The file cannot be written.
    """
    if quality is not None:
        check_count(quality, "quality", most=100)
    path = Path(path)
    kind = check_output(path, photograph)
    planes = [photograph.pixels] if photograph.alpha is None else [photograph.pixels, photograph.alpha]
    rows = max(1, CONVERTED // photograph.size[1])
    parts = zip(*(plane.split(rows, dim=2) for plane in planes), strict=True)
    channels = np.concatenate([stored_as(torch.cat(part, dim=1), photograph.depth) for part in parts])  # (H, W, S)
    if photograph.hidden is not None:
        photograph.hidden.put_back(channels)
    alpha = photograph.alpha is not None
    with open_beside(path) as stream:
        metadata, left_out = with_thumbnail(photograph.metadata, None if kind == "TIFF" else channels)
        left_out += encode(stream, kind, [channels], channels.shape, channels.dtype, alpha, metadata, quality)
    note_left_out(path, left_out)


def encode(
    stream: BinaryIO,
    kind: str,
    rows: Iterable[Channels],
    shape: tuple[int, int, int],
    dtype: np.dtype[np.generic],
    alpha: bool,
    metadata: Metadata,
    quality: int | None = None,
) -> list[str]:
    """Write rows (h, W, S) of a picture of ``shape`` as an image file of a type in :data:`DEPTHS`.

    ``quality`` is that of JPEG files; None is the default.
    Returns the names of metadata that are left out.
    """
    extras = metadata.extras
    left_out = [*extras.left_out, *(part.name for part in extras.parts if part.kind != kind)]
    if kind == "TIFF":
        whole = np.concatenate(list(rows))
        whole = whole[..., 0] if shape[2] == 1 else whole
        return left_out + tiff.write(stream, whole, whole.shape, dtype, alpha, metadata)
    left_out += extras.lacking_tags()
    if kind == "PNG":
        png.write_png(stream, rows, shape, dtype, metadata)
    elif kind == "JPEG":
        metadata, lacking = fitting_jpeg(metadata)
        left_out += lacking
        jpeg.write_jpeg(stream, rows, shape, metadata, quality or jpeg.QUALITY)
    else:
        if extras.dpi is not None and exif_tags.resolution(metadata.exif) is None:
            left_out.append("the print resolution")
        whole = np.concatenate(list(rows))
        by_pillow.write_by_pillow(stream, kind, whole[..., 0] if shape[2] == 1 else whole, metadata)
    return left_out


def with_thumbnail(metadata: Metadata, channels: Channels | None) -> tuple[Metadata, list[str]]:
    """Metadata whose thumbnail, if they have any, shows channels (H, W, S), or is left out and named."""
    if metadata.exif is None or not exif_tags.has_thumbnail(metadata.exif):
        return metadata, []
    block = exif_tags.refreshed(metadata.exif, channels)
    return replace(metadata, exif=block), [] if exif_tags.has_thumbnail(block) else ["the thumbnail"]


def fitting_jpeg(metadata: Metadata) -> tuple[Metadata, list[str]]:
    """Metadata that a JPEG file can hold, and what it cannot."""
    left_out = []
    if metadata.exif is not None and len(metadata.exif) > LONGEST_EXIF:
        metadata = replace(metadata, exif=shortened(metadata.exif, LONGEST_EXIF))
        left_out.append("the maker note, as JPEG holds at most 65533 bytes of EXIF data")
    packet = metadata.extras.xmp
    if packet is not None and len(packet) > jpeg.LONGEST_XMP:
        left_out.append(f"XMP of {len(packet)} bytes, as JPEG holds at most {jpeg.LONGEST_XMP}")
    return metadata, left_out


def check_output(path: str | Path, photograph: Photograph) -> str:
    """Raise ValueError unless ``photograph`` can be written to ``path``; return the file type.

    Call it before long work, so that the error comes early.
    """
    return check_type(path, photograph.depth, photograph.alpha is not None, photograph.size, photograph.metadata)


def check_type(
    path: str | Path, depth: str, alpha: bool, size: tuple[int, int] = (1, 1), metadata: Metadata | None = None
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
    if math.prod(size) > MOST_PIXELS.get(kind, math.prod(size)):
        raise ValueError(
            f"{path} cannot hold this picture: {kind} is decoded up to {MOST_PIXELS[kind]} pixels, got "
            f"{size[1]}x{size[0]}; write a PNG or TIFF file"
        )
    if kind == "JPEG" and metadata is not None:
        _check_jpeg_metadata(path, metadata)
    return kind


def _check_jpeg_metadata(path: Path, metadata: Metadata) -> None:
    """Raise ValueError if a JPEG file cannot hold the EXIF block, without the maker note, or the profile."""
    pieces = {"EXIF data": (metadata.exif, LONGEST_EXIF), "colour profile": (metadata.icc, jpeg.LONGEST_ICC)}
    for name, (content, longest) in pieces.items():
        if content is None or len(content) <= longest:
            continue
        if name == "EXIF data" and shortened(content, longest) is not None:
            continue
        raise ValueError(
            f"{path} cannot hold this picture: JPEG has at most {longest} bytes of {name}, got {len(content)}; "
            "write a PNG, TIFF or WebP file"
        )


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
