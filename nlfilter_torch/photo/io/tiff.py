"""Reading and writing of TIFF files with profile and EXIF, by tifffile; whole, or a few rows at a time."""

import logging
import os
import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import BinaryIO, TypedDict, Unpack

import numpy as np
import tifffile
from PIL import ExifTags, Image, TiffImagePlugin

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.io import exif as exif_tags
from nlfilter_torch.photo.io.decoded import Channels, CheckSize, Decoded

# Tags that describe the photograph. The others describe how the file stores it and are not copied.
_DESCRIPTIVE = (270, 271, 272, 305, 306, 315, 33432, *exif_tags.FOLDERS)
_ORIENTATION = int(ExifTags.Base.Orientation)
# tifffile logs problems with a file. Without a handler Python would print them beside our error message.
logging.getLogger("tifffile").addHandler(logging.NullHandler())
XMP = 700  # tag
TILE_SIZE = 256  # side of the tiles that are written
MAX_CLASSIC_BYTES = 4_000_000_000  # bytes of pixels above which a BigTIFF is written
_ASSOCIATED = tifffile.EXTRASAMPLE.ASSOCALPHA
MOST_PAGES = 100  # that are counted
CACHED_BANDS = 2  # cached bands of strips or tiles: rows shared by two tiles of a picture span at most two


class Resolution(TypedDict, total=False):
    """Options of :func:`tifffile.imwrite` for the print resolution."""

    resolution: tuple[float, float]
    resolutionunit: int


class _Options(Resolution, total=False):
    """Further options of :func:`tifffile.imwrite`."""

    tile: tuple[int, int]
    bigtiff: bool
    maxworkers: int
    buffersize: int


class UnhandledImage(ValueError):
    """A valid image file of an unsupported kind."""


@contextmanager
def decoding(path: Path) -> Iterator[None]:
    """Report any error in the block as a damaged file, since decoders have no common base class for errors."""
    try:
        yield
    except (MemoryError, UnhandledImage):
        raise
    except Exception as error:
        reason = error or type(error).__name__
        raise ValueError(f"{path} is damaged or cut short ({reason}); copy it again from its source") from error


def is_tiff(head: bytes) -> bool:
    """Whether a file with these first bytes is a TIFF or BigTIFF."""
    return head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def read(path: Path, check_size: CheckSize) -> Decoded:
    """Read the first page; the EXIF block is not read from a BigTIFF."""
    with decoding(path), TiffRows(path) as rows:
        check_size((rows.shape[1], rows.shape[0]), double=rows.dtype == np.float64)
        ends = (at + count for at, count in zip(rows.page.dataoffsets, rows.page.databytecounts, strict=True) if count)
        if max(ends, default=0) > path.stat().st_size:  # decoders of JPEG fill what is missing
            raise EOFError("it ends too early")
        channels = np.asarray(rows.page.asarray())
        if rows.page.axes == "SYX":
            channels = np.moveaxis(channels, 0, -1)
        warn_of_pages(path)
        return Decoded(plain(rows.page, channels.reshape(rows.shape)), rows.orientation, rows.icc, rows.exif)


def count_pages(path: Path) -> int:
    """Number of pictures in a TIFF file, at most :data:`MOST_PAGES`, not counting masks and reduced versions."""
    count = 1
    with path.open("rb") as stream, tifffile.TiffFile(stream, name=str(path)) as file:
        try:
            for number in range(1, MOST_PAGES):
                page = file.pages[number]
                count += not (isinstance(page, tifffile.TiffPage) and (page.is_reduced or page.is_mask))
        except Exception:  # no such page, or damage behind the first one, which alone is needed
            return count
    return count


def warn_of_pages(path: Path) -> None:
    """Warn if a file has several pages, of which only the first is read."""
    if (count := count_pages(path)) > 1:
        least = "at least " if count == MOST_PAGES else ""
        warn(f"{path} has {least}{count} pages, of which only the first is read; save the others as files of their own")


