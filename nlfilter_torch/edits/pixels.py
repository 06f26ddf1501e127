"""Some pixels of a picture, and what an edit makes of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor


class Pixels(Protocol):
    """Some pixels of a picture: all of them, some of its rows, or a rectangle."""

    @property
    def image(self) -> Tensor:
        """(B, C, h, W)."""

    @property
    def first(self) -> int:
        """Number of the first one, along the rows of the picture."""

    @property
    def width(self) -> int:
        """W of the picture."""


def corner(pixels: Pixels) -> tuple[int, int]:
    """Row and column of the first one."""
    return divmod(pixels.first, pixels.width)


Planes = Callable[[Any], Tensor]  # of some pixels, (B, C, h, W)


@dataclass(frozen=True, eq=False)
class Fitted:
    """What an edit does to any pixels of a picture that it was fitted to.

    Attributes:
        pixels: the edited pixels, or planes that ``finish`` makes these from.
        finish: from the image and these planes to the edited image, where that takes the pixels around a pixel.
        margin: how many.
        step: what ``finish`` does depends on the number of a row modulo so many, counted from the first it is given;
            tiles begin at multiples of it, and so does ``margin``. Likewise for columns.
    """

    pixels: Planes
    finish: Callable[[Tensor, Tensor], Tensor] | None = None
    margin: int = 0
    step: int = 1
