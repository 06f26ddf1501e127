"""Pictures read a few rows at a time: memory maps, zarr arrays, tifffile files, anything that can be sliced."""

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import warn_of_scale
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.hidden import REACH, fill_nearby
from nlfilter_torch.operator.pixel_matrix import Columns
from nlfilter_torch.photo.declared.rows import WHITE, RowSource, Stored, is_hidden
from nlfilter_torch.photo.picture.pixels import Pixels, WorkingRange, corner

KINDS = ("uint8", "uint16", "float16", "float32", "float64")
Rows = Iterator[tuple[slice, Stored]]  # with their position in the picture
CHUNK_ROWS = 64  # of rows that are only searched
STATISTICS_PIXELS = 1 << 15  # in a block of a pass; independent of the tile size, so that sums agree bit by bit


FLOAT32: np.dtype[np.generic] = np.dtype(np.float32)


@dataclass(frozen=True)
class LazyRows:
    """Rows that are computed when they are read.

    Attributes:
        shape: (H, W) or (H, W, S).
        read: computes the rows from ``rows.start`` to ``rows.stop``.
        dtype: a numpy dtype.
    """

    shape: tuple[int, ...]
    read: Callable[[slice], Stored]
    dtype: np.dtype[np.generic] = FLOAT32

    def __getitem__(self, rows: slice) -> Stored:
        """The rows from ``rows.start`` to ``rows.stop``."""
        return self.read(rows)

    def any(self) -> bool:
        """Whether a value is not 0; reads a few rows at a time."""
        height = self.shape[0]
        return any(self[start : min(start + CHUNK_ROWS, height)].any() for start in range(0, height, CHUNK_ROWS))