def check_page(path: Path, page: tifffile.TiffPage) -> None:
    """Raise UnhandledImage unless a page is a picture in grey or RGB, with or without alpha."""
    kinds = tifffile.PHOTOMETRIC
    by_jpeg = page.compression in (tifffile.COMPRESSION.JPEG, tifffile.COMPRESSION.OJPEG)
    handled = {kinds.MINISWHITE, kinds.MINISBLACK, kinds.RGB} | ({kinds.YCBCR} if by_jpeg else set())
    if page.photometric not in handled:
        name = getattr(page.photometric, "name", page.photometric)
        raise UnhandledImage(f"{path} is stored in {name} colours, which are not supported; convert it to grey or RGB")
    bits = page.bitspersample if isinstance(page.bitspersample, int) else max(page.bitspersample)
    if page.dtype is None or bits != 8 * page.dtype.itemsize:
        raise UnhandledImage(
            f"{path} has {bits} bits per channel, which is not supported; convert it to 8 or 16 bits or floats"
        )
    if page.axes not in ("YX", "YXS", "SYX"):
        raise UnhandledImage(f"{path} has the axes {page.axes}, which are not those of a picture; save a plain picture")
    if page.samplesperpixel - len(page.extrasamples) not in (1, 3) or len(page.extrasamples) > 1:
        raise UnhandledImage(
            f"{path} has {page.samplesperpixel} channels; convert it to grey or RGB, with or without alpha"
        )


def _native(page: tifffile.TiffPage) -> np.dtype[np.generic]:
    """The dtype of the pixels of a checked page, in native byte order."""
    return np.dtype(page.dtype).newbyteorder("=")


def plain(page: tifffile.TiffPage, channels: Channels) -> Channels:
    """Convert channels (H, W, S) of a page, or some of its rows, to black as 0 and no premultiplied alpha."""
    channels = channels.astype(_native(page), copy=True)
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        white = np.iinfo(channels.dtype.name).max if channels.dtype.kind == "u" else 1
        channels[..., :1] = white - channels[..., :1]
    return _unmultiplied(channels) if _ASSOCIATED in page.extrasamples else channels


def metadata(file: tifffile.TiffFile, path: Path) -> tuple[int, bytes | None, bytes | None]:
    """Read orientation, profile and EXIF (not from a BigTIFF) of the first page of a file."""
    tags = file.pages.first.tags
    orientation, profile = tags.get(_ORIENTATION), tags.get(34675)
    return (
        1 if orientation is None else exif_tags.orientation_of(orientation.value),
        profile.value if profile is not None and isinstance(profile.value, bytes) else None,
        None if file.is_bigtiff else _read_exif(path),
    )


def write_rows(
    stream: BinaryIO,
    rows: Iterable[Channels],
    shape: tuple[int, int, int],
    dtype: np.dtype[np.generic],
    alpha: bool,
    icc: bytes | None,
    exif: bytes | None,
    xmp: bytes | None = None,
    **resolution: Unpack[Resolution],
) -> None:
    """Write rows (h, W, S) of a picture of ``shape`` as they arrive, in tiles; large files become BigTIFF."""
    height, width, samples = shape
    plain_shape = (height, width) if samples == 1 else shape
    big = height * width * samples * dtype.itemsize > MAX_CLASSIC_BYTES
    # Compressing ahead in threads would queue hundreds of megabytes.
    size = TILE_SIZE * TILE_SIZE * samples * dtype.itemsize
    options = _Options(maxworkers=1, buffersize=size, tile=(TILE_SIZE, TILE_SIZE), bigtiff=big, **resolution)
    write(stream, _tiles(rows, width), plain_shape, dtype, alpha, icc, None if big else exif, xmp, **options)


def _tiles(rows: Iterable[Channels], width: int) -> Iterator[Channels]:
    """Cut rows (h, W, S) into square tiles, padded with zeros, without the last axis if S = 1."""
    for band in bands(rows, TILE_SIZE):
        for left in range(0, width, TILE_SIZE):
            tile = band[:, left : left + TILE_SIZE]
            padded = np.pad(tile, ((0, TILE_SIZE - tile.shape[0]), (0, TILE_SIZE - tile.shape[1]), (0, 0)))
            yield padded[..., 0] if padded.shape[2] == 1 else padded


def bands(rows: Iterable[Channels], height: int) -> Iterator[Channels]:
    """Regroup rows (h, W, S) into pieces of the same ``height``, the last one possibly shorter.

    >>> [len(band) for band in bands([np.zeros((3, 1, 1)), np.zeros((4, 1, 1))], 2)]
    [2, 2, 2, 1]
    """
    waiting: list[Channels] = []
    for piece in rows:
        waiting.append(piece)
        while sum(map(len, waiting)) >= height:
            whole = np.concatenate(waiting)
            waiting = [whole[height:]]
            yield whole[:height]
    if waiting and sum(map(len, waiting)):
        yield np.concatenate(waiting)


