"""Image files in memory: PNG, JPEG, TIFF, WebP and AVIF at their own depth, with alpha, EXIF and colour profile.

Needs the ``cli`` extra (Pillow, tifffile, imagecodecs, psutil).
"""

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
from numpy.typing import NDArray

from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files import codecs, jpeg, png, tiff
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files.exif_in_tiff import shortened
from nlfilter_torch.photo.files.metadata import (
    NO_METADATA,
    CheckSize,
    Decoded,
    Header,
    Metadata,
    UnhandledImage,
    check_profile,
    decoding,
    note_left_out,
)
from nlfilter_torch.photo.files.writing import check_file, open_beside

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
LONGEST_SIDE = {"WebP": 16383, "JPEG": 65500, "PNG": png.LONGEST_PNG, "AVIF": codecs.LONGEST_AVIF}
MOST_PIXELS = {"AVIF": codecs.MOST_AVIF}
SUFFIXES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WebP", ".avif": "AVIF"}
SUFFIXES |= {".tif": "TIFF", ".tiff": "TIFF"}
LOSSY = "JPEG", "WebP", "AVIF"  # types of file with a quality, 1 to 100
PFM = ".pfm"  # of masks
#: Of a PFM file: colour or grey, width, height, and the scale, negative for little-endian values.
PFM_HEADER = re.compile(rb"P([Ff])\s+(\d+)\s+(\d+)\s+(-?[\d.]+(?:[eE][-+]?\d+)?)\s")

ADDRESSES = "http:", "https:", "ftp:"  # how they begin


def type_of(path: str | Path) -> str | None:
    """The type of file that the suffix of a path says; None for others than those of :data:`SUFFIXES`."""
    return SUFFIXES.get(Path(path).suffix.lower())


class TooLarge(MemoryError):
    """A picture that needs more memory to be edited whole than is available."""


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
    if path.parts and path.parts[0] in ADDRESSES:
        raise ValueError(f"{path.parts[0]}//{'/'.join(path.parts[1:])} is an address, not a file; download it first")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; check the name and the folder")
    if path.is_dir():
        raise ValueError(f"{path} is a folder, not an image file; name a file in it")
    if not path.is_file():  # opening a pipe would block
        raise ValueError(f"{path} is a pipe, a socket or a device, not a file; save the picture in a file first")
    try:
        with path.open("rb") as stream:
            head = stream.read(64)
    except PermissionError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}; check its permissions, or copy it") from error
    if not head:
        raise ValueError(f"{path} is empty; copy it again from its source")
    return head


def count_pages(path: Path) -> int:
    """Number of pictures in a file: of a TIFF file without masks and reduced versions, else 1."""
    return tiff.count_pages(path) if tiff.is_tiff(first_bytes(path)) and not codecs.is_raw(path) else 1


def read_channels(path: Path, *, bytes_per_pixel: int, memory: int | None, page: int | None = None) -> Decoded:
    """Read upright channels (H, W, S) in the stored dtype, and metadata; see :func:`read_photograph`."""
    head = first_bytes(path)
    check_size = partial(_check_size, path, bytes_per_pixel, memory)
    if codecs.is_raw(path):
        decoded = codecs.read_raw(path, check_size)
    elif codecs.is_heic(head):
        decoded = codecs.read_heic(path, check_size)
    elif tiff.is_tiff(head):
        try:
            decoded = tiff.read(path, check_size, page)
        except tiff.RawPicture:
            decoded = codecs.read_raw(path, check_size)
    else:
        with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data, decoding(path):
            decoded = _read_mapped(path, data, check_size)
    check_profile(path, decoded.metadata.icc)
    return decoded._replace(channels=exif_tags.upright(decoded.channels, decoded.orientation), orientation=1)


def _read_mapped(path: Path, data: mmap, check_size: CheckSize) -> Decoded:
    """Read a PNG, JPEG, WebP or AVIF file that is mapped into memory."""
    if (picture := open_mapped(path, data)) is not None:
        check_size(picture.size)
        channels = picture.decode(data) if isinstance(picture, png.Png) else picture.decode()
        return Decoded(channels, picture.orientation, picture.metadata)
    head = data[:32]
    if codecs.is_webp(head):
        return codecs.read_webp(path, data, check_size)
    if codecs.is_avif(head):
        return codecs.read_avif(path, data, check_size)
    if (header := PFM_HEADER.match(head)) is not None:
        return _read_pfm(data, header, check_size)
    raise UnhandledImage(f"{path} is not a PNG, JPEG, TIFF, WebP or AVIF image; convert it to one of these")


def open_mapped(path: Path, data: mmap) -> png.Png | jpeg.Jpeg | None:
    """Read everything but the pixels of a PNG or JPEG file that is mapped into memory; None for other files."""
    if data[: len(png.SIGNATURE)] == png.SIGNATURE:
        return png.open_png(path, data)
    return jpeg.open_jpeg(path, data) if data[:3] == jpeg.START else None


def _check_size(
    path: Path, bytes_per_pixel: int, memory: int | None, size: tuple[int, int], *, double: bool = False
) -> None:
    """Check the memory that a picture of (width, height) needs; twice as much for 64-bit pixels."""
    check_memory(path, *size, bytes_per_pixel * (1 + double), memory)


