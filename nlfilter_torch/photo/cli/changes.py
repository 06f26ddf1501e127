"""How much an edit changes a photograph, and the map of what it estimates."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.photo.cli.options import LEVELS
from nlfilter_torch.photo.declared.rows import WHITE, is_hidden
from nlfilter_torch.photo.files.formats import Depth
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.tiles import Tiling

MAP_DEPTH: Depth = "uint16"
ROWS, AROUND = 256, 2  # rows of the photograph that are read at once, and additional rows on both sides


class ChangeMeter:
    """Measures how much an edit changes the pixels of a photograph, in grey levels (RMS)."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0

    def add(self, difference: tuple[float, int]) -> None:
        """Add the difference of some pixels, from :func:`squared_difference`."""
        self._squares += difference[0]
        self._count += difference[1]

    def watched(self, tiling: Tiling) -> Tiling:
        """Edited rows whose differences are added as they are computed."""
        return replace(tiling, compare=squared_difference, compared=self.add)

    @property
    def change(self) -> float:
        """The change of the pixels that were added."""
        return LEVELS * (self._squares / max(self._count, 1)) ** 0.5


def write_map(map_of: Callable[[Tensor], Tensor], rows: Rows, path: Path) -> None:
    """Write what a function computes from a photograph as a picture, at :data:`MAP_DEPTH`.

    The function depends on :data:`AROUND` pixels around each.
    """
    parts = []
    for start in range(0, rows.size[0], ROWS):
        stop = min(start + ROWS, rows.size[0])
        first, last = max(start - AROUND, 0), min(stop + AROUND, rows.size[0])
        planes = map_of(rows.read(slice(first, last)).float())
        parts.append(planes[..., start - first : stop - first, :])
    write_photograph(Photograph(torch.cat(parts, dim=2), MAP_DEPTH), path)


def squared_difference(before: NDArray[np.generic], after: NDArray[np.generic]) -> tuple[float, int]:
    """Sum of the squared differences of the colours of stored rows (h, W, S), and the number of values.

    Pixels that are hidden by the transparency before do not count.
    """
    colours = 3 if after.shape[2] >= 3 else 1
    if before.shape[2] in (2, 4):
        visible = ~is_hidden(before)
        before, after = before[visible], after[visible]
    difference = _scaled(after[..., :colours]) - _scaled(before[..., :colours])
    return float(np.square(difference, dtype=np.float64).sum()), difference.size


def _scaled(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    scaled: NDArray[np.float32] = rows.astype(np.float32) / np.float32(WHITE.get(rows.dtype.name, 1))
    return scaled