def write(
    stream: BinaryIO,
    data: Channels | Iterator[Channels],
    shape: tuple[int, ...],
    dtype: np.dtype[np.generic],
    alpha: bool,
    icc: bytes | None,
    exif: bytes | None,
    xmp: bytes | None = None,
    **options: Unpack[_Options],
) -> None:
    """Write a picture of ``shape`` (H, W) or (H, W, S), or an iterator over its tiles, compressed without loss.

    ``alpha`` says whether the last channel is transparency; ``options`` are those of :func:`tifffile.imwrite`.
    """
    tags = Image.Exif()
    if exif is not None:
        tags.load(exif)
    folders = exif_tags.tables(tags)
    # tifffile does not write nested tables, so a placeholder tag with the next lower number reserves space for each.
    places = [(code - 1, "I", 1, 0, True) for code in folders]
    start = stream.tell()
    tifffile.imwrite(
        stream,
        data,
        shape=shape,
        dtype=dtype,
        photometric="rgb" if len(shape) == 3 and shape[2] >= 3 else "minisblack",
        planarconfig="contig" if len(shape) == 3 else None,
        extrasamples=["unassalpha"] if alpha else None,
        compression="zlib",
        predictor=bool(np.issubdtype(dtype, np.integer)),
        iccprofile=icc,
        extratags=[(_ORIENTATION, "H", 1, 1, True), *_texts(tags, xmp), *places],
        metadata=None,
        software=False,
        **options,
    )
    stream.seek(start)
    with tifffile.TiffFile(stream) as file:
        order = file.byteorder
        positions = {code: file.pages.first.tags[code - 1].offset for code in folders}
    for code, folder in folders.items():
        _write_folder(stream, order, positions[code], code, folder)


def _texts(tags: Image.Exif, xmp: bytes | None) -> Iterator[tuple[int, str, int, bytes, bool]]:
    """The descriptive tags and XMP, as tifffile takes them."""
    for code in _DESCRIPTIVE:
        if code in tags and code not in exif_tags.FOLDERS:
            yield code, "s", 0, str(tags[code]).encode("latin-1", "replace"), True  # latin-1, as decoded by Pillow
    if xmp is not None:
        yield XMP, "B", len(xmp), xmp, True


def _write_folder(stream: BinaryIO, order: str, position: int, code: int, folder: Mapping[int, object]) -> None:
    """Append a table of tags and make the tag at ``position`` point at it."""
    table = TiffImagePlugin.ImageFileDirectory_v2(ifh=(b"II*\0" if order == "<" else b"MM\0*") + bytes(4))
    for key, value in folder.items():
        if exif_tags.is_writable(key, value):
            table[key] = exif_tags.writable(value)
    end = stream.seek(0, 2)
    stream.write(bytes(end % 2))  # tables begin on even offsets
    offset = end + end % 2
    stream.write(table.tobytes(offset))
    stream.seek(position)
    stream.write(struct.pack(f"{order}HHLL", code, 4, 1, offset))  # type 4: 32-bit integer; count 1


def _read_exif(path: Path) -> bytes | None:
    with path.open("rb") as stream:
        return exif_tags.split(partial(_descriptive_fields, stream))[1]


def _descriptive_fields(stream: BinaryIO) -> Image.Exif:
    """Parse the tags of a TIFF file that describe the photograph, and its orientation."""
    exif = Image.Exif()
    exif.load_from_fp(stream)
    for code in list(exif):
        if code not in _DESCRIPTIVE and code != _ORIENTATION:
            del exif[code]
    return exif


def _unmultiplied(channels: Channels) -> Channels:
    """Divide premultiplied colours by their alpha; black where alpha is 0."""
    colour, alpha = channels[..., :-1].astype(np.float64), channels[..., -1:].astype(np.float64)
    integer = np.issubdtype(channels.dtype, np.integer)
    limit = np.iinfo(channels.dtype.name).max if integer else 1.0
    plain = np.divide(colour * limit, alpha, out=np.zeros_like(colour), where=alpha > 0)
    plain = np.rint(plain.clip(0, limit)) if integer else plain
    return np.concatenate([plain.astype(channels.dtype), channels[..., -1:]], axis=-1)


