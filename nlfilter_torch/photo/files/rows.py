"""Picture files read and written a few rows at a time: TIFF, BigTIFF, zarr, PNG and JPEG.

Large PNG and JPEG files are decoded into a temporary file. WebP and AVIF files, progressive JPEG files and interlaced
PNG files are decoded whole.

Needs the ``cli`` extra, and the ``zarr`` extra for zarr. A file appears complete or not at all.
"""

import math
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from nlfilter_torch.photo.declared.rows import NodataRows, RowSource, Stored
from nlfilter_torch.photo.files import tiff
from nlfilter_torch.photo.files.codecs import is_raw
from nlfilter_torch.photo.files.exif import of_part, upright
from nlfilter_torch.photo.files.formats import (
    TooLarge,
    check_type,
    first_bytes,
    open_mapped,
    read_channels,
    write_file,
)
from nlfilter_torch.photo.files.metadata import NO_METADATA, Header, Metadata, bands, check_profile, decoding
from nlfilter_torch.photo.files.tiff import TiffRows
from nlfilter_torch.photo.files.writing import (
    FileRows,
    check_file,
    claimed,
    copy_modes,
    link_target,
    name_beside,
    part_beside,
    temporary_rows,
)

if TYPE_CHECKING:
    from zarr import Array

ZARR = ".zarr"
ZARR_FILES = ("zarr.json", ".zarray")  # that describe an array
# Bytes that a command may use if no limit is given.
FIFTH = psutil.virtual_memory().total // 5
WHOLE_MEMORY = min(FIFTH, 2_000_000_000)  # a photograph that needs more is edited in tiles
TILED_MEMORY = 1_000_000_000  # for tiles, and to decode a photograph without a temporary file; more is no faster
COPIED = 64  # rows that are turned at a time, at least
CODEC_MEMORY_FACTOR = 8  # memory to decode or encode other formats, as a multiple of the picture's size in bytes