class RowTarget(Protocol):
    """Rows to write, of the source's shape."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the source."""

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of the stored channels; integers are clipped and rounded."""

    def __setitem__(self, rows: slice, values: Stored, /) -> None:
        """Store these rows."""


class Opacity(Protocol):
    """How much the pixels of a picture count."""

    def rows(self, start: int, stop: int) -> Tensor:
        """The weights (1, 1, h, W) of rows."""


class TileFilter(Protocol):
    """A filter that compares the pixels of tiles."""

    def features(self, tile: "Tile") -> Tensor:
        """Features (1, D, n) of the pixels of a tile."""

    def columns_of(self, tile: "Tile") -> Columns:
        """Columns of the pixels of a tile."""


class TileLayers(Protocol):
    """Detail layers of planes of a picture."""

    def compute(self, pixels: Pixels) -> Tensor:
        """The layers at the pixels, without a cache."""


@dataclass(frozen=True, eq=False)
class Tile:
    """A block of rows of a picture, with a halo of rows around it; or a rectangle of them.

    Attributes:
        start: index of the first of the rows.
        picture: computes :attr:`pixels`, in the thread that first needs them.
        read: (h', W, S), the rows with the halo as they are stored.
        halo: number of additional rows at the top and at the bottom.
        stored: (h, W, S), the rows themselves.
        width: W of the picture.
        beyond: numbers of rows in ``read`` above and below the halo, if hidden pixels take colours of pixels nearby.
        known: :attr:`pixels`, if they were computed from those of another tile.
        left: column of the picture that ``stored`` begins with.
        inside: columns of the rectangle in ``stored``; None is all.
        counted: how much the pixels of the picture count; None is 1 each.
        whole: the tile that this one is a part of, and its rows in that, if it is one.
    """

    start: int
    picture: "Picture"
    read: Stored
    halo: tuple[int, int]
    stored: Stored
    width: int
    beyond: tuple[int, int] | None = None
    known: Tensor | None = None
    left: int = 0
    inside: slice | None = None
    counted: "Opacity | None" = None
    whole: "tuple[Tile, slice] | None" = None
    _features: dict[TileFilter, Tensor] = field(default_factory=dict, init=False)
    _columns: dict[TileFilter, Columns] = field(default_factory=dict, init=False)
    _layers: dict[TileLayers, Tensor] = field(default_factory=dict, init=False)

    @cached_property
    def pixels(self) -> Tensor:
        """The pixels (1, C, h, W), C = 1 or 3, with the halo. Integers are scaled to [0, 1].

        Raises:
            ValueError: if they are not finite.
        """
        return self.picture.pixels_of(self) if self.known is None else self.known

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the first pixel of ``pixels``."""
        return self.start - self.halo[0], self.left

    @property
    def inner(self) -> Inner:
        """Which of ``pixels`` are not of the halo."""
        return slice(self.halo[0], self.pixels.shape[2] - self.halo[1]), self.inside or slice(None)

    @property
    def image(self) -> Tensor:
        """The pixels (1, C, h, W) without the halo."""
        return self.pixels[..., *self.inner]

    @property
    def first(self) -> int:
        """Row-major index in the picture of the first of these."""
        return self.start * self.width + self.left + (0 if self.inside is None else self.inside.start)

    @property
    def weights(self) -> Tensor | None:
        """How much these count, (1, 1, h, W); None is 1 each."""
        if self.counted is None:
            return None
        return self.counted.rows(self.start, self.start + len(self.stored)).to(self.pixels.dtype)

    def in_range(self, working: WorkingRange | None) -> "Tile":
        """The tile of the same picture in a range of values."""
        return self if working is None else replace(self, known=working.seen(self.pixels))

    def parts(self, rows: int) -> "Iterator[Tile]":
        """Split the tile into groups of rows, whose features are computed at once."""
        for first in range(0, len(self.stored), rows):
            part = slice(first, min(first + rows, len(self.stored)))
            yield replace(
                self,
                start=self.start + first,
                known=self.pixels[:, :, self.halo[0] + part.start : self.halo[0] + part.stop],
                halo=(0, 0),
                stored=self.stored[part],
                whole=(self, part),
            )

    def features(self, operator: TileFilter) -> Tensor:
        """Features (1, D, n) of the pixels, computed once per operator."""
        if self.whole is not None:
            tile, rows = self.whole
            width = self.image.shape[3]
            return tile.features(operator)[:, :, rows.start * width : rows.stop * width]
        if operator not in self._features:
            self._features[operator] = operator.features(self)
        return self._features[operator]

    def columns(self, operator: TileFilter) -> Columns:
        """Columns of the pixels, computed once per operator."""
        if operator not in self._columns:
            self._columns[operator] = operator.columns_of(self)
        return self._columns[operator]

    def layers(self, planes: TileLayers) -> Tensor:
        """The detail layers of the pixels, cached until the layers of other planes are requested."""
        if planes not in self._layers:
            self._layers.clear()
            self._layers[planes] = planes.compute(self)
        return self._layers[planes]


class Picture:
    """A source of rows as an image, with only a few rows in memory at once.

    Attributes:
        size: (H, W).
        colours: 1 or 3; a further channel is transparency.
        dtype: of the computation.
        checks_scale: whether a warning is due if values are far outside [0, 1].
        hides: whether pixels are hidden where the transparency is 0: they have the colours of pixels nearby that are
            not, see :func:`fill_nearby`.
        working: the range in which its values are seen, or None.
    """

    working: WorkingRange | None = None

    def __init__(
        self,
        source: RowSource,
        name: str = "source",
        *,
        channels: int | None = None,
        hides: bool = True,
    ) -> None:
        """Check the shape and type of ``source``, called ``name`` in error messages.

        ``channels`` is that of something other than a picture: all of them are read, and none is transparency.
        ``hides`` is False for what is laid over a picture, whose transparent pixels are not used.
        """
        self.source, self.name = source, name
        shape, kind = tuple(source.shape), np.dtype(source.dtype).name
        if len(shape) not in (2, 3) or 0 in shape or (len(shape) == 3 and shape[2] > (channels or 4)):
            raise ValueError(
                f"{name} must have the shape (H, W) or (H, W, S) with one to four channels, got {shape}; "
                "move the channels to the end"
            )
        if kind not in (*KINDS, "bool"):
            raise TypeError(f"{name} must hold one of {', '.join(KINDS)}, got {kind}; convert it")
        self.size = (int(shape[0]), int(shape[1]))
        self.samples = int(shape[2]) if len(shape) == 3 else 1
        self.colours = channels or (3 if self.samples >= 3 else 1)
        self.kind, self.checks_scale = kind, channels is None and kind not in WHITE
        self.dtype = torch.float64 if kind == "float64" else torch.float32
        self.hides = hides and channels is None and self.samples in (2, 4)

    def accept_any_scale(self) -> None:
        """Do not warn of values far outside [0, 1] from now on."""
        self.checks_scale = False

    def in_range(self, working: WorkingRange) -> "Picture":
        """The picture, seen in a range of values."""
        seen = copy(self)
        seen.working = working
        return seen

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.size[0] * self.size[1]

    def tile(self, start: int, stop: int, margin: int) -> Tile:
        """Read the rows from ``start`` to ``stop`` and up to ``margin`` more on both sides.

        Raises:
            ValueError: if the source returns rows of another shape than declared.
        """
        first, last = max(start - margin, 0), min(stop + margin, self.size[0])
        stored = self._read(first, last)
        halo = (start - first, last - stop)
        tile = Tile(start, self, stored, halo, stored[halo[0] : last - first - halo[1]], self.size[1])
        if not (self.hides and is_hidden(stored).any()):
            return tile
        above, below = self._read(max(first - REACH, 0), first), self._read(last, min(last + REACH, self.size[0]))
        return replace(tile, read=np.concatenate([above, stored, below]), beyond=(len(above), len(below)))

    def pixels_of(self, tile: Tile) -> Tensor:
        """The colours (1, C, h, W) of a tile with its halo, as they are seen; hidden ones are those of pixels nearby.

        Raises:
            ValueError: if they are not finite.
        """
        if tile.beyond is None:
            image = self._converted(tile.read)
        else:
            above, hidden = tile.beyond[0], is_hidden(tile.read)
            image = self._converted(np.where(hidden[..., None], tile.read.dtype.type(0), tile.read))
            filled = fill_nearby(image, torch.from_numpy(~hidden)[None, None])
            image = filled[:, :, above : len(hidden) - tile.beyond[1]]
        return image if self.working is None else self.working.seen(image)

    def weights(self, pixels: Pixels) -> Tensor:
        """The values (1, K, h, w) in [0, 1] at the places of pixels of another picture of the same size."""
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        planes = self.tile(top, top + height, 0).pixels[..., left : left + width]
        return planes.to(pixels.image).clamp(0.0, 1.0)

    def _read(self, first: int, last: int) -> Stored:
        """The rows (h, W, S) from ``first`` to ``last``."""
        if first == last:
            return np.empty((0, self.size[1], self.samples), self.kind)
        stored = np.asarray(self.source[first:last])
        wanted = (last - first, *self.source.shape[1:])
        if stored.shape != wanted or tuple(self.source.shape[:2]) != self.size:
            raise ValueError(
                f"{self.name} must keep its size while it is read, {self.size[0]} rows of {self.size[1]}, but gave "
                f"{stored.shape} for {wanted}; make sure that nothing writes to it"
            )
        return stored.reshape(last - first, self.size[1], self.samples)

    def opacity(self, start: int, stop: int) -> Stored:
        """The transparency (h, W) of rows, as it is stored."""
        return self._read(start, stop)[..., -1].copy()

    def _converted(self, stored: Stored) -> Tensor:
        """The colours (1, C, h, W) of rows (h, W, S)."""
        values: NDArray[np.float32 | np.float64] = stored[..., : self.colours].astype(
            np.float64 if self.kind == "float64" else np.float32
        )
        if self.kind in WHITE:
            values = values / np.float32(WHITE[self.kind])
        elif not np.isfinite(stored).all():
            raise ValueError(f"{self.name} holds NaN or infinite pixels; replace them first")
        image = torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))[None]
        if self.checks_scale:
            self.checks_scale = not warn_of_scale(image, self.name)  # warns once
        return image

    def tiles(self, margin: int, rows: int) -> Iterator[Tile]:
        """Yield all rows, in tiles of ``rows``."""
        for start in range(0, self.size[0], rows):
            yield self.tile(start, min(start + rows, self.size[0]), margin)

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Limits of the values between steps of an edit: 0 and 1, or the range of a picture of floats if larger."""
        if self.kind in WHITE:
            return 0.0, 1.0
        ends = [(float(tile.pixels.min()), float(tile.pixels.max())) for tile in self.tiles(0, self.statistics_rows)]
        least, most = zip(*ends, strict=True)
        return min(0.0, *least), max(1.0, *most)

    @property
    def statistics_rows(self) -> int:
        """Rows in a block of a pass that computes statistics."""
        return 2 * max(1, STATISTICS_PIXELS // 2 // self.size[1])


def stored_as(values: Tensor, kind: str) -> Stored:
    """Convert channels (1, C, h, W) to rows (h, W, C) of dtype ``kind``; integers are clipped and rounded."""
    rows: NDArray[np.float32 | np.float64] = values[0].permute(1, 2, 0).numpy(force=True)
    if kind in WHITE:
        rows = np.rint(rows.clip(0, 1) * WHITE[kind])
    return np.ascontiguousarray(rows.astype(kind))


def put_back(values: Stored, colours: Stored, hidden: NDArray[np.bool_]) -> None:
    """Put the stored colours (n, C) of the hidden pixels (h, W) of a picture back into its rows (h, W, D).

    They keep their bits where the dtype is the same. Those of a grey picture become red, green and blue.
    """
    if colours.dtype != values.dtype:
        white = WHITE.get(colours.dtype.name, 1)
        planes = torch.from_numpy(colours.astype(np.float64) / white).T[None, :, None]
        colours = stored_as(planes, values.dtype.name)[0]
    values[hidden] = colours


def transparency(tile: Tile, kind: str) -> Stored:
    """The transparency (h, W, 0 or 1) of a tile, as dtype ``kind``."""
    extra = tile.stored[..., 3 if tile.stored.shape[2] >= 3 else 1 :]
    if extra.dtype.name == kind:
        return np.ascontiguousarray(extra)
    values = torch.from_numpy(np.ascontiguousarray(extra.astype(np.float64)).transpose(2, 0, 1))[None]
    return stored_as(values / WHITE.get(extra.dtype.name, 1), kind)


def mask_of(tile: Tile) -> Tensor:
    """:func:`mask_plane` of a tile."""
    return mask_plane(tile.image, torch.from_numpy(transparency(tile, "float32")).prod(2))


def mask_plane(pixels: Tensor, opacity: Tensor | None) -> Tensor:
    """Luminance (1, 1, h, W) of a mask, in [0, 1]; transparent pixels, which may have any colour, are 0."""
    grey = reduce_channels(pixels, "luminance").clamp(0, 1)
    return grey if opacity is None else grey * opacity
