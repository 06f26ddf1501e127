"""A rectangle of a picture, edited as part of the whole picture.

Each step is fitted to the whole picture as in :mod:`nlfilter_torch.photo.edits.recipe`; after that only the columns of
the rectangle's own pixels are needed. This is how the editor shows a part of a large photograph at full size.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.core.workers import in_order
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.declared.steps import Step, acting_steps
from nlfilter_torch.photo.edits.applying import fit_step, scribbles_of
from nlfilter_torch.photo.picture.painting import RowPainter
from nlfilter_torch.photo.picture.pictures import LazyRows, Picture, Tile
from nlfilter_torch.photo.picture.resizing import resized
from nlfilter_torch.photo.picture.sampling import Report, in_silence
from nlfilter_torch.photo.picture.source import Fitted
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Passes, Statistics, intermediate

STRIP_PIXELS = 1 << 15  # pixels of a rectangle that one worker computes at a time


@dataclass(frozen=True)
class Rectangle:
    """A range of rows and a range of columns of a picture."""

    rows: range
    columns: range

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return len(self.rows), len(self.columns)

    def grown(self, margin: int, size: tuple[int, int]) -> "Rectangle":
        """Enlarge by a margin, clipped to a picture (H, W)."""
        return Rectangle(_grown(self.rows, margin, size[0]), _grown(self.columns, margin, size[1]))

    def aligned(self, step: int, size: tuple[int, int]) -> "Rectangle":
        """Enlarge to multiples of a step, clipped to a picture (H, W)."""
        rows, columns = (
            range(axis.start // step * step, min(-(-axis.stop // step) * step, length))
            for axis, length in zip((self.rows, self.columns), size, strict=True)
        )
        return Rectangle(rows, columns)

    def meets(self, other: "Rectangle") -> bool:
        """Whether the rectangles have a pixel in common."""
        pairs = ((self.rows, other.rows), (self.columns, other.columns))
        return all(a.start < b.stop and b.start < a.stop for a, b in pairs)

    def inside(self, other: "Rectangle") -> tuple[slice, slice]:
        """Slices of this rectangle within another that contains it."""
        down, right = self.rows.start - other.rows.start, self.columns.start - other.columns.start
        return slice(down, down + len(self.rows)), slice(right, right + len(self.columns))


def _grown(places: range, margin: int, length: int) -> range:
    return range(max(0, places.start - margin), min(length, places.stop + margin))


def select_columns(whole: RowSource, columns: range) -> LazyRows:
    """A range of columns of rows (H, W) or (H, W, S)."""
    shape = (whole.shape[0], len(columns), *whole.shape[2:])
    return LazyRows(shape, lambda rows: np.asarray(whole[rows])[:, columns.start : columns.stop], whole.dtype)


def tile_of_part(tiled: Tiled, part: Rectangle) -> Tile:
    """Read the pixels of a rectangle, and those around it that its columns depend on."""
    margin = tiled.room.margin
    around = part.grown(margin, tiled.size)
    picture = Picture(select_columns(tiled.picture.source, around.columns), tiled.picture.name)
    picture.checks_scale = tiled.picture.checks_scale
    tile = picture.tile(part.rows.start, part.rows.stop, margin)
    return replace(tile, left=around.columns.start, inside=part.inside(around)[1], width=tiled.size[1])


def planes_of_part(tiled: Tiled, fitted: Fitted, part: Rectangle) -> Tensor:
    """The planes (1, C, h, w) that an edit computes from a rectangle, before ``finish``."""
    tile = tile_of_part(tiled, part)
    planes = fitted.pixels(tile.in_range(fitted.working))
    return planes if fitted.finish is not None else fitted.output(tile.image, planes)


@torch.no_grad()
@full_precision
def edited_part(tiled: Tiled, fitted: Fitted, part: Rectangle) -> Tensor:
    """Apply an edit that was fitted to a picture to a rectangle (1, C, h, w) of it."""
    around = part if fitted.finish is None else part.aligned(fitted.step, tiled.size).grown(fitted.margin, tiled.size)
    step = max(1, STRIP_PIXELS // len(around.columns))
    rows = around.rows
    strips = [
        Rectangle(range(start, min(start + step, rows.stop)), around.columns)
        for start in range(rows.start, rows.stop, step)
    ]
    tiled.room.prepare()
    workers = tiled.passes.workers(tiled.room.num_landmarks)
    planes = torch.cat(list(in_order(partial(planes_of_part, tiled, fitted), strips, workers)), dim=2)
    if fitted.finish is None:
        return planes
    tile, inner = tile_of_part(tiled, around), part.inside(around)
    result = fitted.finish(tile.in_range(fitted.working).image, planes, inner)
    return fitted.output(tile.image, result)[..., *inner]


class Stage:
    """A picture between two steps of an edit, and the step last fitted to it.

    ``stack`` closes its temporary file; ``limits`` are :attr:`Picture.limits` of the picture before the first step.
    """

    def __init__(self, picture: Picture, stack: ExitStack, limits: tuple[float, float] | None = None) -> None:
        self.picture, self._stack, self._limits = picture, stack, limits
        self._fitted: tuple[Step, Tiled, Fitted] | None = None

    def fit(self, step: Step, passes: Passes) -> tuple[Tiled, Fitted]:
        """Fit a step to the picture, unless it was the last one fitted."""
        if self._fitted is None or self._fitted[0] != step:
            self._fitted = None
            tiled = Tiled(self.picture, passes)
            fitted = fit_step(step, tiled, scribbles_of(step, tiled.size, RowPainter()))
            tiled.room.prepare()
            self._fitted = step, tiled, fitted
        return self._fitted[1:]

    def after(self, step: Step, passes: Passes) -> "Stage":
        """Apply a step to the whole picture; the result is in a temporary file."""
        tiled, fitted = self.fit(step, replace(passes, kind="float32"))
        stack = ExitStack()
        limits = self._limits or self.picture.limits
        clipped = ((rows, values.clip(*limits)) for rows, values in tiled.rows(fitted))
        source = stack.enter_context(intermediate(clipped, tiled.size, passes.folder))
        self.forget_columns()
        return Stage(Picture(source, self.picture.name), stack, limits)

    def forget_columns(self) -> None:
        """Free the columns cached between passes."""
        if self._fitted is not None:
            self._fitted[1].room.forget_columns()

    def close(self) -> None:
        """Remove the file."""
        self._stack.close()


class Parts:
    """Edited rectangles of a picture, and the steps as fitted to the whole picture; ``name`` is for error messages."""

    def __init__(self, source: RowSource, name: str) -> None:
        self._stages = [Stage(Picture(source, name), ExitStack())]
        self._known: tuple[Statistics, tuple[Step, ...]] = ("sample", ())  # statistics, and steps between the stages
        self._last: tuple[Tiled, Fitted] | None = None

    def fit(self, edit: Sequence[Step], passes: Passes) -> None:
        """Fit an edit to the whole picture, reusing steps that are fitted already; this may take long.

        After an error, including one raised by the progress report, the steps fitted until then remain valid.

        Raises:
            ValueError, MemoryError, OSError: as :func:`~nlfilter_torch.photo.edits.recipe.edit_rows`.
        """
        steps, (statistics, known) = acting_steps(edit), self._known
        self._last = None
        same = 0
        while statistics == passes.statistics and steps[same : same + 1] == known[same : same + 1] != ():
            same += 1
        self._known = passes.statistics, known[:same]
        if statistics != passes.statistics:
            self._stages[0] = Stage(self._stages[0].picture, ExitStack())
        while len(self._stages) > same + 1:
            self._stages.pop().close()
        for step in steps[same:-1]:
            self._stages.append(self._stages[-1].after(step, passes))
            self._known = passes.statistics, (*self._known[1], step)
        if steps:
            last = self._stages[len(steps) - 1]
            self._last = last.fit(steps[-1], passes)
            last.forget_columns()

    def edited(self, part: Rectangle) -> Tensor:
        """A rectangle (1, C, h, w) of the picture after the edit that was fitted last, in [0, 1]."""
        if self._last is None:
            return self.original(part)
        return edited_part(*self._last, part).clamp(0, 1)

    def reduced(self, size: tuple[int, int], report: Report = in_silence) -> Tensor:
        """The whole picture after the edit that was fitted last, reduced to a smaller size, (1, C, h, w) in [0, 1].

        ``report`` is told how many of the rows are done, and may raise an error to interrupt.
        """
        return resized(partial(self._rows, report), self._stages[0].picture.size, size).clamp(0, 1)

    def _rows(self, report: Report, start: int, stop: int) -> Tensor:
        """The edited rows from ``start`` to ``stop``."""
        height, width = self._stages[0].picture.size
        report("Full size", start, height)
        return self.edited(Rectangle(range(start, stop), range(width)))

    def original(self, part: Rectangle) -> Tensor:
        """A rectangle (1, C, h, w) of the picture, in [0, 1]."""
        picture = self._stages[0].picture
        columns = Picture(select_columns(picture.source, part.columns), picture.name)
        return columns.tile(part.rows.start, part.rows.stop, 0).image.clamp(0, 1)

    def close(self) -> None:
        """Remove temporary files."""
        while self._stages:
            self._stages.pop().close()
