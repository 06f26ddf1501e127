"""A whole edit, as the editor saves it, on a picture larger than memory: its steps in turn, in tiles of rows."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nlfilter_torch.edits.applying import fit_step, scribbles_of
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.scribbles import Stroke, mask_of, paint
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.tiled.intermediate import intermediate
from nlfilter_torch.tiled.source import Tiled
from nlfilter_torch.tiled.sources import Picture, Rows, RowSource
from nlfilter_torch.tiled.tiles import TILE_PIXELS, Passes
from nlfilter_torch.tiled.workers import undivided

Floats = NDArray[np.float32]
LOOKED_AT = 64  # rows read at once


@dataclass(frozen=True)
class CoveredRows:
    """The mask of strokes over a picture: rows (h, W, 1) of zeros and ones.

    Attributes:
        strokes: of any paint.
        size: (H, W).
    """

    strokes: Sequence[Stroke]
    size: tuple[int, int]
    dtype = np.dtype(np.float32)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 1)."""
        return (*self.size, 1)

    def any(self) -> bool:
        """Whether they cover a pixel."""
        starts = range(0, self.size[0], LOOKED_AT)
        return any(self[start : min(start + LOOKED_AT, self.size[0])].any() for start in starts)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        found: Floats = mask_of(self.strokes, self.size, rows)[0].permute(1, 2, 0).numpy()
        return found


@dataclass(frozen=True)
class ColouredRows(CoveredRows):
    """Coloured strokes over a picture: rows (h, W, 4) in RGB and their mask."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 4)."""
        return (*self.size, 4)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        found: Floats = torch.cat(paint(self.strokes, self.size, rows), dim=1)[0].permute(1, 2, 0).numpy()
        return found


def edit_rows(passes: Passes, source: RowSource, recipe: Recipe, name: str) -> Rows:
    """The rows (h, W, S) of the picture under :meth:`Recipe.apply`, in order.

    Args:
        passes: over the rows, of every step.
        source: as of :func:`stream_detail`.
        recipe: the edit.
        name: of the source, for error messages.

    Raises:
        ValueError: if a step needs the whole picture at once, or does not suit the picture.
        OSError: if the folder has no room.
    """
    picture = Picture(source, name)
    steps = recipe.acting
    with ExitStack() as stack:
        for step in steps[:-1]:
            rows = step_rows(step, replace(passes, kind="float32"), source, name)
            clipped = ((part, values.clip(0, 1)) for part, values in rows)
            source = stack.enter_context(intermediate(clipped, picture.size, passes.folder))
        if steps:
            yield from step_rows(steps[-1], passes, source, name)
        else:
            yield from passes.work_out(
                picture, lambda tile: tile.inner, 0, passes.tile_rows or max(1, TILE_PIXELS // picture.size[1])
            )


def step_rows(step: Step, passes: Passes, source: RowSource, name: str) -> Rows:
    """The rows that a step makes of a picture."""
    tiled = Tiled(Picture(source, name), passes)
    with undivided(passes.workers(1)):
        fitted = fit_step(step, tiled, *by_rows(step, tiled.size))
    yield from tiled.rows(fitted)


def by_rows(step: Step, size: tuple[int, int]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The strokes of a step as :func:`scribbles_of` has them, in rows."""
    return scribbles_of(step, size, lambda strokes, size: (ColouredRows(strokes, size), None), CoveredRows)
