"""What ``nlfilter-torch denoise`` says: the noise that it found, and how much it changed."""

import numpy as np
import typer
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.cli.options import LEVELS
from nlfilter_torch.edits.denoise import QUIET
from nlfilter_torch.tiled.sources import WHITE, Rows, RowSource

VISIBLE = 0.5  # grey levels; eight bits round to as much


class NoiseReport:
    """Of one photograph, in grey levels.

    Args:
        level: of the noise, (1,) in units of the image.
        given: whether the user gave it.
    """

    def __init__(self, level: Tensor, *, given: bool) -> None:
        self._level, self._given = float(level), given
        self._squares, self._count = 0.0, 0

    def add(self, before: NDArray[np.generic], after: NDArray[np.generic]) -> None:
        """Count what some rows (h, W, S) were and are, each as it is stored."""
        difference = _scaled(after) - _scaled(before)
        self._squares += float(np.square(difference, dtype=np.float64).sum())
        self._count += difference.size

    def watched(self, rows: Rows, source: RowSource) -> Rows:
        """Rows that are edited, counted on their way; what was found and done is printed after the last."""
        for part, values in rows:
            colours = 3 if values.shape[2] >= 3 else 1  # the rest is transparency
            before = np.asarray(source[part]).reshape(values.shape)
            self.add(before[..., :colours], values[..., :colours])
            yield part, values
        self.tell()

    def tell(self) -> None:
        """Print it."""
        level, change = LEVELS * self._level, LEVELS * (self._squares / max(self._count, 1)) ** 0.5
        found = f"denoise: noise of {level:.2f} grey levels {'given' if self._given else 'found'}"
        if self._level < QUIET:
            typer.echo(f"{found}, less than {LEVELS * QUIET:.1f}: nothing to do, all pixels are as they were")
            return
        weak = "" if change >= VISIBLE else ", which is hardly visible"
        remedy = "" if self._given or not weak else "; --noise-level takes more away"
        typer.echo(f"{found}; pixels changed by {change:.2f} grey levels (root mean square){weak}{remedy}")


def _scaled(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    scaled: NDArray[np.float32] = rows.astype(np.float32) / np.float32(WHITE.get(rows.dtype.name, 1))
    return scaled
