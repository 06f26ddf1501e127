"""Reading and writing of TIFF files with profile and EXIF, by tifffile; whole, or a few rows at a time."""

import logging
import math
import os
import re
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.declared.rows import Stored
from nlfilter_torch.photo.files import exif as exif_tags
from nlfilter_torch.photo.files import exif_in_tiff
from nlfilter_torch.photo.files.metadata import (
    GROUND,
    OF_A_DEPTH,
    STORAGE_TAGS,
    CheckSize,
    Decoded,
    Extras,
    Header,
    Metadata,
    Tag,
    UnhandledImage,
    bands,
    decoding,
    sound,
    turned_pair,
    turned_tag,
    upright_packet,
)
from nlfilter_torch.photo.files.tables import (
    BYTE,
    EXIF,
    LONG,
    ORIENTATION,
    RATIONAL,
    RESOLUTION,
    SHORT,
    UNDEFINED,
    Field,
    TiffTables,
)

# tifffile logs problems with a file. Without a handler Python would print them beside our error message.
logging.getLogger("tifffile").addHandler(logging.NullHandler())
XMP, PROFILE, SUB_FILES = 700, 34675, 330  # tags
RAW = (32803, 34892)  # colours of RAW files: behind a filter of colours, and linear
TILE_SIZE = 256  # side of the tiles that are written, and of the chunks of zarr arrays
MAX_CLASSIC_BYTES = 4_000_000_000  # bytes of pixels above which a BigTIFF is written
_ASSOCIATED = tifffile.EXTRASAMPLE.ASSOCALPHA
Resolution = tuple[float | tuple[int, int], float | tuple[int, int]]  # across and down
MOST_PAGES = 100  # that are counted
FEW_BITS = (1, 2, 4)  # per channel, which are read as 8
CACHED_BANDS = 2  # cached bands of strips or tiles: rows shared by two tiles of a picture span at most two


def is_tiff(head: bytes) -> bool:
    """Whether a file with these first bytes is a TIFF or BigTIFF."""
    return head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def read(path: Path, check_size: CheckSize, number: int | None = None) -> Decoded:
    """Read the picture of a number, see :class:`TiffRows`; None is the first, with a warning if there are more."""
    with decoding(path), TiffRows(path, number or 0) as rows:
        check_size((rows.shape[1], rows.shape[0]), double=rows.dtype == np.float64)
        ends = (at + count for at, count in zip(rows.page.dataoffsets, rows.page.databytecounts, strict=True) if count)
        if max(ends, default=0) > path.stat().st_size:  # decoders of JPEG fill what is missing
            raise EOFError("it ends too early")
        channels = rows.whole if rows.by_libtiff else np.asarray(rows.page.asarray())
        if rows.page.axes == "SYX":
            channels = np.moveaxis(channels, 0, -1)
        if number is None:
            rows.warn_of_pages()
        plain = plain_channels(rows.page, channels.reshape(*rows.shape[:2], -1))
        return Decoded(plain, rows.orientation, rows.metadata)


def _pages(file: tifffile.TiffFile) -> Iterator[tifffile.TiffPage]:
    """The pages of a file, at most :data:`MOST_PAGES`; before them those nested in a first page that is reduced.

    There the full picture may be, as in RAW files.
    """
    first = file.pages.first
    # No such page, or damage behind the first one, which alone is needed.
    with suppress(Exception):
        nested = first.pages if first.is_reduced or first.is_mask else None
        yield from (page for page in nested or () if isinstance(page, tifffile.TiffPage))
    yield first
    with suppress(Exception):
        for number in range(1, MOST_PAGES):
            page = file.pages[number]
            if isinstance(page, tifffile.TiffPage):
                yield page


def find_picture(file: tifffile.TiffFile, number: int = 0) -> tuple[tifffile.TiffPage, int]:
    """The picture of that number in a file, and how many there are, without masks and reduced versions.

    If there are only these, the largest of them is the picture.
    """
    found, count, largest = None, 0, file.pages.first
    for page in _pages(file):
        if not (page.is_reduced or page.is_mask):
            found = page if count == number else found
            count += 1
        elif page.imagelength * page.imagewidth > largest.imagelength * largest.imagewidth:
            largest = page
    if number >= max(count, 1):
        raise UnhandledImage(
            f"page must be less than the number of pictures, {max(count, 1)}, got {number}; count from 0"
        )
    return found or largest, max(count, 1)


