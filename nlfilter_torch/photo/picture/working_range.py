"""The range that a picture uses."""

from dataclasses import dataclass

import torch
from torch import Tensor

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
