"""Division of an image into overlapping tiles, whose results are blended."""

from collections.abc import Callable
from functools import partial
from itertools import groupby, product

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import EVERYWHERE, Inner, reflected
from nlfilter_torch.core.workers import divided_among

SIDE, STEP = 96, 80  # size and spacing of tiles, in pixels
SMALLEST = 56  # size of the last tile of a row or column, at least
BORDER = 8  # width in pixels of the border added to images, so that their own border does not affect results
MOST_WORKERS = 8  # threads that compute tiles at once; each takes about 100 MB, and the others help them
TILE_BATCH = 4  # tiles processed at once; more leave the cache of the processor
Window = tuple[slice, slice]


def in_tiles(
    image: Tensor,
    noise: Tensor,
    function: Callable[[Tensor, Tensor], Tensor],
    inner: Inner = EVERYWHERE,
    *,
    workers: int = 1,
) -> Tensor:
    """Apply a function to an image (B, C, H, W) and its noise in overlapping tiles, or at once if the image is small.

    Tiles are ``STEP`` pixels apart, starting at the upper left corner. Their weights fall to 0 in the outermost pixels,
    so that borders of tiles are not visible. Only tiles that contain pixels of ``inner`` are computed. More than one of
    the ``workers`` compute several groups of tiles at once, each in its own thread and without gradients.
    """
    height, width = image.shape[-2:]
    down, across = _divided(height), _divided(width)
    padding = (BORDER, across[-1].stop - width - BORDER, BORDER, down[-1].stop - height - BORDER)
    image, noise = (_extended(planes, padding) for planes in (image, noise))
    rest = (..., slice(BORDER, BORDER + height), slice(BORDER, BORDER + width))
    if len(down) == len(across) == 1:
        return function(image, noise)[rest]
    groups = _grouped(_needed(down, inner[0], height), _needed(across, inner[1], width))
    computed = partial(_computed, function, image, noise)
    workers = min(workers, len(groups), MOST_WORKERS)
    total, weight = torch.zeros_like(image), image.new_zeros(image.shape[-2:])
    for group, result in zip(groups, divided_among(workers, computed, groups), strict=True):
        fade = torch.outer(*map(_profile, _size(group[0]))).to(image)
        for tile, part in zip(group, result.split(len(image)), strict=True):
            total[(..., *tile)] += fade * part
            weight[tile] += fade
    return total[rest] / weight[rest].clamp(min=torch.finfo(weight.dtype).tiny)


def _grouped(down: list[slice], across: list[slice]) -> list[list[Window]]:
    """The tiles in groups of equal size, which are computed together."""
    groups = []
    for _, windows in groupby(sorted(product(down, across), key=_size), key=_size):
        tiles = list(windows)
        groups += [tiles[first : first + TILE_BATCH] for first in range(0, len(tiles), TILE_BATCH)]
    return groups


def _computed(
    function: Callable[[Tensor, Tensor], Tensor], image: Tensor, noise: Tensor, group: list[Window]
) -> Tensor:
    """The function of a group of tiles, one after another along the first axis."""
    return function(*(torch.cat([planes[(..., *tile)] for tile in group]) for planes in (image, noise)))


def _divided(length: int) -> list[slice]:
    """Divide one axis of an image, extended by a border on both sides, into tiles; the last may be smaller."""
    length += 2 * BORDER
    last = max(0, -(-(length - SIDE) // STEP)) * STEP
    end = max(length, last + SMALLEST) if last else length
    return [slice(start, min(start + SIDE, end)) for start in range(0, last + 1, STEP)]


def _needed(tiles: list[slice], inner: slice, length: int) -> list[slice]:
    """Those of the tiles along one axis, extended by a border, that contain pixels of a part of it."""
    first, last, _ = inner.indices(length)
    return [tile for tile in tiles if tile.start < last + BORDER and first + BORDER < tile.stop]


def _size(tile: Window) -> tuple[int, int]:
    return tile[0].stop - tile[0].start, tile[1].stop - tile[1].start


def _profile(length: int) -> Tensor:
    """Weights along one axis of a tile: nearly 0 at the ends, rising to 1 within the overlap of tiles."""
    distance = torch.arange(length, dtype=torch.float64) + 0.5
    distance = torch.minimum(distance, length - distance)
    return ((distance - (SIDE - STEP) / 4) / ((SIDE - STEP) / 2)).clamp(1e-4, 1.0)


def _extended(planes: Tensor, padding: tuple[int, int, int, int]) -> Tensor:
    """Pad planes by reflection, repeatedly if they are narrower than the padding."""
    left, right, above, below = padding
    rows = reflected(torch.arange(-above, planes.shape[-2] + below), planes.shape[-2]).to(planes.device)
    columns = reflected(torch.arange(-left, planes.shape[-1] + right), planes.shape[-1]).to(planes.device)
    return planes[..., rows, :][..., columns]
