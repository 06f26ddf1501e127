"""What is painted on masks by hand: a brush sets them to 1, an eraser to 0, whatever is computed."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.drawn import M
from nlfilter_torch.photo.picture.pixels import Pixels
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Source

EPSILON = 1e-6


@dataclass(frozen=True, eq=False)
class ByHand:
    """What is added to the masks of K regions, and removed from them, as weights from 0 to 1.

    What is added to one region is removed from the others, unless it is added to them, too.

    Attributes:
        added: for each region.
        removed: for none, for all of them or for each; it takes precedence.
    """

    added: list[Scribbles]
    removed: list[Scribbles]

    @staticmethod
    def of(source: Source[M], added: M | None, removed: M | None, count: int | None = None) -> "ByHand | None":
        """Read what is painted on the masks of ``count`` regions, by default as many as are added to; None if nothing.

        Raises:
            ValueError: if a mask does not fit the picture or the number of regions.
        """
        if added is None and removed is None:
            return None
        more = [] if added is None else source.regions(added, "added", needed=False)
        less = [] if removed is None else source.regions(removed, "removed", needed=False)
        count = len(more) if count is None else count
        if len(more) not in (0, count):
            raise ValueError(
                f"added must have a channel for each of the {count} regions, got {len(more)}; add or drop some"
            )
        if len(less) not in (0, 1, count):
            raise ValueError(
                f"removed must have 1 channel or one for each of the {count} regions, got {len(less)}; add or drop some"
            )
        return ByHand([opaque(source, part) for part in more], [opaque(source, part) for part in less])

    def over(self, masks: Tensor, pixels: Pixels) -> Tensor:
        """Masks (B, K, h, w) of the given pixels, with what is painted over them."""
        added, removed = (_planes(parts, pixels, masks) for parts in (self.added, self.removed))
        if masks.shape[1] > 1:
            others = [_without(added, k).amax(1, keepdim=True) for k in range(masks.shape[1])]
            removed = removed.maximum(torch.cat(others, dim=1) * (1 - added))
        added = added.minimum(1 - removed)
        return masks * (1 - added - removed) + added


def opaque(source: Source[M], painted: Scribbles) -> Scribbles:
    """Weights as they were painted, without the opacity of the picture under them, by which sources multiply them."""
    opacity = source.weights_at(painted.places)
    if opacity is None:
        return painted
    return painted.weighted((painted.weights / opacity.to(painted.weights).clamp(min=EPSILON)).clamp(max=1.0))


def _planes(parts: list[Scribbles], pixels: Pixels, masks: Tensor) -> Tensor:
    """Weights (B, K or 1, h, w) at some pixels, in the precision of the masks."""
    if not parts:
        return torch.zeros_like(masks)
    return torch.cat([part.planes(pixels) for part in parts], dim=1).to(masks)


def _without(planes: Tensor, number: int) -> Tensor:
    """Planes (B, K, h, w) without the one with that number."""
    return torch.cat([planes[:, :number], planes[:, number + 1 :]], dim=1)
