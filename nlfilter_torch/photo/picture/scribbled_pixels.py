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


def sums_in_blocks(values: Tensor, places: Tensor, width: int, step: float, shape: tuple[int, int]) -> Tensor:
    """Sums (B, C, h, w) over square blocks of values (B, C, n) at pixels with row-major indices (n,).

    Args:
        values: to add.
        places: indices in a picture of that width.
        width: of the picture, in pixels.
        step: side of a block, in pixels.
        shape: numbers of rows and columns of blocks.
    """
    blocks = blocks_at(places, width, step, shape)
    return values.new_zeros(*values.shape[:2], shape[0] * shape[1]).index_add(2, blocks, values).unflatten(2, shape)


def blocks_at(places: Tensor, width: int, step: float, shape: tuple[int, int]) -> Tensor:
    """Row-major indices (n,) of the blocks of pixels; the arguments are those of :func:`sums_in_blocks`."""
    rows, columns = (part.double() / step for part in (places // width, places % width))
    return rows.long() * shape[1] + columns.long()
