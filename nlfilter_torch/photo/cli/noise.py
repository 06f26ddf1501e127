"""The report of ``nlfilter-torch denoise``: the noise of the photograph, and how much it was changed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.nn.denoiser.noise import Noise
from nlfilter_torch.photo.cli.options import LEVELS
from nlfilter_torch.photo.edits.denoise import NEGLIGIBLE_NOISE
from nlfilter_torch.photo.io.photographs import Depth, Photograph, write_photograph
from nlfilter_torch.photo.tiled.pictures import WHITE
from nlfilter_torch.photo.tiled.tiles import Tiling

VISIBLE_LEVELS = 0.5  # grey levels; the rounding error of eight bits
WHITE_LEVELS = 64  # grey levels; white in a map
MAP_DEPTH: Depth = "uint16"
ROWS, AROUND = 256, 2  # rows of the photograph that are read at once, and additional rows on both sides


class NoiseReport:
    """Noise of a photograph, measured or ``given`` by the user, and how much denoising changed it, in grey levels."""

    def __init__(self, noise: Noise, *, given: bool, strength: float) -> None:
        self._level, self._given, self._strength = float(noise.level), given, strength
        ends = [float((noise.floor + light * noise.gain).sqrt()) for light in (0.0, 1.0)]
        self._ends = f" ({LEVELS * ends[0]:.2f} in black, {LEVELS * ends[1]:.2f} in white)" if noise.gain > 0 else ""
        self._squares, self._count = 0.0, 0

    def add(self, difference: tuple[float, int]) -> None:
        """Add the difference of some pixels, from :func:`squared_difference`."""
        self._squares += difference[0]
        self._count += difference[1]

    def watched(self, tiling: Tiling) -> Tiling:
        """Edited rows whose differences are added as they are computed."""
        return replace(tiling, compare=squared_difference, compared=self.add)

    def tell(self) -> None:
        """Print the report."""
        level, change = LEVELS * self._level, LEVELS * (self._squares / max(self._count, 1)) ** 0.5
        found = f"denoise: {'given' if self._given else 'estimated'} noise of {level:.2f} grey levels{self._ends}"
        if self._level < NEGLIGIBLE_NOISE:
            typer.echo(f"{found}, less than {LEVELS * NEGLIGIBLE_NOISE:.1f}; no pixel changed")
            return
        weak = "" if change >= VISIBLE_LEVELS else ", which is barely visible"
        remedy = "; --strength 2 removes more" if weak and not self._given and 0 < self._strength < 2 else ""
        typer.echo(f"{found}; pixels changed by {change:.2f} grey levels (RMS){weak}{remedy}")


def write_map(noise: Noise, size: tuple[int, int], read: Callable[[slice], Tensor], path: Path) -> None:
    """Write the standard deviation of the noise at every pixel of a photograph (H, W), at :data:`MAP_DEPTH`."""
    parts = []
    for start in range(0, size[0], ROWS):
        stop = min(start + ROWS, size[0])
        first, last = max(start - AROUND, 0), min(stop + AROUND, size[0])
        levels = noise.at(read(slice(first, last)).float())
        parts.append(levels.square().mean(1, keepdim=True).sqrt()[..., start - first : stop - first, :])
    levels = torch.cat(parts, dim=2) * (LEVELS / WHITE_LEVELS)
    write_photograph(Photograph(levels.clamp(0, 1), MAP_DEPTH), path)


def squared_difference(before: NDArray[np.generic], after: NDArray[np.generic]) -> tuple[float, int]:
    """Sum of the squared differences of stored rows (h, W, S) without their transparency, and the number of values."""
    colours = 3 if after.shape[2] >= 3 else 1
    difference = _scaled(after[..., :colours]) - _scaled(before[..., :colours])
    return float(np.square(difference, dtype=np.float64).sum()), difference.size


def _scaled(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    scaled: NDArray[np.float32] = rows.astype(np.float32) / np.float32(WHITE.get(rows.dtype.name, 1))
    return scaled
