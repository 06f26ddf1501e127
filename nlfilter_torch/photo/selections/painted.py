"""What is painted on a picture in colours: strokes on objects, and on their masks by hand, grouped by colour."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.colour import group_colours, region_means, split_luminance
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Source
from nlfilter_torch.photo.selections.by_hand import ByHand, check_drawn, opaque
from nlfilter_torch.photo.selections.hues import HueSamples, corrections
from nlfilter_torch.photo.selections.scribbled_colours import outwards
from nlfilter_torch.photo.selections.stray import without_strays


@dataclass(frozen=True, eq=False)
class Painted:
    """What is painted on a picture: strokes on objects, and on the mask by hand; there may be one of them only.

    Attributes:
        strokes: with their colours, or None.
        on_mask: likewise.
    """

    strokes: Scribbles | None
    on_mask: Scribbles | None

    @staticmethod
    def of(source: Source[M], drawn: Drawn[M], strokes: Scribbles | None = None) -> "Painted | None":
        """Read what is painted; None if nothing is left of what was added by hand.

        Images without any of it have colours that are not valid. ``strokes`` are known ones in place of painted ones.

        Raises:
            TypeError, ValueError: if it does not suit the picture, or there are no strokes and nothing is added.
        """
        mask, added = drawn.masks.get("stroke_mask"), drawn.masks.get("added")
        if drawn.colours is None:
            check_drawn(mask, added, "stroke_mask", strokes)
        on_mask = None
        if added is not None:
            on_mask = opaque(source, source.scribbles(None, added, "added", needed=False))
        if strokes is None and (added is None or mask is not None or drawn.colours is not None):
            strokes = source.scribbles(mask, drawn.colours, "stroke_mask", needed=added is None)
        painted = Painted(*(_if_any(scribbles) for scribbles in (strokes, on_mask)))
        return painted if painted.marks else None

    @property
    def marks(self) -> list[Scribbles]:
        """The strokes, and what is painted on the mask, as far as there are any."""
        return [scribbles for scribbles in (self.strokes, self.on_mask) if scribbles is not None]

    def grouped(self, size: tuple[int, int], matches: bool) -> tuple[Tensor, Tensor, "Groups"]:
        """Return the colours (B, K, 3), which of them are valid, (B, K), and the pixels of each.

        Colours are chroma, or RGB if their brightness counts.
        """
        marks = self.marks
        painted = torch.stack([drawn.painted for drawn in marks]).any(0)
        if not bool(painted.all()):  # means of nothing are undefined; these colours are not valid
            marks = [drawn.weighted(torch.where(painted.view(-1, 1, 1), drawn.weights, 1.0)) for drawn in marks]
        shown = torch.cat([drawn.shown for drawn in marks], dim=2).unsqueeze(2)
        weights = torch.cat([drawn.weights for drawn in marks], dim=2).unsqueeze(2)
        regions, colours, valid = group_colours(shown if matches else split_luminance(shown)[1], weights)
        parts = regions.squeeze(2).split([len(drawn.places) for drawn in marks], dim=2)
        weighted = [drawn.weighted(part) for drawn, part in zip(marks, parts, strict=True)]
        strokes = None if self.strokes is None else without_strays(weighted[0], size, of_one_colour=True)
        return colours, valid & painted.unsqueeze(1), Groups(strokes, None if self.on_mask is None else weighted[-1])


@dataclass(frozen=True, eq=False)
class Groups:
    """What is painted in each of K colours: the weights of strokes on objects, and on the mask, are (B, K, n)."""

    strokes: Scribbles | None
    on_mask: Scribbles | None

    @property
    def inside(self) -> list[Scribbles]:
        """The strokes of each colour on objects; none if there are no strokes."""
        if self.strokes is None:
            return []
        return [self.strokes.weighted(part) for part in self.strokes.weights.split(1, dim=1)]

    def means(self) -> tuple[Tensor, Tensor]:
        """Mean luminance (B, K, 1) and chroma (B, K, 3) of the picture under each colour.

        What is painted on the mask counts for colours without strokes on an object.
        """
        weights, images = list[Tensor](), list[Tensor]()
        if self.strokes is not None:
            weights.append(self.strokes.weights)
            images.append(self.strokes.image)
        if self.on_mask is not None:
            alone = 1.0 if not weights else (weights[0] <= 0).all(2, keepdim=True).to(weights[0])
            weights.append(self.on_mask.weights * alone)
            images.append(self.on_mask.image)
        counted, image = torch.cat(weights, dim=2).unsqueeze(2), torch.cat(images, dim=2).unsqueeze(2)
        luminance, chroma = (region_means(part, counted) for part in split_luminance(image))
        return luminance, chroma

    def corrected_by_hue(
        self, size: tuple[int, int], image: Tensor, masks: Tensor, shares: list[Tensor], kept: list[Scribbles]
    ) -> list[Tensor]:
        """:func:`corrections` (B, 2, h, w) of the share of each colour; none if there are no strokes on objects.

        Args:
            size: (H, W) of the picture.
            image: the reduced picture, (B, 3, h, w).
            masks: of the objects, (B, K, h, w).
            shares: of each colour, (B, 1, h, w).
            kept: strokes on what stays as it is, or none.
        """
        if self.strokes is None:
            return []
        colours, weights = outwards(self.strokes, size)
        opposed = outwards(kept[0], size) if kept else None
        samples = [HueSamples.of(colours, part) for part in weights.split(1, dim=1)]
        return [
            corrections(image, *parts, opposed) for parts in zip(masks.split(1, dim=1), shares, samples, strict=True)
        ]

    def by_hand(self, source: Source[M], removed: M | None) -> ByHand | None:
        """What is painted on the mask of each colour."""
        less = ByHand.of(source, None, removed, 1)
        if self.on_mask is None:
            return None if less is None else replace(less, count=len(self.inside))
        return ByHand(self.on_mask.weights.shape[1], self.on_mask.planes, None if less is None else less.removed)


def _if_any(scribbles: Scribbles | None) -> Scribbles | None:
    """Scribbles, or None if no weight of theirs is above 0."""
    return scribbles if scribbles is not None and bool(scribbles.painted.any()) else None
