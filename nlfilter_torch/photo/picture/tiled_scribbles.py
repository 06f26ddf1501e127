"""The scribbled pixels of a picture that is read by rows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.picture.drawn import Plane, Size
from nlfilter_torch.photo.picture.painting import Open, opened_picture, rasterised
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture, stored_as, transparency
from nlfilter_torch.photo.picture.pixels import Pixels, corner
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles

READ_FLOATS = 32  # floats per scribbled pixel in memory while scribbles are read and grouped by colour
ReadRows = Callable[[int, int], Tensor]  # (start, stop) to these rows


class RowPainter:
    """Rasterises marks as they are read: to rows (H, W, K), of which only a few are in memory at once."""

    def __init__(self, opened: Open = opened_picture) -> None:
        self._opened = opened

    def planes(self, shown: Sequence[Plane], size: Size, *, soft: bool = False, coloured: bool = False) -> RowSource:
        """Return :func:`rasterised` marks."""
        read = partial(_rasterised_rows, tuple(shown), size, soft=soft, coloured=coloured, opened=self._opened)
        return LazyRows((*size, 3 * coloured + len(shown)), read)

    def covers(self, planes: RowSource) -> bool:
        """Whether masks or colours cover a pixel."""
        return LazyRows(tuple(planes.shape), partial(plane_rows, planes), planes.dtype).any()


def _rasterised_rows(
    shown: Sequence[Plane], size: Size, rows: slice, *, soft: bool, coloured: bool, opened: Open
) -> NDArray[np.generic]:
    planes = rasterised(shown, size, rows, soft=soft, coloured=coloured, opened=opened)
    return stored_as(planes, "float32")


def plane_rows(planes: RowSource, rows: slice) -> NDArray[np.generic]:
    """Some rows (h, W, K) of planes."""
    return np.asarray(planes[rows])


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
            below.append(picture.tile(start, stop, 0).inner.flatten(2)[:, :, chosen])
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


@dataclass(frozen=True, eq=False)
class WeightRows:
    """Weights (1, K, h, w) of given pixels in rows (H, W, K) over a picture."""

    rows: Picture

    def __call__(self, pixels: Pixels) -> Tensor:
        """The weights of some pixels."""
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        planes = self.rows.tile(top, top + height, 0).pixels[..., left : left + width]
        return planes.to(pixels.image).clamp(0.0, 1.0)


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
