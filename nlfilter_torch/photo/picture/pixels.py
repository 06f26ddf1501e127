"""A set of pixels of a picture, and an edit as a function of such a set."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import block_length
from nlfilter_torch.core.inner import Inner

STRIP = 1 << 18  # pixels that a core computes at a time; with fewer, cores wait for each other if other programs run
M = TypeVar("M")  # masks and colours of pixels as a source takes them: tensors in memory, rows in tiles


class Pixels(Protocol):
    """A set of pixels of a picture: all of them, some rows, or a rectangle."""

    @property
    def image(self) -> Tensor:
        """(B, C, h, W)."""

    @property
    def first(self) -> int:
        """Row-major index of the first pixel in the picture."""

    @property
    def width(self) -> int:
        """W of the picture."""


def corner(pixels: Pixels) -> tuple[int, int]:
    """Return the row and column of the first pixel."""
    return divmod(pixels.first, pixels.width)


Planes = Callable[[Pixels], Tensor]  # values (B, C, h, W) at given pixels


def whole_image(pixels: Pixels) -> Tensor:
    """All channels of the picture."""
    return pixels.image


def part_of(planes: Tensor) -> Planes:
    """Function that returns the part of planes (B, ..., H, W) of a picture at given pixels."""

    def part(pixels: Pixels) -> Tensor:
        (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
        return planes[..., top : top + height, left : left + width]

    return part


@dataclass(frozen=True, eq=False)
class Strip:
    """Some rows of a picture in memory."""

    image: Tensor
    first: int
    width: int


def strips_of(pixels: Pixels) -> list[Pixels]:
    """Divide a picture into strips: pointwise work on megapixels is several times faster if its temporaries are cached.

    A small one is not divided, nor one that is being compiled, since the compiler does this.
    """
    image, rows = pixels.image, _rows_at_once(pixels.image)
    if rows >= image.shape[2]:
        return [pixels]
    parts = image.split(rows, dim=2)
    return [Strip(part, i * rows * pixels.width, pixels.width) for i, part in enumerate(parts)]


def _rows_at_once(image: Tensor) -> int:
    if torch.compiler.is_compiling():
        return image.shape[2]
    return max(1, block_length(len(image), image.device, STRIP) // image.shape[3])


@dataclass(frozen=True, eq=False)
class Fitted:
    """An edit fitted to a picture, which can be applied to any of its pixels.

    Attributes:
        pixels: function that returns the edited pixels, or planes that ``finish`` takes.
        finish: function of the image, these planes and the part that is needed, which returns the edited image, for
            edits that depend on the neighbourhood of a pixel; outside that part, the values it returns are not used.
        margin: radius of this neighbourhood in pixels.
        step: period, in rows and in columns, of what ``finish`` does, counted from the first row and column that it is
            given; tiles begin at multiples of it, and ``margin`` is a multiple of it.
        repaired: function of the image, and of what is 1 for the edit in its units, (B, 1, 1, 1), that replaces defects
            which ``finish`` does not see as far from others as they are; None for edits that replace none.
    """

    pixels: Planes
    finish: Callable[[Tensor, Tensor, Inner], Tensor] | None = None
    margin: int = 0
    step: int = 1
    repaired: Callable[[Tensor, Tensor], Tensor] | None = None

    def then(self, function: Callable[[Tensor, Tensor], Tensor]) -> "Fitted":
        """Apply a pointwise function of the image and of the result."""
        finish = self.finish
        if finish is None:
            return Fitted(lambda pixels: function(pixels.image, self.pixels(pixels)))
        return replace(self, finish=lambda image, planes, inner: function(image, finish(image, planes, inner)))