@dataclass(frozen=True)
class StoredPicture:
    """A picture in a file, read on demand.

    Attributes:
        rows: upright rows, (H, W, S) or (H, W).
        alpha: whether the last channel is transparency.
        cached: bytes kept in memory while the picture is read.
        metadata: profile, EXIF and the rest.
        attributes: attributes of a zarr array.
    """

    rows: RowSource
    alpha: bool
    cached: int
    metadata: Metadata = NO_METADATA
    attributes: Mapping[str, object] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, S)."""
        height, width, *samples = self.rows.shape
        return height, width, samples[0] if samples else 1

    @property
    def nodata(self) -> float | None:
        """The value of pixels without data, if there is one and no transparency."""
        return None if self.alpha else self.metadata.extras.nodata

    @property
    def marked(self) -> RowSource:
        """The rows, with one more channel if pixels have no data; see :class:`NodataRows`."""
        return self.rows if self.nodata is None else NodataRows(self.rows, self.nodata)

    def in_colour(self) -> "StoredPicture":
        """Return shape and metadata of the colour version, without pixels; the profile of a grey picture is dropped."""
        height, width, samples = self.shape
        if samples > 2:
            return self
        rows = self._empty((height, width, 3 + self.alpha))
        return replace(self, rows=rows, metadata=replace(self.metadata, icc=None))

    def with_transparency(self) -> "StoredPicture":
        """Return shape and metadata of the same picture with transparency, without pixels."""
        if self.alpha:
            return self
        height, width, samples = self.shape
        return replace(self, rows=self._empty((height, width, samples + 1)), alpha=True)

    def of_part(self, size: tuple[int, int]) -> "StoredPicture":
        """Return shape and metadata of a part (H, W), without pixels."""
        if size == self.shape[:2]:
            return self
        rows = self._empty((*size, *self.rows.shape[2:]))
        return replace(self, rows=rows, metadata=replace(self.metadata, exif=of_part(self.metadata.exif, size[::-1])))

    def _empty(self, shape: tuple[int, ...]) -> Stored:
        """Rows of a shape and the same dtype, which take no memory."""
        return np.broadcast_to(np.zeros((), self.rows.dtype), shape)


def is_zarr(path: Path) -> bool:
    """Whether ``path`` is the folder of a zarr array or ends in ``.zarr``."""
    return path.suffix.lower() == ZARR or _holds_zarr(path)


def _holds_zarr(path: Path) -> bool:
    return any((path / name).is_file() for name in ZARR_FILES)


@contextmanager
def open_picture(path: Path, memory: int) -> Iterator[StoredPicture]:
    """Open a picture, whose rows can be read within the block.

    Raises:
        FileNotFoundError, ValueError: if the file does not exist or cannot be read.
        MemoryError: if reading it needs more than ``memory`` bytes.
    """
    with ExitStack() as stack:
        if is_zarr(path):
            stored = _open_zarr(path)
        elif tiff.is_tiff(first_bytes(path)) and not is_raw(path):
            try:
                stored = _open_tiff(path, stack)
            except tiff.RawPicture:
                stored = _open_codec(path, memory, stack)
        else:
            stored = _open_codec(path, memory, stack)
        if stored.cached > memory:
            raise MemoryError(
                f"{path} can only be read in pieces of {stored.cached / 1e6:.0f} MB, but only {memory / 1e6:.0f} MB "
                "may be used; save it in smaller tiles, or allow more memory"
            )
        yield stored


def check_place(path: Path, depth: str, picture: StoredPicture, memory: int) -> None:
    """Raise unless the picture can be written to ``path`` at that depth, using at most ``memory`` bytes."""
    if path.suffix.lower() == ZARR:
        zarr_package()
        if not path.is_dir():
            check_file(path)
            if path.exists():
                raise ValueError(f"{path} is a file, not a zarr array that can be replaced; choose another name")
        elif not _holds_zarr(path):
            raise ValueError(f"{path} is a folder, not a zarr array that can be replaced; choose another name")
        return
    kind = check_type(path, depth, picture.alpha, picture.shape[:2], picture.metadata)
    needed = (
        0
        if kind in ("TIFF", "PNG", "JPEG")
        else math.prod(picture.shape) * np.dtype(depth).itemsize * CODEC_MEMORY_FACTOR
    )
    if needed > memory:
        raise MemoryError(
            f"{path} needs {needed / 1e6:.0f} MB of memory to be encoded, but only {memory / 1e6:.0f} MB may be used; "
            "write a TIFF file, or allow more"
        )


def write_picture(
    path: Path,
    rows: Iterable[tuple[slice, Stored]],
    depth: str,
    like: StoredPicture,
    quality: int | None = None,
    fill: Callable[[Path], None] | None = None,
) -> None:
    """Write rows as they are computed, with the shape, profile and metadata of another picture.

    Args:
        path: file, or folder of a zarr array.
        rows: (h, W, S), in order, with their position.
        depth: dtype to write.
        like: the other picture.
        quality: of a file of a type that has one; None is the default.
        fill: writes the rows to the zarr array in a folder, in place of this process; None is this process.
    """
    shape, dtype = like.shape, np.dtype(depth)
    if path.suffix.lower() == ZARR:
        _write_zarr(path, rows, dtype, like, fill)
        return
    check_type(path, depth, like.alpha)
    write_file(path, (part for _, part in rows), Header(shape, dtype, like.alpha, like.metadata), quality)


def free_memory() -> int:
    """Default memory budget in bytes: four fifths of the free memory."""
    return int(psutil.virtual_memory().available * 4 // 5)


def usual_memory(most: int = sys.maxsize) -> int:
    """Memory budget in bytes of a command if none is given: a fifth of the machine's memory, at most what is free."""
    return min(FIFTH, most, free_memory())


def _open_tiff(path: Path, stack: ExitStack) -> StoredPicture:
    with decoding(path):
        rows = stack.enter_context(TiffRows(path))
    check_profile(path, rows.metadata.icc)
    rows.warn_of_pages()
    source: RowSource = rows
    if rows.turned:
        source = upright_copy(rows, rows.orientation, max(rows.segment[0], COPIED), stack)
    return StoredPicture(source, rows.alpha, rows.cached, rows.metadata)


def _open_codec(path: Path, memory: int, stack: ExitStack) -> StoredPicture:
    """Open a file that is decoded whole; large PNG and JPEG files into a temporary file."""
    try:
        decoded = read_channels(path, bytes_per_pixel=CODEC_MEMORY_FACTOR, memory=min(memory, TILED_MEMORY))
    except TooLarge:
        if (unpacked := _unpacked(path, stack)) is not None:
            return unpacked
        decoded = read_channels(path, bytes_per_pixel=CODEC_MEMORY_FACTOR, memory=memory)
    channels = decoded.channels
    return StoredPicture(channels, channels.shape[2] in (2, 4), channels.nbytes, decoded.metadata)


