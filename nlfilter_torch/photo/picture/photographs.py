"""A photograph of an image file in memory: its pixels to compute with, and what is written back with them.

Needs the ``cli`` extra (Pillow, tifffile, imagecodecs, psutil).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.checks import check_count
from nlfilter_torch.operator.hidden import REACH
from nlfilter_torch.photo.declared.development import Development, Frame
from nlfilter_torch.photo.declared.rows import NodataRows, Stored, is_hidden, keep_apart
from nlfilter_torch.photo.files.exif import of_part
from nlfilter_torch.photo.files.formats import (
    DEPTHS,
    Depth,
    check_depth,
    check_type,
    read_channels,
    type_of,
    write_file,
    write_pages,
)
from nlfilter_torch.photo.files.metadata import NO_EXTRAS, Extras, Header, Metadata
from nlfilter_torch.photo.picture.developing import develop_planes, finished, limits_of
from nlfilter_torch.photo.picture.pictures import Picture, put_back, stored_as, transparency
from nlfilter_torch.photo.picture.pixels import STRIP


@dataclass(frozen=True)
class HiddenPixels:
    """The pixels of a file that do not count: transparent ones, and those without data.

    Attributes:
        places: where they are, (H, W).
        colours: as they are stored, (n, C).
        nodata: the value that says that there is no data, or None.
    """

    places: NDArray[np.bool_]
    colours: Stored
    nodata: float | None = None

    def put_back(self, channels: Stored) -> None:
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


def read_photograph(
    path: str | Path, *, bytes_per_pixel: int = 0, memory: int | None = None, page: int | None = None
) -> Photograph:
    """Read an image file.

    Args:
        path: A PNG, JPEG, TIFF, WebP or AVIF file, recognised by its content: grey or RGB, with or without alpha, 8 or
            16 bits, 10 or 12 (AVIF, read as 16) or floats (TIFF). Of several pages or pictures in a TIFF or JPEG file,
            the first is read. With the extras ``raw`` and ``heic`` also HEIC files, and RAW files, which are recognised
            by their suffix and read as 16 bits.
        bytes_per_pixel: Memory that editing will need per pixel in float32, checked before decoding; doubled for files
            of 64-bit floats.
        memory: Bytes that may be used; None is the free memory.
        page: Number of a picture in a TIFF file, from 0; None is the first, with a warning if there are more.

    Returns:
        The photograph, turned upright.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is empty, damaged, not an image, or of an unsupported kind.
        TooLarge: ``bytes_per_pixel`` for all pixels exceeds the memory. It is a MemoryError.
    """
    path = Path(path)
    decoded = read_channels(path, bytes_per_pixel=bytes_per_pixel, memory=memory, page=page)
    channels, metadata = decoded.channels, decoded.metadata
    depth = check_depth(path, channels.dtype)
    planes, hidden = _planes_of(channels, metadata.extras.nodata, str(path))
    colours = 3 if planes.shape[1] >= 3 else 1
    alpha = planes[:, colours:] if planes.shape[1] > colours else None
    return Photograph(planes[:, :colours], depth, alpha, metadata.icc, metadata.exif, metadata.extras, hidden)  # type: ignore[arg-type]


def _planes_of(channels: Stored, nodata: float | None, name: str) -> tuple[Tensor, HiddenPixels | None]:
    """All channels (1, S, H, W) of a picture, converted a few rows at a time to save memory, and what it hides."""
    marked = nodata is not None and channels.shape[2] in (1, 3)
    picture = Picture(NodataRows(channels, nodata) if marked and nodata is not None else channels, name)
    picture.accept_any_scale()  # until it is edited
    planes = torch.empty(1, channels.shape[2], *picture.size, dtype=picture.dtype)
    places = np.zeros(picture.size if picture.hides else (0, 0), np.bool_)
    rows = max(STRIP // picture.size[1], 4 * REACH if picture.hides else 1)
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


def write_photograph(photograph: Photograph, path: str | Path, *, quality: int | None = None) -> None:
    """Write an image file at the photograph's depth; the extension of the name selects the type.

    Integer channels are clipped to their range and rounded. JPEG is written at quality 95 without chroma subsampling,
    AVIF at 90, WebP and TIFF without loss. The file appears complete or not at all.

    Args:
        photograph: what to write.
        path: name of the file.
        quality: of a JPEG, AVIF or WebP file, 1 to 100, which makes WebP lossy; None is the default. Other types
            ignore it.

    Raises:
        ValueError: if the quality is out of range; see also
            :func:`~nlfilter_torch.photo.picture.photographs.check_output`.
        OSError: The file cannot be written.
    """
    if quality is not None:
        check_count(quality, "quality", most=100)
    path = Path(path)
    check_output(path, photograph)
    write_file(path, *_stored(photograph), quality)


def write_photographs(photographs: Iterable[Photograph], path: Path, count: int) -> None:
    """Write ``count`` photographs, as they arrive, as the pages of a TIFF file; see :func:`write_photograph`."""
    write_pages(path, map(_stored, photographs), count)


def _stored(photograph: Photograph) -> tuple[Stored, Header]:
    """The channels (H, W, S) of a photograph in a file, and what the file says of them."""
    planes = [photograph.pixels] if photograph.alpha is None else [photograph.pixels, photograph.alpha]
    rows = max(1, STRIP // photograph.size[1])
    parts = zip(*(plane.split(rows, dim=2) for plane in planes), strict=True)
    channels = np.concatenate([stored_as(torch.cat(part, dim=1), photograph.depth) for part in parts])  # (H, W, S)
    if photograph.hidden is not None:
        photograph.hidden.put_back(channels)
    height, width, samples = channels.shape
    return channels, Header((height, width, samples), channels.dtype, photograph.alpha is not None, photograph.metadata)


def check_output(path: str | Path, photograph: Photograph) -> str:
    """Raise ValueError unless ``photograph`` can be written to ``path``; return the file type.

    Call it before long work, so that the error comes early.
    """
    return check_type(path, photograph.depth, photograph.alpha is not None, photograph.size, photograph.metadata)


def transparent(photograph: Photograph, target: Path, cut: Tensor | None = None) -> Photograph:
    """A photograph as it is when an object of it is cut out, see :func:`depth_in`.

    ``cut`` are the colours of the object and its mask, (1, C + 1, H, W); None is all of the photograph.
    """
    weights = photograph.weights
    opacity = torch.ones_like(photograph.pixels[:, :1]) if weights is None else weights.to(photograph.pixels)
    pixels = photograph.pixels
    if cut is not None:
        pixels, mask = cut.detach().to(pixels).tensor_split([-1], dim=1)
        opacity = opacity * mask
    depth = depth_in(target, photograph.depth)
    return replace(photograph.with_pixels(pixels), alpha=opacity, hidden=None, depth=depth)


def depth_in(target: Path, depth: str) -> Depth:
    """The depth of a photograph, or the nearest that a file of that name can have."""
    depths = DEPTHS.get(type_of(target) or "", (depth,))
    return cast(Depth, depth if depth in depths else depths[-1])


def cut_photograph(photograph: Photograph, development: Development) -> Photograph:
    """Turn, straighten and crop a photograph; raises as :func:`develop_photograph`."""
    frame = development.frame(photograph.size)
    if frame.is_whole:
        return photograph
    cut = _cropped(photograph, frame) if frame.angle == 0 else _turned(photograph, frame)
    return replace(cut, exif=of_part(photograph.exif, frame.size[::-1]))


def _cropped(photograph: Photograph, frame: Frame) -> Photograph:
    """A photograph that is turned by quarters and cropped."""
    alpha, hidden = photograph.alpha, photograph.hidden
    if hidden is not None:
        rows, columns = (slice(start, start + n) for start, n in ((frame.top, frame.height), (frame.left, frame.width)))
        numbers = np.full(hidden.places.shape, -1)  # of the hidden pixels
        numbers[hidden.places] = np.arange(len(hidden.colours))
        numbers = np.rot90(numbers, -frame.quarters)[rows, columns]
        hidden = replace(hidden, places=numbers >= 0, colours=hidden.colours[numbers[numbers >= 0]])
    return replace(
        photograph,
        pixels=develop_planes(photograph.pixels, frame).contiguous(),
        alpha=None if alpha is None else develop_planes(alpha, frame).contiguous(),
        hidden=hidden,
    )


def _turned(photograph: Photograph, frame: Frame) -> Photograph:
    """A photograph that is straightened and cropped; hidden pixels have the colours around them if it has opacity."""
    hidden, colours = photograph.hidden, photograph.pixels.shape[1]
    least, most = limits_of(photograph.pixels)
    planes = [photograph.pixels]
    nodata = None if hidden is None else hidden.nodata
    if photograph.alpha is not None:
        planes.append(photograph.alpha)
    elif hidden is not None:
        planes.append(torch.from_numpy(~hidden.places)[None, None].to(photograph.pixels))
    turned = finished(develop_planes(torch.cat(planes, dim=1), frame), colours, (float(least), float(most)))
    pixels, opacity = turned[:, :colours], turned[:, colours:]
    if nodata is not None:
        places = (opacity.round() <= 0)[0, 0].numpy()
        filled = np.full((int(places.sum()), colours), nodata, photograph.depth)
        return replace(photograph, pixels=pixels, hidden=_hidden(places, filled, nodata))
    if photograph.alpha is None:
        return replace(photograph, pixels=pixels)
    places = is_hidden(opacity[0].permute(1, 2, 0).numpy())
    return replace(
        photograph, pixels=pixels, alpha=opacity, hidden=_hidden(places, _at(pixels, places, photograph.depth))
    )


def _at(pixels: Tensor, places: NDArray[np.bool_], depth: str) -> Stored:
    """The colours (n, C) of pixels at places (H, W), as they are stored."""
    return stored_as(pixels, depth)[places]


def _hidden(places: NDArray[np.bool_], colours: Stored, nodata: float | None = None) -> HiddenPixels | None:
    return HiddenPixels(places, colours, nodata) if places.any() else None