def write_pages(path: Path, pages: Iterable[tuple[Stored, Header]], count: int) -> None:
    """Write ``count`` pages (H, W, S) of about the same size, as they arrive, to a TIFF file, as :func:`write_file`."""
    left_out = list[str]()
    with open_beside(path) as stream:
        for number, (picture, header) in enumerate(pages):
            extras = header.metadata.extras
            left_out += [*extras.left_out, *(part.name for part in extras.parts if part.kind != "TIFF")]
            left_out += tiff.write(stream, picture, header, number, count)
    note_left_out(path, left_out)


def write_file(path: Path, picture: Stored | Iterable[Stored], header: Header, quality: int | None = None) -> None:
    """Write a picture (H, W, S), or its rows as they are computed, to a file of a type in :data:`SUFFIXES`.

    The file appears complete or not at all. ``quality`` is that of a type in :data:`LOSSY`; None is the default. A
    thumbnail shows the picture, or is left out where rows are written, and in TIFF. Warns of metadata that are left
    out.
    """
    kind = SUFFIXES[path.suffix.lower()]
    metadata, extras, left_out = header.metadata, header.metadata.extras, list[str]()
    if (block := metadata.exif) is not None and exif_tags.has_thumbnail(block):
        block = exif_tags.refreshed(block, picture if isinstance(picture, np.ndarray) and kind != "TIFF" else None)
        metadata = replace(metadata, exif=block)
        left_out += [] if exif_tags.has_thumbnail(block) else ["the thumbnail"]
    left_out += [*extras.left_out, *(part.name for part in extras.parts if part.kind != kind)]
    left_out += [] if kind == "TIFF" else extras.lacking_tags()
    if kind == "JPEG":
        metadata, lacking = fitting_jpeg(metadata)
        left_out += lacking
    header = replace(header, metadata=metadata)
    rows = [picture] if isinstance(picture, np.ndarray) else picture
    with open_beside(path) as stream:
        if kind == "TIFF":
            left_out += tiff.write(stream, picture, header)
        elif kind == "PNG":
            png.write_png(stream, rows, header)
        elif kind == "JPEG":
            jpeg.write_jpeg(stream, rows, header, quality or jpeg.USUAL_QUALITY)
        else:
            if extras.dpi is not None and exif_tags.resolution(metadata.exif) is None:
                left_out.append("the print resolution")
            whole = np.concatenate(list(rows))
            codecs.write_by_pillow(stream, kind, whole[..., 0] if header.shape[2] == 1 else whole, metadata, quality)
    note_left_out(path, left_out)


def fitting_jpeg(metadata: Metadata) -> tuple[Metadata, list[str]]:
    """Metadata that a JPEG file can hold, and what it cannot."""
    left_out = []
    if metadata.exif is not None and len(metadata.exif) > jpeg.LONGEST:
        metadata = replace(metadata, exif=shortened(metadata.exif, jpeg.LONGEST))
        left_out.append("the maker note, as JPEG holds at most 65533 bytes of EXIF data")
    packet = metadata.extras.xmp
    if packet is not None and len(packet) > jpeg.LONGEST_XMP:
        left_out.append(f"XMP of {len(packet)} bytes, as JPEG holds at most {jpeg.LONGEST_XMP}")
    if (dpi := metadata.extras.dpi) is not None:
        stored = jpeg.stored_dpi(jpeg.jfif(dpi)) or dpi
        if max(abs(a - b) for a, b in zip(dpi, stored, strict=True)) > png.INCH / 2:  # which other types round, too
            (x, y), (across, down) = dpi, stored
            left_out.append(
                f"the print resolution of {x:.7g} x {y:.7g} dpi, of which JPEG holds {across:.7g} x {down:.7g}"
            )
    return metadata, left_out


def check_type(
    path: str | Path, depth: str, alpha: bool, size: tuple[int, int] = (1, 1), metadata: Metadata | None = None
) -> str:
    """Check, as :func:`check_output`, a picture of that depth and size (H, W), with or without alpha."""
    path = Path(path)
    check_file(path)
    kind = type_of(path)
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
    pieces = {"EXIF data": (metadata.exif, jpeg.LONGEST), "colour profile": (metadata.icc, jpeg.LONGEST_ICC)}
    for name, (content, longest) in pieces.items():
        if content is None or len(content) <= longest:
            continue
        if name == "EXIF data" and shortened(content, longest) is not None:
            continue
        raise ValueError(
            f"{path} cannot hold this picture: JPEG has at most {longest} bytes of {name}, got {len(content)}; "
            "write a PNG, TIFF or WebP file"
        )


def write_pfm(path: Path, plane: NDArray[np.float32]) -> None:
    """Write a plane (H, W) of floats as a PFM file, bottom row first as the format requires.

    It is read as a raster mask by darktable and ART. The file appears complete or not at all.
    """
    height, width = plane.shape
    with open_beside(path) as stream:
        stream.write(f"Pf\n{width} {height}\n-1.0\n".encode())  # negative: little-endian
        stream.write(np.ascontiguousarray(plane[::-1], "<f4").tobytes())


def _read_pfm(data: mmap, header: re.Match[bytes], check_size: CheckSize) -> Decoded:
    """Read a PFM file that is mapped into memory, whose header is given; its values are taken as they are."""
    kind, width, height, scale = header.groups()
    size, samples = (int(width), int(height)), 3 if kind == b"F" else 1
    check_size(size)
    values = np.frombuffer(data, "<f4" if scale.startswith(b"-") else ">f4", math.prod(size) * samples, header.end())
    return Decoded(values.reshape(size[1], size[0], samples)[::-1].astype(np.float32), 1, NO_METADATA)


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
