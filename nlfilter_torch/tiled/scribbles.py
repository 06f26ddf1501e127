"""The scribbled pixels of a picture that is read by rows: their colours and features."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.tiled.sampling import Report, Sample, patches_at, scaled_patches
from nlfilter_torch.tiled.sources import Picture, RowSource, Tile, transparency
from nlfilter_torch.tiled.tiles import Passes

Look = Callable[[Tensor], Tensor]  # colours (1, C, H, W) to the guide that is compared
Planes = Callable[[int, int], Tensor]  # of the rows from the first to before the second


class Guide(Picture):
    """The guide of a picture, which ``look`` computes from its colours."""

    def __init__(self, source: RowSource, name: str, look: Look) -> None:
        """Check ``source``; ``look`` maps the colours of each pixel independently."""
        super().__init__(source, name)
        self.look = look

    def tile(self, start: int, stop: int, margin: int) -> Tile:
        """A tile of the guide, as :meth:`Picture.tile`."""
        return self.seen(super().tile(start, stop, margin))

    def seen(self, tile: Tile) -> Tile:
        """The guide of a tile of the picture."""
        return Tile(tile.start, self.look(tile.pixels), tile.halo, tile.stored)


@dataclass(frozen=True)
class Painted:
    """Scribbled pixels.

    Attributes:
        places: their indices (n,) in row-major order, ascending.
        weights: (n,) in (0, 1].
        colours: (3, n), or none of them (0, n).
    """

    places: Tensor
    weights: Tensor
    colours: Tensor


def read_strokes(
    picture: Picture, strokes: RowSource, mask: RowSource | None, passes: Passes, *, name: str = "strokes"
) -> Painted:
    """Read the scribbles on a picture and their colours.

    Args:
        picture: below the scribbles.
        strokes: rows (H, W, 3), read under the mask only; or (H, W, 4), whose last channel is the mask.
        mask: rows (H, W) or (H, W, 1), or None.
        passes: with the memory that scribbled pixels may take.
        name: of the strokes, for messages.

    Raises:
        ValueError: if one of them has another size or another number of channels, a weight exceeds [0, 1], or all of
            them are 0.
        MemoryError: if there are too many scribbled pixels.
    """
    over = _overlay(picture, strokes, name)
    if over.samples != (4 if mask is None else 3):
        raise ValueError(
            f"{name} must have 3 channels and a stroke_mask, or 4 channels and none, got {over.samples} "
            f"{'without' if mask is None else 'with'} one; add or drop it"
        )

    def colours(start: int, stop: int) -> Tensor:
        return over.tile(start, stop, 0).pixels[0]

    def opacity(start: int, stop: int) -> Tensor:
        return torch.from_numpy(transparency(over.tile(start, stop, 0), "float32"))[..., 0]

    if mask is None:
        painted = _read(picture, opacity, colours, name, passes)
    else:
        painted = _read(picture, _weights(picture, mask, "stroke_mask"), colours, "stroke_mask", passes)
    if len(painted.places) == 0:
        raise ValueError(
            f"{name if mask is None else 'stroke_mask'} must hold a painted pixel, got none; paint at least one"
        )
    return painted


def read_mask(picture: Picture, mask: RowSource, name: str, passes: Passes) -> Painted:
    """Find the pixels where a mask, rows (H, W) or (H, W, 1), is above 0; raises as :func:`read_strokes`."""
    return _read(picture, _weights(picture, mask, name), None, name, passes)


def _weights(picture: Picture, mask: RowSource, name: str) -> Planes:
    over = _overlay(picture, mask, name)
    if over.samples != 1:
        raise ValueError(f"{name} must have 1 channel, got {over.samples}; select one")
    return lambda start, stop: over.tile(start, stop, 0).pixels[0, 0]


def _overlay(picture: Picture, rows: RowSource, name: str) -> Picture:
    """A source of rows of the same size as a picture."""
    if tuple(rows.shape[:2]) != picture.size:
        raise ValueError(
            f"{name} must have the height and width of {picture.name}, {picture.size[0]}x{picture.size[1]}, got "
            f"{'x'.join(map(str, rows.shape[:2]))}; resize one"
        )
    return Picture(rows, name)


def _read(picture: Picture, weights: Planes, colours: Planes | None, name: str, passes: Passes) -> Painted:
    """The pixels whose weights (h, W) are above 0, and their colours out of (3, h, W)."""
    (height, width), step = picture.size, picture.statistics_rows
    places, found, shown, count = [], [], [], 0
    for start in range(0, height, step):
        passes.report("Reading strokes", start, height)
        stop = min(start + step, height)
        plane = weights(start, stop).flatten()
        if not bool(((plane >= 0) & (plane <= 1)).all()):
            raise ValueError(
                f"{name} must be in [0, 1], got values from {plane.min():g} to {plane.max():g}; clamp or scale it"
            )
        chosen = plane.nonzero().squeeze(1)
        count += len(chosen)
        check_room(picture, count, 0, passes.memory)
        places.append(chosen + start * width)
        found.append(plane[chosen].to(picture.dtype))
        if colours is not None and len(chosen):
            shown.append(colours(start, stop).flatten(1)[:, chosen].to(picture.dtype))
    return Painted(torch.cat(places), torch.cat(found), torch.cat(shown, dim=1) if shown else torch.empty(0, count))


def floats_of_painted(planes: int) -> int:
    """Floats per scribbled pixel with that many features, which exist twice while they are concatenated."""
    return 2 * planes + 40


def check_room(picture: Picture, count: int, planes: int, memory: int) -> None:
    """Raise MemoryError if that many scribbled pixels take more than ``memory`` bytes."""
    needed = count * floats_of_painted(planes) * (8 if picture.dtype == torch.float64 else 4)
    if needed > memory:
        raise MemoryError(
            f"the strokes on {picture.name} cover {count} pixels or more and need {needed / 1e6:.0f} MB of memory, but "
            f"{memory / 1e6:.0f} MB may be used; paint less, or allow more"
        )


def gather(
    picture: Picture,
    guide: Guide,
    kernel: Kernel,
    places: Tensor,
    weights: Tensor,
    image: Callable[[Tensor], Tensor],
    report: Report,
) -> Sample:
    """Scribbled pixels (n,), ascending, with their features and ``image`` of their colours, read from their rows."""
    size, (height, width), step = kernel.recipe.patch_weights.shape[0], picture.size, picture.statistics_rows
    patches, values = [], []
    for start in range(0, height, step):
        report("Comparing strokes", start, height)
        stop = min(start + step, height)
        first, last = torch.searchsorted(places, torch.tensor([start, stop]) * width).tolist()
        if first == last:
            continue
        chosen = places[first:last] - start * width
        tile = picture.tile(start, stop, size // 2)
        seen = guide.seen(tile)
        patches.append(patches_at(reduce_channels(seen.pixels, kernel.recipe.guide_channels), seen, chosen, size))
        values.append(image(tile.inner).flatten(2)[:, :, chosen])
    recipe = (kernel.recipe.patch_weights, kernel.recipe.photometric_bandwidth, kernel.recipe.spatial_bandwidth)
    features = scaled_patches(torch.cat(patches, dim=2), places, picture, *recipe)
    return Sample(features, torch.cat(values, dim=2), weights[None])
