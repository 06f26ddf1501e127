"""Pixels of a picture, the range in which an edit sees them, and an edit as a function of pixels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar, TypeVarTuple

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner, block_length

STRIP = 1 << 18  # pixels that a core computes at a time; with fewer, cores wait for each other if other programs run
#: Rectangles around objects: ``(left, top, right, bottom)`` in pixels for all regions, or a tensor (B, K, 4) for each.
Box = Sequence[float] | Tensor
Rest = TypeVarTuple("Rest")
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


class Block(Pixels, Protocol):
    """A block of rows of a picture, with a halo of rows around it, which functions of the block may see."""

    @property
    def pixels(self) -> Tensor:
        """(B, C, h, W), with the halo."""

    @property
    def inner(self) -> Inner:
        """Which of these are the block's own."""

    @property
    def weights(self) -> Tensor | None:
        """How much its own pixels count, (B or 1, 1, h, W) from 0 to 1; None is 1 each."""


def corner(pixels: Pixels) -> tuple[int, int]:
    """Return the row and column of the first pixel."""
    return divmod(pixels.first, pixels.width)


Planes = Callable[[Pixels], Tensor]  # values (B, C, h, W) at given pixels


def whole_image(pixels: Pixels) -> Tensor:
    """All channels of the picture."""
    return pixels.image


@dataclass(frozen=True, eq=False)
class LessMean:
    """Planes of a picture less their means (B, C, 1, 1)."""

    planes: Planes
    mean: Tensor

    def __call__(self, pixels: Pixels) -> Tensor:
        """The planes at given pixels."""
        return self.planes(pixels) - self.mean


def part_of(planes: Tensor) -> Planes:
    """Function that returns the part of planes (B, ..., H, W) of a picture at given pixels."""
    return partial(_part, planes)


def _part(planes: Tensor, pixels: Pixels) -> Tensor:
    (top, left), (height, width) = corner(pixels), pixels.image.shape[-2:]
    return planes[..., top : top + height, left : left + width]


def ends_of(values: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Least and largest values (B, C, 1, 1) of planes (B, C, H, W) where weights (B or 1, 1, H, W) are not 0."""
    least, most = values, values
    if weights is not None:
        least, most = (torch.where(weights > 0, values, end) for end in (torch.inf, -torch.inf))
    return least.amin((2, 3), keepdim=True), most.amax((2, 3), keepdim=True)


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


BEYOND = 1.0  # distance from the range, in multiples of it, from which on values are not looked at


@dataclass(frozen=True, eq=False)
class WorkingRange:
    """The range that pictures use.

    Attributes:
        low: (B, 1, 1, 1), seen as 0.
        high: (B, 1, 1, 1), seen as 1.
        stretched: (B, 1, 1, 1), whether the picture is seen in this range; the others are seen as they are.
    """

    low: Tensor
    high: Tensor
    stretched: Tensor

    @property
    def black(self) -> Tensor:
        """What is 0 in a picture as edits see it, (B, 1, 1, 1), in its own units."""
        return torch.where(self.stretched, self.low, 0.0)

    @property
    def span(self) -> Tensor:
        """What is 1 in a picture as edits see it, (B, 1, 1, 1), in its own units."""
        return torch.where(self.stretched, self.high - self.low, 1.0)

    def seen(self, image: Tensor) -> Tensor:
        """An image (B, C, H, W) as edits see it."""
        relative = ((image - self.low) / (self.high - self.low)).clamp(-BEYOND, 1 + BEYOND)
        return torch.where(self.stretched, relative, image)

    def edited(self, image: Tensor, result: Tensor) -> Tensor:
        """The edited image, from its result (B, C, H, W) for :meth:`seen`.

        Where that equals what was seen, the image stays bit for bit.
        """
        return torch.where(self.stretched, image + (result - self.seen(image)) * self.span, result)

    def described(self, share: float) -> str:
        """A share of the range of a single picture, in grey levels of 255 or, if the range is large, in its values."""
        span = float(self.high - self.low)
        size = f"{share * span:.4g} (in values of the file)" if span > 1 else f"{255 * share * span:.2g} grey levels"
        return f"{size}, {100 * share:.2g} % of the range in use"


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
        working: the range in which ``pixels`` and ``finish`` see the picture, or None if they see it as it is.
        gives_picture: whether the result is a picture in that range; otherwise it is a mask.
        opacity: share of the result in the output, the rest of which is the picture.
    """

    pixels: Planes
    finish: Callable[[Tensor, Tensor, Inner], Tensor] | None = None
    margin: int = 0
    step: int = 1
    repaired: Callable[[Tensor, Tensor], Tensor] | None = None
    working: WorkingRange | None = None
    gives_picture: bool = True
    opacity: float = 1.0

    def then(self, function: Callable[[Tensor, Tensor, *Rest], Tensor], *arguments: *Rest) -> "Fitted":
        """Apply a pointwise function of the image and of the result, which takes further arguments."""
        finish = self.finish
        if finish is None:
            return replace(self, pixels=lambda pixels: function(pixels.image, self.pixels(pixels), *arguments))
        return replace(
            self, finish=lambda image, planes, inner: function(image, finish(image, planes, inner), *arguments)
        )

    def output(self, image: Tensor, result: Tensor) -> Tensor:
        """What leaves the edit, in the units of the picture: from pixels of it and the result for them as seen."""
        edited = result
        if self.working is not None and self.gives_picture:
            before = image if self.repaired is None else self.repaired(image, self.working.span)
            edited = self.working.edited(before, result)
        return mixed(image, edited, self.opacity)


def mixed(image: Tensor, edited: Tensor, opacity: float) -> Tensor:
    """An edited image, mixed with the one before it."""
    return edited if opacity == 1 else torch.lerp(image.to(edited.dtype), edited, opacity)
