"""The scribbled pixels of a picture that is read by rows, and masks of regions of any picture.

Masks of regions are tensors (B, K, H, W) of a picture in memory, and rows (H, W, K) or (H, W) of one in tiles.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_unit_range
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture, transparency
from nlfilter_torch.photo.picture.pixels import M, Pixels, Planes, part_of
from nlfilter_torch.photo.picture.resizing import resize, resized
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Source

READ_FLOATS = 32  # floats per scribbled pixel in memory while scribbles are read and grouped by colour
ReadRows = Callable[[int, int], Tensor]  # (start, stop) to these rows


def region_rows(masks: RowSource, region: int) -> LazyRows:
    """The mask (H, W) of a region, one channel of rows (H, W, K)."""
    return LazyRows(tuple(masks.shape[:2]), partial(_region_of, masks, region), masks.dtype)


def _region_of(masks: RowSource, region: int, rows: slice) -> NDArray[np.generic]:
    return np.asarray(masks[rows])[..., region]


def read_scribbles(
    picture: Picture,
    mask: RowSource | None,
    colours: RowSource | None,
    *,
    name: str,
    strokes: str,
    memory: int,
    report: Callable[[str, int, int], None],
) -> Scribbles:
    """Read scribbles, their colours and the picture below them.

    Args:
        picture: below the scribbles.
        mask: rows (H, W) or (H, W, 1) in [0, 1] or of bool, or None.
        colours: rows (H, W, 3), read under the mask only; (H, W, 4) without a mask; or None.
        name: of the mask, for error messages.
        strokes: name of the colours, for error messages.
        memory: bytes that scribbled pixels may take.
        report: called with the progress.

    Raises:
        ValueError: if the size or number of channels of an input does not fit, or a weight is outside [0, 1].
        MemoryError: if there are too many scribbled pixels.
    """
    over = None if colours is None else overlay(picture, colours, strokes)
    if over is not None and over.samples != (4 if mask is None else 3):
        raise ValueError(
            f"{strokes} must have 3 channels with a stroke_mask, or 4 channels without one, got {over.samples} "
            f"channels {'without' if mask is None else 'with'} a stroke_mask; add or drop it"
        )
    called, weights = name, _transparency(over) if mask is None and over is not None else None
    if weights is None:
        assert mask is not None  # for mypy
        weights = _plane(picture, mask, name)
    else:
        called = strokes
    (height, width), step = picture.size, picture.statistics_rows
    places, values, below, above, count = [], [], [], [], 0
    for start in range(0, height, step):
        report("Reading strokes", start, height)
        stop = min(start + step, height)
        plane = weights(start, stop).flatten()
        if not bool(((plane >= 0) & (plane <= 1)).all()):
            raise ValueError(
                f"{called} must be in [0, 1], got values from {plane.min():g} to {plane.max():g}; clamp or scale it"
            )
        chosen = plane.nonzero().squeeze(1)
        count += len(chosen)
        check_scribble_memory(picture, count, READ_FLOATS, memory)
        if len(chosen):
            places.append(chosen + start * width)
            values.append(plane[chosen].to(picture.dtype))
            below.append(picture.tile(start, stop, 0).image.flatten(2)[:, :, chosen])
            if over is not None:
                above.append(over.tile(start, stop, 0).pixels.flatten(2)[:, :, chosen].to(picture.dtype))
    if not places:
        empty = torch.zeros(1, 1, 0, dtype=picture.dtype)
        return Scribbles(torch.zeros(0, dtype=torch.long), empty, empty.expand(-1, picture.colours, -1))
    shown = torch.cat(above, dim=2) if above else None
    return Scribbles(torch.cat(places), torch.cat(values)[None, None], torch.cat(below, dim=2), shown)


def _transparency(over: Picture) -> ReadRows:
    """Read the transparency (h, W) of a picture."""
    return lambda start, stop: torch.from_numpy(transparency(over.tile(start, stop, 0), "float32"))[..., 0]


def _plane(picture: Picture, mask: RowSource, name: str) -> ReadRows:
    """Read the rows (h, W) of a mask."""
    over = overlay(picture, mask, name)
    if over.samples != 1:
        raise ValueError(f"{name} must have 1 channel, got {over.samples}; select one")
    return lambda start, stop: over.tile(start, stop, 0).pixels[0, 0]


def overlay(picture: Picture, rows: RowSource, name: str, *, channels: int | None = None) -> Picture:
    """Wrap a source of rows, which must have the size of a picture; ``channels`` as for :class:`Picture`."""
    if tuple(rows.shape[:2]) != picture.size:
        raise ValueError(
            f"{name} must have the height and width of {picture.name}, {picture.size[0]}x{picture.size[1]}, got "
            f"{'x'.join(map(str, rows.shape[:2]))}; resize one"
        )
    return Picture(rows, name, channels=channels, hides=False)


def floats_per_scribbled_pixel(num_features: int) -> int:
    """Floats per scribbled pixel in memory; features are there twice while they are concatenated."""
    return 2 * num_features + 40


def check_scribble_memory(picture: Picture, count: int, floats: int, memory: int) -> None:
    """Raise MemoryError if ``count`` scribbled pixels of so many floats take more than ``memory`` bytes."""
    needed = count * floats * picture.dtype.itemsize
    if needed > memory:
        raise MemoryError(
            f"the strokes on {picture.name} cover at least {count} pixels and need {needed / 1e6:.0f} MB of memory, "
            f"but only {memory / 1e6:.0f} MB may be used; paint less, or allow more memory"
        )


class InTiles(Protocol):
    """A source that is not in memory."""

    picture: Picture


def is_in_memory(source: Source[M]) -> bool:
    """Whether all of a picture is in memory, so that its masks are tensors."""
    return math.isinf(source.memory)


def num_regions(source: Source[M], masks: M, name: str) -> int:
    """Number K of regions in masks, which errors call ``name``."""
    if is_in_memory(source):
        return _tensor(source, masks, name).shape[1]
    shape = cast(RowSource, masks).shape
    return 1 if len(shape) == 2 else shape[2]


def read_regions(source: Source[M], masks: M, name: str, *, needed: bool = True) -> list[Scribbles]:
    """Read the scribbles of several regions, see :meth:`Source.scribbles`."""
    regions = [masks]
    if is_in_memory(source):
        regions = [cast(M, mask) for mask in _tensor(source, masks, name).split(1, dim=1)]
    elif len(cast(RowSource, masks).shape) == 3:
        rows = cast(RowSource, masks)
        regions = [cast(M, region_rows(rows, k)) for k in range(rows.shape[2])]
    return [source.scribbles(mask, None, name, needed=needed) for mask in regions]


def region_weights(source: Source[M], masks: M, name: str) -> Planes:
    """Weights (B, K, h, w) in [0, 1] of given pixels in masks of K regions; rows are read as they are needed.

    Raises:
        ValueError: if they do not fit the picture; ``name`` is their name in the message.
    """
    if is_in_memory(source):
        planes = _tensor(source, masks, name)
        check_same_size(planes, source.size, name, "image")
        check_unit_range(planes, name)
        return part_of(planes.to(cast(Pixels, source).image).expand(source.batch, -1, -1, -1))
    picture, rows = cast(InTiles, source).picture, cast(RowSource, masks)
    return overlay(picture, rows, name, channels=num_regions(source, masks, name)).weights


def resized_masks(source: Source[M], masks: M, size: tuple[int, int], name: str) -> M:
    """Masks of regions of a picture in a smaller size (H, W).

    Interpolation may exceed their values, but must not hide an invalid one.

    Raises:
        ValueError: if they do not fit the picture; ``name`` is their name in the message.
    """
    if is_in_memory(source):
        planes = _tensor(source, masks, name)
        check_same_size(planes, source.size, name, "image")
        planes = planes.to(cast(Pixels, source).image)
        ends = planes.amin((2, 3), keepdim=True), planes.amax((2, 3), keepdim=True)
        return cast(M, resize(planes, size).clamp(*ends))
    rows = cast(RowSource, masks)
    if tuple(rows.shape[:2]) != source.size:
        raise ValueError(
            f"{name} must have the height and width of the picture, {source.size}, got {tuple(rows.shape[:2])}; "
            "resize them"
        )
    reader = WeightReader(rows)
    small = reader.clamp(resized(reader, source.size, size))
    return cast(M, small[0].permute(1, 2, 0).contiguous().numpy())


def _tensor(source: Source[M], masks: object, name: str) -> Tensor:
    """Masks of a picture in memory."""
    planes = cast(Tensor, masks)
    check_image(planes, name, batch=source.batch)
    return planes


class WeightReader:
    """Reads rows (H, W, K) or (H, W) of weights, and notes the least and largest value of each plane.

    Interpolation may exceed them, but must not hide an invalid weight.
    """

    def __init__(self, weights: RowSource) -> None:
        self._weights = weights
        self._least: list[Tensor] = []
        self._largest: list[Tensor] = []

    def __call__(self, start: int, stop: int) -> Tensor:
        """The rows (1, K, h, W) from ``start`` to ``stop``."""
        rows = torch.from_numpy(np.atleast_3d(np.array(self._weights[start:stop], np.float32)))
        rows = rows.permute(2, 0, 1)[None]
        self._least.append(rows.amin((2, 3), keepdim=True))
        self._largest.append(rows.amax((2, 3), keepdim=True))
        return rows

    def clamp(self, planes: Tensor) -> Tensor:
        """Limit planes (1, K, h, w) to the values that were read."""
        return planes.clamp(torch.cat(self._least).amin(0), torch.cat(self._largest).amax(0))