def count_pages(path: Path) -> int:
    """Number of pictures in a TIFF file, see :func:`find_picture`."""
    with path.open("rb") as stream, tifffile.TiffFile(stream, name=str(path)) as file:
        return find_picture(file)[1]


class RawPicture(UnhandledImage):
    """The picture of a TIFF file is that of a RAW file, to be developed."""


def check_page(path: Path, page: tifffile.TiffPage) -> None:
    """Raise UnhandledImage unless a page is a picture in grey or RGB, with or without alpha."""
    kinds = tifffile.PHOTOMETRIC
    by_jpeg = page.compression in (tifffile.COMPRESSION.JPEG, tifffile.COMPRESSION.OJPEG)
    handled = {kinds.MINISWHITE, kinds.MINISBLACK, kinds.RGB} | ({kinds.YCBCR} if by_jpeg else set())
    if page.samplesperpixel == 1 and page.colormap is not None and page.dtype is not None and page.dtype.kind in "bu":
        handled.add(kinds.PALETTE)
    if page.photometric in RAW:
        raise RawPicture(f"{path} is a RAW file; give it the suffix of one, such as .dng")
    if page.photometric not in handled:
        name = page.photometric.name if isinstance(page.photometric, kinds) else page.photometric
        raise UnhandledImage(f"{path} is stored in {name} colours, which are not supported; convert it to grey or RGB")
    bits = page.bitspersample if isinstance(page.bitspersample, int) else max(page.bitspersample)
    if page.dtype is None or (bits != 8 * page.dtype.itemsize and bits not in FEW_BITS):
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
    """The dtype of the plain channels of a checked page, in native byte order."""
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE or page.bitspersample in FEW_BITS:
        return np.dtype(np.uint8)
    return np.dtype(page.dtype).newbyteorder("=")


def _palette(page: tifffile.TiffPage) -> NDArray[np.uint8]:
    """The colours (n, 3) of a page with a palette, at 8 bits as all readers have them."""
    colours = np.asarray(page.colormap).T
    # Some programs write 8 bits where the standard asks for 16.
    return (colours if colours.max(initial=0) < 256 else colours >> 8).astype(np.uint8)


