"""Scribbled pixels of a picture."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.pixels import Pixels, corner


@dataclass(frozen=True, eq=False)
class Scribbles:
    """Scribbled pixels of a picture, or of a batch of them.

    Attributes:
        places: row-major indices (n,), ascending, of the pixels that are scribbled on in at least one image.
        weights: (B, K, n) in [0, 1], for K regions.
        image: colours of the picture at these pixels, (B, C, n).
        colours: colours of the scribbles, (B, 3, n), or None.
    """

    places: Tensor
    weights: Tensor
    image: Tensor
    colours: Tensor | None = None

    @property
    def shown(self) -> Tensor:
        """The colours of the scribbles.

        Raises:
            TypeError: if they have none.
        """
        if self.colours is None:
            raise TypeError("strokes must be a torch.Tensor, got NoneType; pass the colours of the scribbles")
        return self.colours

    @property
    def painted(self) -> Tensor:
        """Which images have any scribbles, (B,)."""
        return (self.weights.detach() > 0).flatten(1).any(1)

    def joined(self, other: "Scribbles") -> "Scribbles":
        """Append the regions of other scribbles; where both cover a pixel, the other scribbles have weight 0."""
        places, back = torch.cat([self.places, other.places]).unique(return_inverse=True)
        own, others = back.split([len(self.places), len(other.places)])
        shape = (len(self.weights), self.weights.shape[1] + other.weights.shape[1], len(places))
        count = self.weights.shape[1]
        weights = self.weights.new_zeros(shape)
        weights[:, count:, others] = other.weights.to(weights)
        free = torch.ones_like(weights[:, :1])
        free[:, :, own] = (self.weights.sum(1, keepdim=True) == 0).to(free)
        weights = weights * free
        weights[:, :count, own] = self.weights
        image = self.image.new_zeros(*self.image.shape[:2], len(places))
        image[:, :, others], image[:, :, own] = other.image, self.image
        return Scribbles(places, weights, image)

    def weighted(self, weights: Tensor) -> "Scribbles":
        """Replace the weights by others, (B, K, n)."""
        return replace(self, weights=weights)

    def weighted_by(self, weights: Tensor) -> "Scribbles":
        """The scribbles on pixels with weights (n,), without those of weight 0."""
        kept = weights > 0
        return replace(
            self,
            places=self.places[kept],
            weights=(self.weights * weights.to(self.weights))[..., kept],
            image=self.image[..., kept],
            colours=None if self.colours is None else self.colours[..., kept],
        )

    def repainted(self, planes: Tensor, image: Tensor) -> "Scribbles":
        """Scribbles of weights (B, K, H, W) on all of an image (B, C, H, W), which these are on, too."""
        marked = (planes.detach() > 0).flatten(2).any(0).any(0)
        marked[self.places] = True  # pixels of weight 0 matter to the derivative by the weights
        places = marked.nonzero().squeeze(1)
        return Scribbles(places, planes.flatten(2)[..., places], image.flatten(2)[..., places])

    def planes(self, pixels: Pixels) -> Tensor:
        """Return the weights (B, K, h, w) at some pixels of the picture."""
        height, width = pixels.image.shape[-2:]
        top, left = corner(pixels)
        ends = torch.tensor([top, top + height]).to(self.places) * pixels.width
        first, last = torch.searchsorted(self.places, ends).tolist()
        places, weights = self.places[first:last], self.weights[:, :, first:last]
        columns = places % pixels.width - left
        if width < pixels.width:
            inside = (columns >= 0) & (columns < width)
            places, weights, columns = places[inside], weights[:, :, inside], columns[inside]
        planes = self.weights.new_zeros(*self.weights.shape[:2], height * width)
        planes[:, :, (places // pixels.width - top) * width + columns] = weights
        return planes.unflatten(2, (height, width))


def scribbled_blocks(
    known: Sequence[tuple[Callable[[], Iterable[Tensor]], Tensor, Tensor]],
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield columns (B, M, n), weights (B, 1, n) and values (B, C, n) of pixels, block by block, for a regression.

    Each set of pixels is a function that returns the blocks of its columns, and the weights and values of all of it.
    """
    for columns, weights, values in known:
        first = 0
        for block in columns():
            part = slice(first, first + block.shape[2])
            yield block, weights[:, :, part], values[:, :, part]
            first = part.stop


Size = tuple[int, int]


def blocks_at(places: Tensor, size: Size, shape: Size) -> Tensor:
    """Row-major indices (n,) of the blocks that pixels of a picture belong to, by their middles.

    Args:
        places: row-major indices (n,) of the pixels.
        size: (H, W) of the picture.
        shape: numbers of rows and columns of blocks, which are equal.
    """
    row, column = (
        ((2 * part + 1) * count) // (2 * length)
        for part, count, length in zip((places // size[1], places % size[1]), shape, size, strict=True)
    )
    return row * shape[1] + column


def middles_of(chosen: Tensor, size: Size) -> Tensor:
    """Row-major indices (n,) of the pixels of a picture (H, W) in the middle of blocks that are chosen, (h, w) of bool.

    >>> middles_of(torch.tensor([[False, True]]), (3, 6))
    tensor([10])
    """
    rows, columns = (
        (2 * part + 1) * length // (2 * count)
        for part, length, count in zip(chosen.nonzero().unbind(1), size, chosen.shape, strict=True)
    )
    return rows * size[1] + columns


def parts_in_blocks(places: Tensor, size: Size, shape: Size) -> list[tuple[Tensor, Tensor]]:
    """Blocks (n,) that pixels lie in, and the parts (n,) in float64 of the pixels that do.

    There are four if pixels may lie on borders of blocks, else one. The arguments are those of :func:`blocks_at`.
    """
    axes = []
    for part, count, length in zip((places // size[1], places % size[1]), shape, size, strict=True):
        first, last = part * count // length, ((part + 1) * count - 1) // length
        beyond = ((part + 1) * count - last * length).double() / count  # of a pixel, in the last of its blocks
        beyond = torch.where(first == last, 0.0, beyond)
        axes.append([(first, 1 - beyond)] + ([] if length % count == 0 else [(last, beyond)]))
    rows, columns = axes
    return [(row * shape[1] + column, down * across) for row, down in rows for column, across in columns]


def sums_in_blocks(values: Tensor, places: Tensor, size: Size, shape: Size) -> Tensor:
    """Sums (B, C, h, w) over blocks of values (B, C, n) at pixels; the other arguments are those of :func:`blocks_at`.

    The value of a pixel on the border of blocks counts in each by the part of the pixel that lies in it.
    """
    sums = values.new_zeros(*values.shape[:2], shape[0] * shape[1])
    for block, part in parts_in_blocks(places, size, shape):
        sums = sums.index_add(2, block, values * part.to(values))
    return sums.unflatten(2, shape)
