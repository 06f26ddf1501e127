"""Photographs that no method, option or limit was chosen on, for figures that are reported."""

from pathlib import Path

import torch
from torch import Tensor

from benchmarks.photographs import kodak, photograph

NAMES = ("motorcycle", "immunohistochemistry", "coins")  # of scikit-image
NUMBERS = (1, 13, 19)  # of Kodak's photographs
PIECES = (2, 3, 7, 9, 14, 15, 17, 21, 22)  # of a large picture


def held_out(folder: Path | None) -> dict[str, Tensor]:
    """Three photographs (1, C, H, W) by name: scikit-image's, or Kodak's if their folder is told."""
    if folder is None:
        return {name: photograph(name) for name in NAMES}
    return {f"kodim{number:02d}": kodak(folder, number) for number in NUMBERS}


def large(folder: Path | None, side: int) -> Tensor:
    """A square picture (1, 3, side, side): a retina, or the middles of nine of Kodak's photographs."""
    if folder is None:
        return photograph("retina", side, side)
    length = -(-side // 3)
    pieces = []
    for number in PIECES:
        picture = kodak(folder, number)
        top, left = ((size - length) // 2 for size in picture.shape[-2:])
        pieces.append(picture[..., top : top + length, left : left + length])
    rows = [torch.cat(pieces[first : first + 3], dim=3) for first in (0, 3, 6)]
    return torch.cat(rows, dim=2)[..., :side, :side].contiguous()
