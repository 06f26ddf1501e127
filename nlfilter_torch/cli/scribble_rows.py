"""What someone paints or marks on a photograph that is read by rows, by rows as well."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.cli.editing import Job
from nlfilter_torch.cli.scribbles import (
    Rectangle,
    check_size,
    check_strokes,
    coloured_rectangles,
    opaque,
    plain_rectangles,
    unfocused,
    with_sliders,
)
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.tiled.sources import Picture, transparency

Floats = NDArray[np.float32]


def _within(rectangle: Rectangle, rows: slice) -> tuple[slice, slice]:
    """The part of a rectangle that lies in some rows, as counted from the first of these."""
    top, bottom = (max(row - rows.start, 0) for row in (rectangle.rows.start, rectangle.rows.stop))
    return slice(top, bottom), rectangle.columns


@dataclass(frozen=True)
class RegionRows:
    """Regions of a photograph: rows (h, W, K) of their weights.

    Attributes:
        shape: (H, W, K).
        mask: the picture of the first region, or None.
        rectangles: the other regions; if there is one region in all, they are parts of it.
    """

    shape: tuple[int, int, int]
    mask: Picture | None
    rectangles: list[Rectangle]
    dtype = np.dtype(np.float32)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        weights = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        if self.mask is not None:
            weights[..., 0] = self.mask.tile(rows.start, rows.stop, 0).pixels.mean(1)[0].clamp(0, 1)
        count = self.shape[2]
        for region, rectangle in enumerate(self.rectangles, start=count - len(self.rectangles)):
            weights[*_within(rectangle, rows), max(region, 0) if count > 1 else 0] = 1
        return weights


def _mask(job: Job, path: Path | None) -> Picture | None:
    """The picture of ``--mask``."""
    if path is None:
        return None
    stored = job.open(path)
    check_size(path, stored.shape[:2], job.size)
    return Picture(stored.rows, str(path))


def region_rows(
    job: Job, path: Path | None, regions: list[str] | None, alpha: Tensor
) -> tuple[RegionRows, Tensor] | None:
    """Regions and sliders (K, k+1), as :func:`slider_regions` has them; None where none is given."""
    picture = _mask(job, path)
    parsed = [with_sliders(text, job.size, alpha) for text in regions or []]
    sliders = ([] if picture is None else [alpha]) + [own for _, own in parsed]
    if not sliders:
        return None
    return RegionRows((*job.size, len(sliders)), picture, [rectangle for rectangle, _ in parsed]), torch.stack(sliders)


def selection_rows(job: Job, path: Path | None, regions: list[str] | None, option: str) -> RegionRows | None:
    """What :func:`selection` gives, by rows."""
    if path is None and not regions:
        return None
    return RegionRows((*job.size, 1), _mask(job, path), plain_rectangles(job.size, regions, option))


@dataclass(frozen=True)
class StrokeRows:
    """Strokes over a photograph: rows (h, W, 4) in RGB, the last channel above 0 where painted.

    Attributes:
        shape: (H, W, 4).
        painting: with transparency, or None.
        rectangles: over it, and their colours (3,).
    """

    shape: tuple[int, int, int]
    painting: Picture | None
    rectangles: list[tuple[Rectangle, Tensor]]
    dtype = np.dtype(np.float32)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        strokes = np.zeros((rows.stop - rows.start, *self.shape[1:]), self.dtype)
        if self.painting is not None:
            tile = self.painting.tile(rows.start, rows.stop, 0)
            strokes[..., :3] = tile.pixels[0].permute(1, 2, 0)  # a grey one gives its value to all three
            strokes[..., 3:] = transparency(tile, "float32")
        for rectangle, colour in self.rectangles:
            strokes[_within(rectangle, rows)] = [*colour, 1.0]
        return strokes


def stroke_rows(job: Job, path: Path | None, regions: list[str] | None) -> StrokeRows:
    """What :func:`colour_strokes` gives, by rows."""
    check_strokes(path, regions)
    picture = None
    if path is not None:
        stored = job.open(path)
        check_size(path, stored.shape[:2], job.size)
        if not stored.alpha:
            raise opaque(path)
        picture = Picture(stored.rows, str(path))
    return StrokeRows((*job.size, 4), picture, coloured_rectangles(job.size, regions))


def of_edit(step: Step, job: Job, given: Mapping[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """What :func:`nlfilter_torch.cli.scribbles.of_edit` gives, by rows."""
    if step.edit in ("recolor", "colorize"):
        keep = selection_rows(job, None, given.get("keep"), "--keep")
        strokes = stroke_rows(job, given.get("strokes"), given.get("region"))
        return (strokes, None), {} if keep is None else {"keep": keep}
    if step.edit == "defocus":
        focus = selection_rows(job, given.get("mask"), given.get("region"), "--region")
        if focus is None:
            raise unfocused()
        return (focus,), {}
    if step.edit != "detail":
        return (), {}
    found = region_rows(job, given.get("mask"), given.get("region"), torch.tensor(step["alpha"]))
    return ((), {}) if found is None else (found[:1], {"alpha": found[1]})