def plain_channels(page: tifffile.TiffPage, channels: Stored) -> Stored:
    """Convert channels (H, W, S) of a page, or some of its rows: no palette, black as 0, no premultiplied alpha."""
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
        palette = _palette(page)
        return palette[np.minimum(channels[..., 0], len(palette) - 1).astype(np.intp)]
    channels = channels.astype(_native(page), copy=True)
    if page.bitspersample in FEW_BITS and page.compression != tifffile.COMPRESSION.OJPEG:
        channels = np.multiply(channels, 255 // (2**page.bitspersample - 1), dtype=np.uint8)
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        white = np.iinfo(channels.dtype.name).max if channels.dtype.kind == "u" else 1
        channels[..., :1] = white - channels[..., :1]
    return _unmultiplied(channels) if _ASSOCIATED in page.extrasamples else channels


def _by_libtiff(page: tifffile.TiffPage) -> bool:
    """Whether a page is compressed in a way that tifffile does not decode: old JPEG, and rare ones."""
    unknown = page.compression not in tifffile.TIFF.DECOMPRESSORS
    return isinstance(page.index, int) and (page.compression == tifffile.COMPRESSION.OJPEG or unknown)


#: Tags that describe a stack, or how another program stores its pictures, by their numbers.
OF_STACKS = {297: "page numbers", 400: "settings of a fax", 34412: "LSM", 43314: "NIH Image", 51123: "Micro-Manager"}
OF_STACKS |= dict.fromkeys((50838, 50839), "ImageJ") | dict.fromkeys((33471, 33560), "SIS")
OF_STACKS |= dict.fromkeys(range(33628, 33632), "MetaMorph") | dict.fromkeys((34361, 34362), "FluoView")
OF_STACKS |= dict.fromkeys((33421, 33422, *range(50706, 50742), *range(50778, 50782), *range(50827, 50835)), "DNG")
OF_STACKS |= dict.fromkeys(range(50879, 51120), "DNG") | dict.fromkeys(range(65420, 65460), "NDPI")
#: Programs whose descriptions state how many pictures there are, and of what size, as tifffile calls them.
PROGRAMS = (
    *("ome", "svs", "scn", "qpi", "bif", "philips", "metaseries", "fluoview", "micromanager", "scanimage", "stk"),
    *("lsm", "nih", "indica", "ndpi", "avs", "sis", "eer"),
)
KEPT_OF_IMAGEJ = (b"ImageJ", b"unit", b"yunit", b"zunit")  # lines of its description that are true of any picture


def _true_description(text: bytes, page: tifffile.TiffPage) -> tuple[bytes, str | None]:
    """A description without statements about geometry, and who made those that are lost, or None."""
    if text.startswith(b"ImageJ="):
        lines = [line for line in text.splitlines() if line.split(b"=")[0] in KEPT_OF_IMAGEJ]
        return b"".join(line + b"\n" for line in lines if len(lines) > 1), "ImageJ"
    if re.fullmatch(rb"shape=\([\d, ]*\)\s*", text):
        return b"", None
    if text.startswith(b'{"shape":'):
        rest = re.sub(rb'"(?:shape|axes)":\s*(?:\[[^\]]*\]|"[^"]*")\s*,?\s*', b"", text)
        return (b"" if rest.strip() == b"{}" else re.sub(rb",\s*}\s*$", b"}", rest)), None
    program = next((name for name in PROGRAMS if getattr(page, f"is_{name}")), None)
    return (text, None) if program is None else (b"", program.upper())


def _own_fields(
    tables: TiffTables, page: tifffile.TiffPage, front: tifffile.TiffPage
) -> tuple[list[Field], int | None]:
    """The fields of a page, those that it shares with a reduced version in front, and its orientation if it has one.

    The EXIF block in ``tables`` becomes that of the page, if it has one, or shares nothing.
    """
    if page.offset == front.offset or not (front.is_reduced or front.is_mask):
        tables.first = page.offset
        return tables.fields(page.offset), None
    first = tables.fields(tables.first)
    own = tables.fields(page.offset)
    if any(field.code == EXIF for field in own):
        tables.first = page.offset
    taken = {*RESOLUTION, *GROUND, *OF_A_DEPTH, *(field.code for field in own)}
    turns = [tables.number(field) for field in own if field.code == ORIENTATION]
    shared = [field for field in first if field.code not in taken]
    return own + shared, exif_tags.exif_orientation(turns[0]) if turns else None


def read_metadata(file: tifffile.TiffFile, page: tifffile.TiffPage, stream: BinaryIO) -> tuple[int, Metadata]:
    """Read the orientation of a page of a file, and the metadata of the upright picture."""
    named, front = list[str | None](), file.pages.first

    def true_description(text: bytes) -> bytes:
        true, lost = _true_description(text, page if tables.first == page.offset else front)
        named.append(lost and f"the description of the file for {lost}")
        return true

    with mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
        tables = TiffTables(data)
        fields, orientation = _own_fields(tables, page, front)
        block, moved = exif_in_tiff.block_of(tables)
        block = exif_tags.with_description(block, true_description)
        orientation, exif, damaged = exif_tags.read_upright(block, orientation)
        apart = (*exif_in_tiff.DESCRIPTIVE, *STORAGE_TAGS, XMP, SUB_FILES)
        stored = [field for field in fields if field.code not in apart]
        tags = [
            Tag(field.code, field.kind, tables.raw(field), tables.order)
            for field in stored
            if field.code not in OF_STACKS
        ]
        icc = next((tables.raw(f) for f in fields if f.code == PROFILE and f.kind in (BYTE, UNDEFINED)), None)
        packet = next((tables.raw(field) for field in fields if field.code == XMP), None)
        ratios = {field.code: tables.ratio(field) for field in fields if field.code in RESOLUTION[:2]}
        units = [tables.number(field) for field in fields if field.code == RESOLUTION[2]]
    packet, left_out = upright_packet(packet, orientation)
    left_out += [name for name in named if name]
    left_out += [f"the tags of {OF_STACKS[field.code]}" for field in stored if field.code in OF_STACKS]
    left_out += [exif_in_tiff.MOVED] * moved
    left_out += ["smaller versions and masks"] * (
        front.is_reduced or front.is_mask or any(f.code == SUB_FILES for f in fields)
    )
    scale = exif_tags.IN_INCHES.get((units or [tifffile.RESUNIT.INCH])[0] or 0)
    pair = None if scale is None or len(ratios) < 2 else sound([ratios[code] * scale for code in RESOLUTION[:2]])
    if units == [1] and set(ratios.values()) == {1.0}:  # says nothing
        tags = [tag for tag in tags if tag.code not in RESOLUTION]
    if orientation > 1:
        left_out += [f"the TIFF tag {tag.code}, as the picture is turned" for tag in tags if tag.code in GROUND]
        tags = [turned_tag(tag, orientation) for tag in tags if tag.code not in GROUND]
    height, width = page.imagelength, page.imagewidth
    size = (width, height) if orientation >= 5 else (height, width)
    extras = Extras(
        packet,
        None if pair is None else turned_pair(pair, orientation),
        tuple(tags),
        size if tags else None,
        _native(page).name if tags else "",
        left_out=(*left_out, *damaged),
    )
    return orientation, Metadata(icc, exif, extras)


def _tiles(rows: Iterable[Stored], width: int) -> Iterator[Stored]:
    """Cut rows (h, W, S) into square tiles, padded with zeros, without the last axis if S = 1."""
    for band in bands(rows, TILE_SIZE):
        for left in range(0, width, TILE_SIZE):
            tile = band[:, left : left + TILE_SIZE]
            padded = np.pad(tile, ((0, TILE_SIZE - tile.shape[0]), (0, TILE_SIZE - tile.shape[1]), (0, 0)))
            yield padded[..., 0] if padded.shape[2] == 1 else padded


def write(
    stream: BinaryIO, picture: Stored | Iterable[Stored], header: Header, page: int = 0, pages: int = 1
) -> list[str]:
    """Write a picture (H, W, S), or its rows (h, W, S) as they arrive, in tiles, compressed without loss.

    Large files become BigTIFF. Pages after the first, of as many of about that size as ``pages``, are appended, without
    the nested tables of their EXIF blocks. Returns the names of metadata that are left out.
    """
    metadata, dtype = header.metadata, header.dtype
    shape = header.shape[:2] if header.shape[2] == 1 else header.shape
    big = pages * math.prod(header.shape) * dtype.itemsize > MAX_CLASSIC_BYTES
    is_whole = isinstance(picture, np.ndarray)
    extras = metadata.extras
    kept = extras.tags_for(header.shape[:2], dtype.name)
    head = exif_in_tiff.opening(metadata.exif, kept[0].order if kept else "<", big)
    left_out = extras.lacking_tags(kept) + [exif_in_tiff.MOVED] * head.moved
    if page:
        left_out += ["EXIF of pages after the first"] * bool(head.nested)
        stream.seek(0)
        first = TiffTables(stream.read(16))
        stream.seek(0)
        big, head = first.big, exif_in_tiff.Opening(first.order, b"", head.tags, {})
    tags = {tag.code: tag for tag in (*kept, *head.tags) if tag.code not in RESOLUTION}
    if extras.xmp is not None:
        tags[XMP] = Tag(XMP, BYTE, extras.xmp, head.order)
    resolution, unit = _resolution(extras, kept)
    # tifffile does not write nested tables, so a placeholder tag with the next lower number reserves space for each.
    places = [(code - 1, LONG, 1, 0, True) for code in head.nested]
    order = None if page else head.order
    with tifffile.TiffWriter(stream, bigtiff=big and not page, byteorder=order, append=page > 0) as file:  # type: ignore[arg-type]
        stream.write(head.body)
        file.write(
            picture.reshape(shape) if isinstance(picture, np.ndarray) else _tiles(picture, header.shape[1]),
            shape=shape,
            dtype=None if is_whole else dtype,
            tile=None if is_whole else (TILE_SIZE, TILE_SIZE),
            # Compressing tiles ahead in threads would queue hundreds of megabytes.
            maxworkers=None if is_whole else 1,
            buffersize=None if is_whole else TILE_SIZE * TILE_SIZE * header.shape[2] * dtype.itemsize,
            photometric="rgb" if len(shape) == 3 and shape[2] >= 3 else "minisblack",
            planarconfig="contig" if len(shape) == 3 else None,
            extrasamples=["unassalpha"] if header.alpha else None,
            compression="zlib",
            predictor=bool(np.issubdtype(dtype, np.integer)),
            iccprofile=metadata.icc,
            # As bytes, since tifffile would change the count of some types; the type is set afterwards.
            extratags=[
                (ORIENTATION, SHORT, 1, 1, True),
                *((tag.code, UNDEFINED, 0, tag.in_order(head.order), True) for tag in tags.values()),
                *places,
            ],
            metadata=None,
            software=False,
            resolution=resolution,
            resolutionunit=unit,
        )
    stream.flush()
    with mmap(stream.fileno(), 0, access=ACCESS_READ) as data:
        tables = TiffTables(data)
        if page:
            stream.seek(0)
            tables.first = tifffile.TiffFile(stream).pages[page].offset
        positions = {field.code: field.entry for field in tables.fields(tables.first)}
    for code, offset in head.nested.items():
        exif_in_tiff.point(stream, head.order, big, positions[code - 1], code, offset)
    for tag in tags.values():
        stream.seek(positions[tag.code] + 2)
        stream.write(struct.pack(head.order + ("HQ" if big else "HI"), tag.kind, tag.count))
    return left_out


def _resolution(extras: Extras, tags: Iterable[Tag]) -> tuple[Resolution | None, int | None]:
    """The resolution and its unit as stored in a TIFF file, or else in dpi."""
    kinds: dict[int, int] = dict(zip(RESOLUTION, (RATIONAL, RATIONAL, SHORT), strict=True))
    stored = {tag.code: tag for tag in tags if tag.kind == kinds.get(tag.code) and tag.count == 1}
    values = [struct.unpack(stored[code].order + "II", stored[code].data) for code in RESOLUTION[:2] if code in stored]
    unit = stored.get(RESOLUTION[2])
    if len(values) == 2:
        number = tifffile.RESUNIT.INCH if unit is None else struct.unpack(unit.order + "H", unit.data)[0]
        return (values[0], values[1]), number
    return extras.dpi, None if extras.dpi is None else tifffile.RESUNIT.INCH


def _unmultiplied(channels: Stored) -> Stored:
    """Divide premultiplied colours by their alpha; black where alpha is 0."""
    colour, alpha = channels[..., :-1].astype(np.float64), channels[..., -1:].astype(np.float64)
    integer = np.issubdtype(channels.dtype, np.integer)
    limit = np.iinfo(channels.dtype.name).max if integer else 1.0
    plain = np.divide(colour * limit, alpha, out=np.zeros_like(colour), where=alpha > 0)
    plain = np.rint(plain.clip(0, limit)) if integer else plain
    return np.concatenate([plain.astype(channels.dtype), channels[..., -1:]], axis=-1)


class TiffRows:
    """A picture of a TIFF file, upright, as rows (H, W, S).

    Attributes:
        shape: (H, W, S).
        dtype: dtype in native byte order.
        metadata: profile, EXIF and the rest.
        alpha: whether the last channel is transparency.
        pages: number of pictures in the file, see :func:`find_picture`.
    """

    def __init__(self, path: Path, number: int = 0) -> None:
        """Open the file and read the header of its picture of that number, of which 0 is the first.

        Raises:
            UnhandledImage: if the picture is of an unsupported kind.
        """
        self.path, self.number = path, number
        self.stream: BinaryIO = path.open("rb")
        try:
            self.file = tifffile.TiffFile(self.stream, name=str(path))
            self.page, self.pages = find_picture(self.file, number)
            check_page(path, self.page)
            self.orientation, self.metadata = read_metadata(self.file, self.page, self.stream)
        except BaseException:
            self.stream.close()
            raise
        page = self.page
        self.stamp = self._look()
        self.by_libtiff = _by_libtiff(page)
        self.stored = page.samplesperpixel  # 1 of a picture with a palette
        samples = 3 if page.photometric == tifffile.PHOTOMETRIC.PALETTE else self.stored
        self.shape = (page.imagelength, page.imagewidth, samples)
        self.dtype = _native(page)
        self.alpha = bool(page.extrasamples)
        # (height, width) of a strip or tile; the declared height of a strip may exceed the picture's.
        self.segment = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
        if self.by_libtiff:
            self.segment = self.shape[:2]
        self.segment = (min(self.segment[0], self.shape[0]), self.segment[1])
        self.bands: dict[int, Stored] = {}

    def __reduce__(self) -> tuple[type["TiffRows"], tuple[Path, int]]:
        return TiffRows, (self.path.absolute(), self.number)  # another process opens the file again

    def warn_of_pages(self) -> None:
        """Warn if the file has several pictures, with pages of their own or not, of which only one is read."""
        stated = re.search(r"images=(\d+)", self.page.imagej_description or "")
        if stated is not None and int(stated[1]) > self.pages:
            warn(f"{self.path} has {stated[1]} pictures behind one page, of which only the first is read")
            return
        if self.pages > 1:
            least = "at least " if self.pages == MOST_PAGES else ""
            warn(f"{self.path} has {least}{self.pages} pages, of which only the first is read; --pages edits all")

    @property
    def whole(self) -> Stored:
        """All stored channels (H, W, S), decoded by libtiff; raises UnhandledImage if it does not know how."""
        with mmap(self.stream.fileno(), 0, access=ACCESS_READ) as data:
            try:
                channels = np.asarray(imagecodecs.tiff_decode(data, self.page.index))
            except Exception as error:
                if self.page.compression == tifffile.COMPRESSION.OJPEG:
                    raise
                raise UnhandledImage(
                    f"{self.path} is compressed in a way, number {int(self.page.compression)}, that libtiff, which "
                    "reads it, does not support; save it uncompressed"
                ) from error
        return channels.reshape(*self.shape[:2], -1)

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
        return rows * self.shape[1] * self.stored * np.dtype(self.page.dtype).itemsize

    def __getitem__(self, rows: slice) -> Stored:
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
        return exif_tags.upright(plain_channels(self.page, stored), 1 if self.turned else self.orientation)

    @property
    def _raw(self) -> bool:
        """Whether the file stores the rows uncompressed and contiguous."""
        contiguous: bool = self.page.is_contiguous and self.page.planarconfig == tifffile.PLANARCONFIG.CONTIG
        return (
            not self.by_libtiff
            and contiguous
            and self.page.compression == tifffile.COMPRESSION.NONE
            and not self.page.is_tiled
        )

    def _read_raw(self, first: int, last: int) -> Stored:
        length = self.shape[1] * self.stored * np.dtype(self.page.dtype).itemsize
        self.stream.seek(self.page.dataoffsets[0] + first * length)
        data = self.stream.read((last - first) * length)
        stored = np.dtype(self.page.dtype).newbyteorder(self.file.byteorder)
        return np.frombuffer(data, stored).reshape(last - first, self.shape[1], self.stored)

    def _decode(self, first: int, last: int) -> Stored:
        height = self.segment[0]
        wanted = range(first // height, -(-last // height))
        for band in wanted:
            if band not in self.bands:
                self.bands[band] = self._band(band)
        whole = np.concatenate([self.bands[band] for band in wanted])
        for band in sorted(self.bands)[: -CACHED_BANDS or None]:
            del self.bands[band]
        return whole[first - wanted.start * height : last - wanted.start * height]

    def _band(self, band: int) -> Stored:
        """Decode one row of tiles, or one strip, (h, W, S)."""
        if self.by_libtiff:
            return self.whole
        height, width, samples = *self.shape[:2], self.stored
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