def _unpacked(path: Path, stack: ExitStack) -> StoredPicture | None:
    """Decode a PNG file without interlacing, or a baseline JPEG file, into a temporary file; None for others."""
    with path.open("rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as data, decoding(path):
        picture = open_mapped(path, data)
        if picture is None or picture.in_passes:
            return None
        check_profile(path, picture.metadata.icc)
        scratch = temporary_rows((picture.size[1], picture.size[0], picture.samples), picture.dtype, stack)
        with scratch.array() as out:
            picture.decode_into(data, out)
    if picture.orientation > 1:
        scratch = upright_copy(scratch, picture.orientation, COPIED, stack)
    return StoredPicture(scratch, picture.samples in (2, 4), 0, picture.metadata)


def upright_copy(rows: TiffRows | FileRows, orientation: int, step: int, stack: ExitStack) -> FileRows:
    """The upright picture of rows with an EXIF orientation, of which ``step`` are read at a time."""
    height, width, samples = rows.shape
    turned = orientation >= 5
    scratch = temporary_rows((width, height, samples) if turned else rows.shape, rows.dtype, stack)
    with scratch.array() as copy:
        for start in range(0, height, step):
            stop = min(start + step, height)
            # These orientations begin with the last row or column.
            place = slice(height - stop, height - start) if orientation in (3, 4, 6, 7) else slice(start, stop)
            copy[(slice(None), place) if turned else place] = upright(rows[slice(start, stop)], orientation)
    return scratch


def zarr_package() -> ModuleType:
    """The package zarr; raises ValueError if it is not installed."""
    try:
        import zarr
    except ImportError as error:
        raise ValueError(
            "zarr arrays need the package zarr, which is not installed; install nlfilter-torch[zarr]"
        ) from error
    return zarr


class ZarrRows:
    """A zarr array that detects a change of its shape; another process opens it again."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.array = self._open()
        self.shape: tuple[int, ...] = tuple(self.array.shape)
        self.dtype = self.array.dtype

    def __reduce__(self) -> tuple[type["ZarrRows"], tuple[Path]]:
        return ZarrRows, (self.path.absolute(),)

    def _open(self) -> "Array[Any]":
        try:
            return zarr_package().open_array(self.path, mode="r")
        except (FileNotFoundError, KeyError, TypeError) as error:
            raise ValueError(f"{self.path} is not a zarr array ({error}); choose the folder of one") from error

    def __getitem__(self, rows: slice) -> Stored:
        now = tuple(self._open().shape)
        if now != self.shape:
            raise ValueError(
                f"{self.path} changed its shape while it was read, from {self.shape} to {now}; make sure that nothing "
                "writes to it, and start again"
            )
        return np.asarray(self.array[rows])


def _open_zarr(path: Path) -> StoredPicture:
    rows = ZarrRows(path)
    if len(rows.shape) not in (2, 3):
        raise ValueError(
            f"{path} must have the shape (H, W) or (H, W, S), got {rows.shape}; choose the array of a picture"
        )
    alpha = len(rows.shape) == 3 and rows.shape[2] in (2, 4)
    chunk = (*rows.array.chunks[:1], *rows.shape[1:])
    cached = 2 * math.prod(chunk) * rows.dtype.itemsize
    return StoredPicture(rows, alpha, cached, attributes=dict(rows.array.attrs))


def write_band(array: "Array[Any]", start: int, rows: Stored) -> None:
    """Write rows (h, W, S) to a zarr array from row ``start`` on, where a chunk begins."""
    values, width = rows.reshape(len(rows), *array.shape[1:]), array.chunks[1]
    # One chunk per call: zarr writes several in parallel and continues with the others after one fails.
    for left in range(0, array.shape[1], width):
        array[start : start + len(values), left : left + width] = values[:, left : left + width]


def _write_zarr(
    path: Path,
    rows: Iterable[tuple[slice, Stored]],
    dtype: np.dtype[np.generic],
    like: StoredPicture,
    fill: Callable[[Path], None] | None,
) -> None:
    """Write an array under another name, which replaces an existing array only when it is complete."""
    shape = tuple(like.rows.shape)
    path = link_target(path)
    replaced = name_beside(path)
    chunks = (min(tiff.TILE_SIZE, shape[0]), min(tiff.TILE_SIZE, shape[1]), *shape[2:])
    with part_beside(path) as beside:
        array = zarr_package().create_array(
            store=beside, shape=shape, chunks=chunks, dtype=dtype, attributes=like.attributes or {}
        )
        with claimed(beside):
            if path.exists():
                shutil.copymode(path, beside)  # none who may not read the former array may read this one
            if fill is not None:
                fill(beside)
            else:
                start = 0
                for band in bands((part for _, part in rows), tiff.TILE_SIZE):
                    write_band(array, start, band)
                    start += len(band)
            if path.exists():
                copy_modes(path, beside, next(path / name for name in ZARR_FILES if (path / name).is_file()))
                path.replace(replaced)
            try:
                beside.replace(path)
            except OSError:
                replaced.replace(path)
                raise
            finally:
                shutil.rmtree(replaced, ignore_errors=True)
