"""The strokes of a step, rasterised a few rows at a time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from nlfilter_torch.edits.applying import scribbles_of
from nlfilter_torch.edits.scribbles import Stroke, mask_of, paint
from nlfilter_torch.edits.steps import Step

Floats = NDArray[np.float32]
CHUNK_ROWS = 64  # rows read at once


@dataclass(frozen=True)
class CoveredRows:
    """The mask of strokes over a picture: rows (h, W, 1) of zeros and ones.

    Attributes:
        strokes: with any paint.
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
        """Whether the strokes cover a pixel."""
        starts = range(0, self.size[0], CHUNK_ROWS)
        return any(self[start : min(start + CHUNK_ROWS, self.size[0])].any() for start in starts)

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


def strokes_by_rows(step: Step, size: tuple[int, int]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The strokes of a step as in :func:`scribbles_of`, as sources of rows."""
    return scribbles_of(step, size, lambda strokes, size: (ColouredRows(strokes, size), None), CoveredRows)
