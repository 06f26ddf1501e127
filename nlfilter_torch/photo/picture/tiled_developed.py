"""A picture larger than memory as it is developed: its rows, computed when they are read.

A picture is turned through two temporary files, since a row of it crosses many rows of the original.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.workers import in_order
from nlfilter_torch.photo.declared.development import Development, Frame
from nlfilter_torch.photo.declared.rows import WHITE, RowSource, Stored
from nlfilter_torch.photo.files.writing import FileRows
from nlfilter_torch.photo.picture.developing import bands_of, finished, turned_band
from nlfilter_torch.photo.picture.light import Light, fit_light
from nlfilter_torch.photo.picture.pictures import Picture, Rows, transparency
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import TILE_PIXELS, Passes, between_steps, intermediate, tile_by_tile


@contextmanager
def developed_rows(
    development: Development, passes: Passes, source: RowSource, name: str, nodata: float | None = None
) -> Iterator[RowSource]:
    """Yield the rows of a developed picture, as :func:`develop_image` makes it.

    Args:
        development: how.
        passes: tiling options.
        source: the picture. Its colours become floats unless it is only cropped.
        name: that of the source, for error messages.
        nodata: the value of pixels without data, if the last channel marks these.

    Raises:
        ValueError: if it is turned for several processes, which cannot share its temporary file, or the middle of
            the crop is outside.
        OSError: if a temporary file does not fit.
    """
    picture, floats = Picture(source, name), between_steps(passes, source)
    picture.accept_any_scale()  # until it is edited
    frame = development.frame(picture.size)
    is_turned = bool(frame.angle or frame.quarters)
    if is_turned and passes.processes is not None:
        name = "straighten" if frame.angle else "rotate"
        raise ValueError(
            f"{name} must be 0 with --workers or --cluster, got {getattr(development, name):g}; leave these out"
        )
    limits = picture.limits if is_turned or development.changes_light else (0.0, 1.0)
    with ExitStack() as stack:
        if is_turned:
            source = stack.enter_context(_turned(picture, frame, floats, limits, nodata))
        elif not frame.is_whole:
            source = CroppedRows(source, frame)
        if development.changes_light:
            framed = Picture(source, name)
            framed.accept_any_scale()
            least, most = (torch.tensor(end, dtype=framed.dtype) for end in limits)
            light = fit_light(Tiled(framed, floats), development, (least, most))
            source = LitRows(floats, framed, light)
        yield source


@dataclass(frozen=True)
class CroppedRows:
    """The part of rows (H, W) or (H, W, S) that a frame without a turn shows."""

    whole: RowSource
    frame: Frame

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w) or (h, w, S)."""
        return *self.frame.size, *self.whole.shape[2:]

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Of the rows."""
        return self.whole.dtype

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        top, left = self.frame.top, self.frame.left
        return np.asarray(self.whole[top + rows.start : top + rows.stop])[:, left : left + self.frame.width]


@dataclass(frozen=True)
class LitRows:
    """The rows of a picture in another light."""

    passes: Passes
    picture: Picture
    light: Light

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W, S)."""
        return *self.picture.size, self.picture.samples

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Floats."""
        return np.dtype(self.passes.kind)

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        return tile_by_tile(self.passes, self.picture, self.light).part(rows.start, rows.stop)[0]


@contextmanager
def _turned(
    picture: Picture, frame: Frame, floats: Passes, limits: tuple[float, float], nodata: float | None
) -> Iterator[FileRows]:
    """The rows of a picture that is turned and cropped, as floats in a temporary file."""
    with ExitStack() as stack:
        with intermediate(_as_floats(picture, floats.kind), picture.size, floats.folder) as whole:
            bands = _bands(whole, frame, picture, limits, nodata, floats)
            turned = stack.enter_context(intermediate(bands, frame.size, floats.folder))
        yield turned


def _as_floats(picture: Picture, kind: str) -> Rows:
    """All rows (h, W, S) as floats, hidden pixels with colours of pixels nearby."""
    for tile in picture.tiles(0, max(1, TILE_PIXELS // picture.size[1])):
        colours = tile.pixels[0].permute(1, 2, 0).numpy().astype(kind)
        rows = slice(tile.start, tile.start + len(colours))
        yield rows, np.concatenate([colours, transparency(tile, kind)], axis=2)


def _bands(
    whole: FileRows, frame: Frame, picture: Picture, limits: tuple[float, float], nodata: float | None, passes: Passes
) -> Rows:
    """The rows (h, w, S) of the developed picture."""
    hidden = None if nodata is None else nodata / WHITE.get(picture.kind, 1)
    bands = bands_of(frame)
    turned = in_order(turned_band, bands, passes.workers(1), partial(_part, whole, frame), frame)
    for rows, band in zip(bands, turned, strict=True):
        passes.report("Turning", rows.start, frame.height)
        planes = finished(band, picture.colours, limits, hidden)
        yield slice(rows.start, rows.stop), np.ascontiguousarray(planes[0].permute(1, 2, 0).numpy())


def _part(whole: FileRows, frame: Frame, rows: range, columns: range) -> Tensor:
    """A part (1, S, h, w) of stored rows, after the quarters of a turn."""
    height, width = frame.turned
    for _ in range(frame.quarters):
        rows, columns = range(width - columns.stop, width - columns.start), rows
        height, width = width, height
    part = torch.from_numpy(whole.part(rows, columns)).permute(2, 0, 1)[None]
    return part.rot90(-frame.quarters, (2, 3))
