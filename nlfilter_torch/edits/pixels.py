"""A set of pixels of a picture, and an edit as a function of such a set."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from nlfilter_torch.core.inner import Inner


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


Planes = Callable[[Any], Tensor]  # values (B, C, h, W) at given pixels


@dataclass(frozen=True, eq=False)
class Fitted:
    """An edit fitted to a picture, which can be applied to any of its pixels.

    Attributes:
        pixels: function that returns the edited pixels, or planes that ``finish`` takes.
        finish: function of the image, these planes and the part that is needed, which returns the edited image, for
            edits that depend on the neighbourhood of a pixel; values elsewhere may be any.
        margin: radius of this neighbourhood in pixels.
        step: period, in rows and in columns, of what ``finish`` does, counted from the first row and column that it is
            given; tiles begin at multiples of it, and ``margin`` is a multiple of it.
    """

    pixels: Planes
    finish: Callable[[Tensor, Tensor, Inner], Tensor] | None = None
    margin: int = 0
    step: int = 1