class TiffRows:
    """The first page of a TIFF file, upright, as rows (H, W, S).

    Attributes:
        shape: (H, W, S).
        dtype: dtype in native byte order.
        icc: the colour profile, or None.
        exif: the EXIF block, or None.
        alpha: whether the last channel is transparency.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and read the header; raises UnhandledImage if the picture is of an unsupported kind."""
        self.path = path
        self.stream: BinaryIO = path.open("rb")
        try:
            self.file = tifffile.TiffFile(self.stream, name=str(path))
            page = self.file.pages.first
            check_page(path, page)
            self.orientation, self.icc, self.exif = metadata(self.file, path)
        except BaseException:
            self.stream.close()
            raise
        self.page = page
        self.stamp = self._look()
        self.shape = (page.imagelength, page.imagewidth, page.samplesperpixel)
        self.dtype = _native(page)
        self.alpha = bool(page.extrasamples)
        # (height, width) of a strip or tile; the declared height of a strip may exceed the picture's.
        self.segment = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
        self.segment = (min(self.segment[0], self.shape[0]), self.segment[1])
        self.bands: dict[int, Channels] = {}

    def __reduce__(self) -> tuple[type["TiffRows"], tuple[Path]]:
        return TiffRows, (self.path.absolute(),)  # another process opens the file again

    def __enter__(self) -> "TiffRows":
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()

    @property
    def turned(self) -> bool:
        """Whether the rows of the upright picture are stored as columns."""
        return self.orientation >= 5

    @property
    def cached(self) -> int:
        """Bytes of decoded strips or tiles that are cached while rows are read."""
        rows = 0 if self._raw else (CACHED_BANDS + 1) * self.segment[0]
        return rows * self.shape[1] * self.shape[2] * self.dtype.itemsize

    def __getitem__(self, rows: slice) -> Channels:
        """Read the rows from ``rows.start`` to ``rows.stop``.

        Raises:
            ValueError: if the file has changed since it was opened, or is damaged.
        """
        first, last = rows.start, rows.stop
        if self.orientation in (3, 4):  # stored upside down
            first, last = self.shape[0] - last, self.shape[0] - first
        try:
            with decoding(self.path):
                stored = self._read_raw(first, last) if self._raw else self._decode(first, last)
        finally:
            self._check_unchanged()
        return exif_tags.upright(plain(self.page, stored), 1 if self.turned else self.orientation)

    @property
    def _raw(self) -> bool:
        """Whether the file stores the rows uncompressed and contiguous."""
        contiguous: bool = self.page.is_contiguous and self.page.planarconfig == tifffile.PLANARCONFIG.CONTIG
        return contiguous and self.page.compression == tifffile.COMPRESSION.NONE and not self.page.is_tiled

    def _read_raw(self, first: int, last: int) -> Channels:
        length = self.shape[1] * self.shape[2] * self.dtype.itemsize
        self.stream.seek(self.page.dataoffsets[0] + first * length)
        data = self.stream.read((last - first) * length)
        stored = np.dtype(self.page.dtype).newbyteorder(self.file.byteorder)
        return np.frombuffer(data, stored).reshape(last - first, *self.shape[1:])

    def _decode(self, first: int, last: int) -> Channels:
        height = self.segment[0]
        wanted = range(first // height, -(-last // height))
        for band in wanted:
            if band not in self.bands:
                self.bands[band] = self._band(band)
        whole = np.concatenate([self.bands[band] for band in wanted])
        for band in sorted(self.bands)[: -CACHED_BANDS or None]:
            del self.bands[band]
        return whole[first - wanted.start * height : last - wanted.start * height]

    def _band(self, band: int) -> Channels:
        """Decode one row of tiles, or one strip, (h, W, S)."""
        height, width, samples = self.shape
        top = band * self.segment[0]
        result = np.full((min(self.segment[0], height - top), width, samples), self.page.nodata, self.page.dtype)
        down, across = -(-height // self.segment[0]), -(-width // self.segment[1])
        apart = self.page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and samples > 1
        for plane in range(samples if apart else 1):
            for column in range(across):
                index = (plane * down + band) * across + column
                self.stream.seek(self.page.dataoffsets[index])
                count = self.page.databytecounts[index]
                data = self.stream.read(count) if count else None
                if data is not None and len(data) < count:
                    raise EOFError("it ends too early")
                segment, _, _ = self.page.decode(data, index, jpegtables=self.page.jpegtables)
                if segment is None:
                    continue  # absent, as in sparse files
                left = column * self.segment[1]
                part = segment[0, : result.shape[0], : width - left]
                channels = slice(plane, plane + 1) if apart else slice(None)
                result[: part.shape[0], left : left + part.shape[1], channels] = part
        return result

    def _look(self) -> tuple[int, int]:
        status = os.fstat(self.stream.fileno())
        return status.st_size, status.st_mtime_ns

    def _check_unchanged(self) -> None:
        if self._look() != self.stamp:
            raise ValueError(
                f"{self.path} changed while it was read, from {self.stamp[0]} to {self._look()[0]} bytes; "
                "make sure that nothing writes to it, and start again"
            )
