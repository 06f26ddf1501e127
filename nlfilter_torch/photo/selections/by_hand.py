"""What is painted on masks by hand: a brush sets them to 1, an eraser to 0, whatever is computed."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.pixels import M, Pixels, Planes
from nlfilter_torch.photo.picture.regions import num_regions, region_weights
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Source, at
from nlfilter_torch.photo.selections.scribbled_colours import EPSILON


@dataclass(frozen=True, eq=False)
class ByHand:
    """What is added to the masks of K regions, and removed from them, as weights from 0 to 1.

    What is added to one region is removed from the others, unless it is added to them, too.

    Attributes:
        count: K.
        added: weights (B, K, h, w) of given pixels, or None.
        removed: weights (B, 1 or K, h, w) of given pixels, or None; these take precedence.
    """

    count: int
    added: Planes | None
    removed: Planes | None

    @staticmethod
    def of(source: Source[M], added: M | None, removed: M | None, count: int | None = None) -> "ByHand | None":
        """Read what is painted on the masks of ``count`` regions, by default as many as are added to; None if nothing.

        Raises:
            ValueError: if a mask does not fit the picture or the number of regions.
        """
        if added is None and removed is None:
            return None
        more, of_added = _planes_of(source, added, "added")
        less, of_removed = _planes_of(source, removed, "removed")
        count = of_added if count is None else count
        if of_added not in (0, count):
            raise ValueError(
                f"added must have a channel for each of the {count} regions, got {of_added}; add or drop some"
            )
        if of_removed not in (0, 1, count):
            raise ValueError(
                f"removed must have 1 channel or one for each of the {count} regions, got {of_removed}; add or drop "
                "some"
            )
        return ByHand(count, more, less)

    def over(self, masks: Tensor, pixels: Pixels) -> Tensor:
        """Masks (B, K, h, w) of the given pixels, with what is painted over them."""
        added, removed = self._weights(masks, pixels)
        return masks * (1 - added - removed) + added

    def parts(self, masks: Tensor, pixels: Pixels) -> Tensor:
        """Parts (B, K + 2, h, w) of the given pixels, which sum to 1.

        They are what is painted and belongs to each region, what is painted and belongs to none, and what is not
        painted. Masks (B, K, h, w) count where only some of the regions are removed.
        """
        added, removed = self._weights(masks, pixels)
        painted = (added + removed).amax(1, keepdim=True)
        inside = masks * (painted - added - removed) + added
        total = inside.sum(1, keepdim=True)
        inside = inside * torch.where(total > painted, painted / torch.where(total > painted, total, 1.0), 1.0)
        return torch.cat([inside, painted - inside.sum(1, keepdim=True), 1 - painted], dim=1)

    def _weights(self, masks: Tensor, pixels: Pixels) -> tuple[Tensor, Tensor]:
        """What is added to masks and removed from them, like them (B, K, h, w); the sum is at most 1."""
        added, removed = (
            torch.zeros_like(masks) if planes is None else planes(pixels).to(masks)
            for planes in (self.added, self.removed)
        )
        if masks.shape[1] > 1:
            others = [_without(added, k).amax(1, keepdim=True) for k in range(masks.shape[1])]
            removed = removed.maximum(torch.cat(others, dim=1) * (1 - added))
        return added.minimum(1 - removed), removed


def _planes_of(source: Source[M], masks: M | None, name: str) -> tuple[Planes | None, int]:
    """What is painted on masks, and the number of their regions; None and 0 if there are none."""
    return (None, 0) if masks is None else (region_weights(source, masks, name), num_regions(source, masks, name))


def check_drawn(scribbles: object, added: object, name: str, box: object = None) -> None:
    """Raise TypeError if there are no scribbles, which errors call ``name``, no box, and nothing is added by hand."""
    if scribbles is None and added is None and box is None:
        raise TypeError(f"{name} must be a torch.Tensor, got NoneType; paint some, or pass box or added")


def opaque(source: Source[M], painted: Scribbles) -> Scribbles:
    """Weights as they were painted, without the opacity of the picture under them, by which sources multiply them."""
    _, opacity = at(source, painted.places)
    if opacity is None:
        return painted
    return painted.weighted((painted.weights / opacity.to(painted.weights).clamp(min=EPSILON)).clamp(max=1.0))


def _without(planes: Tensor, number: int) -> Tensor:
    """Planes (B, K, h, w) without the one with that number."""
    return torch.cat([planes[:, :number], planes[:, number + 1 :]], dim=1)
