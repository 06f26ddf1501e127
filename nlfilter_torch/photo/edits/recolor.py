"""Recolouring of objects by strokes of colour. Paper: Sec. V-A, Figs. 14, 15."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.precision import squarable
from nlfilter_torch.operator.options import Completion, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import RECOLOR
from nlfilter_torch.photo.picture.colour import (
    dot,
    group_colours,
    merge_luminance,
    region_means,
    split_luminance,
)
from nlfilter_torch.photo.picture.drawn import Drawn, M
from nlfilter_torch.photo.picture.in_memory import edit_image
from nlfilter_torch.photo.picture.scribbled_pixels import Scribbles
from nlfilter_torch.photo.picture.source import Fitted, Pixels, Source
from nlfilter_torch.photo.selections.border_colours import Sides, colours_beside, refine_mask
from nlfilter_torch.photo.selections.mask import ObjectEdit, Regions, background_of, fit_regions
from nlfilter_torch.photo.selections.stray import without_strays

EPSILON = 1e-12  # keeps the derivative of a root finite
END_MARGIN = 0.1  # masks closer to 0 or 1 are set to 0 or 1: a faint tint far away is visible, a less soft edge is not
ROOM = 0.8  # share of the chroma at which a channel reaches 1 that the mean of an object may have
GREY_CHROMA = 0.05  # chroma below this counts as grey, without variations to keep


def recolor(
    image: Tensor,
    strokes: Tensor,
    stroke_mask: Tensor,
    *,
    keep: Tensor | None = None,
    reach: float | Tensor = RECOLOR.defaults["reach"],
    photometric_bandwidth: float | Tensor = RECOLOR.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = RECOLOR.defaults["patch_size"],
    num_landmarks: int = RECOLOR.defaults["num_landmarks"],
    landmarks: Sampling = RECOLOR.defaults["landmarks"],
    completion: Completion = "diagonal",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Recolour the objects that strokes are painted on, and similar pixels around them.

    Paper: Sec. V-A, with :func:`region_mask` in place of k-means, for any number of colours.

    Args:
        image: (B, 3, H, W), RGB in [0, 1].
        strokes: (B, 3, H, W), RGB, of which only hue and saturation are used. A saturation too strong for the
            luminance under a stroke is reduced for the whole region, so that its shading remains. Up to 16 colours are
            distinguished, each with its own region.
        stroke_mask: (B, 1, H, W) in [0, 1], above 0 where painted.
        keep: (B, 1, H, W) in [0, 1], background scribbles, above 0 on pixels that stay unchanged together with similar
            ones. Strokes take precedence over it.
        reach: in [0, 1), probability that a walk over similar pixels continues after each step; larger includes less
            similar pixels.
        photometric_bandwidth: in hundredths of Lab: 0.08 is 8 units.
        spatial_bandwidth: in pixels; None is 1.2 of the short side, ``math.inf`` no limit.
        patch_size: width of the compared patches.
        num_landmarks: M of the filter.
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        generator: source of randomness for the landmarks; None draws the same for every call.

    Returns:
        (B, 3, H, W), with the luminance of ``image``, and equal to it where a pixel is similar to no stroke.
        Differentiable in image, strokes, mask and parameters, at a fixed grouping of the colours.

    Raises:
        TypeError, ValueError: if a tensor has another size, a mask leaves [0, 1], nothing is painted, or ``keep`` is
            painted only under the strokes in some image.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[:, 0, :, 12:] += 0.6  # the right half is reddish
        >>> strokes, painted = torch.zeros(1, 3, 24, 24), torch.zeros(1, 1, 24, 24)
        >>> strokes[:, 2], painted[..., 8:12, 16:20] = 1.0, 1.0  # blue, in its midst
        >>> blue = recolor(image, strokes, painted, num_landmarks=50)
        >>> torch.equal(blue[..., :8], image[..., :8]), bool((blue[:, 2] > blue[:, 0])[..., 14:].all())
        (True, True)
    """
    edit = Recolor(
        reach=reach,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        num_landmarks=num_landmarks,
        landmarks=landmarks,
        completion=completion,
        generator=generator,
    )
    masks = {"stroke_mask": stroke_mask} | ({} if keep is None else {"keep": keep})
    return edit_image(edit, image, Drawn(masks, strokes), channels=3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recolor(ObjectEdit):
    """The edit of :func:`recolor`."""

    declared: ClassVar[Edit] = RECOLOR

    def check_channels(self, channels: int) -> None:
        """Raise ValueError for a grey photograph."""
        if channels < 3:
            raise ValueError("recolor needs a colour photograph, got a grey one; use colorize for grey photographs")

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the new colours of the objects under the strokes."""
        RECOLOR.check(source.batch, reach=self.reach)
        scribbles = source.scribbles(drawn.masks.get("stroke_mask"), drawn.colours, "stroke_mask")
        kept = background_of(source, drawn.masks.get("keep"), scribbles, "keep")

        colours, regions, valid = _grouped(scribbles)
        counted = without_strays(scribbles.weighted(regions), source.size).weights
        brightness, old = (
            region_means(part, counted.unsqueeze(2)) for part in split_luminance(scribbles.image.unsqueeze(2))
        )
        colours = with_room(colours, brightness)
        inside = [scribbles.weighted(part) for part in regions.split(1, dim=1)]
        objects = fit_regions(source, inside, kept, self.selection_in(source.size))
        change = Recoloring(colours, old, valid)
        reduced = split_luminance(objects.reduced)[1]
        beside = []
        for share in change.shares(objects.reduced_masks()).split(1, dim=1):
            beside.append(colours_beside(reduced, refine_mask(reduced, share)).planes)
        return Fitted(RecoloredPixels(change, objects, beside))


@dataclass(frozen=True, eq=False)
class RecoloredPixels:
    """The recoloured pixels of a picture.

    Attributes:
        change: of the colours, given masks.
        objects: the masks.
        beside: for each object, what :func:`colours_beside` found, in the reduced picture.
    """

    change: "Recoloring"
    objects: Regions
    beside: list[Tensor]

    def __call__(self, pixels: Pixels) -> Tensor:
        """Recolour pixels."""
        sides = [Sides.of(self.objects.rows(planes, pixels)) for planes in self.beside]
        return self.change(pixels.image, self.objects.masks(pixels), sides)


def with_room(chroma: Tensor, brightness: Tensor) -> Tensor:
    """Scale down chroma (B, K, 3) with which a pixel of the given brightness (B, K, 1) would hardly have room to white.

    If every pixel of an object had the strongest chroma that white allows, the object would look flat: lighter pixels,
    which need more chroma, would have less. The strongest chroma that black allows grows with the brightness.
    """
    limit = (1 - brightness).clamp(min=0.0) / chroma.amax(2, keepdim=True).clamp(min=EPSILON)
    return chroma * (ROOM * limit).clamp(max=1.0)


def _grouped(scribbles: Scribbles) -> tuple[Tensor, Tensor, Tensor]:
    """Return the chroma (B, K, 3) of scribbles, their regions (B, K, n), and which of them are valid, (B, K)."""
    chroma = split_luminance(scribbles.shown.unsqueeze(2))[1]
    regions, colours, valid = group_colours(chroma, scribbles.weights.unsqueeze(2))
    return colours, regions.squeeze(2), valid


@dataclass(frozen=True, eq=False)
class Recoloring:
    """Recolouring of an image by scribbles of K colours, given the masks of the regions.

    A pixel on a soft border is a mixture of the object and its background. Only the object's part takes the new colour,
    so that no rim of the old colour is left.

    Attributes:
        colours: chroma of the strokes, (B, K, 3).
        old: mean chroma of the image under the strokes, (B, K, 3).
        valid: which of the K colours each image has, (B, K).
    """

    colours: Tensor
    old: Tensor
    valid: Tensor

    def shares(self, masks: Tensor) -> Tensor:
        """Return the fraction of each pixel that takes each colour, (B, K, H, W), from masks (B, K, H, W)."""
        certain = ((masks - END_MARGIN) / (1 - 2 * END_MARGIN)).clamp(0.0, 1.0)
        shares = certain * self.valid[..., None, None]
        return shares if shares.shape[1] == 1 else shares / shares.sum(1, keepdim=True).clamp(min=1.0)

    def __call__(self, pixels: Tensor, masks: Tensor, beside: list[Sides]) -> Tensor:
        """Recolour pixels (B, 3, H, W), given masks (B, K, H, W) and the colours on both sides of their borders."""
        shares = self.shares(masks)
        luminance, chroma = split_luminance(pixels)
        changed, total = chroma, torch.zeros_like(luminance)
        for k in range(shares.shape[1]):
            sides = beside[k]
            share = sides.refine(chroma, shares[:, k : k + 1])
            # Chroma of the object's part of a mixed pixel; inside the object, that of the pixel.
            object_chroma = torch.addcmul(chroma, 1 - share, sides.across)
            # The new colour takes the relative saturation of the old one, so that a white highlight stays white.
            squared_saturation = squarable(self.old[:, k]).square().sum(1)[:, None, None, None]
            limited_chroma = squarable(object_chroma)
            product = (squared_saturation * dot(limited_chroma, limited_chroma)).clamp(min=EPSILON).sqrt()
            relative = (product + GREY_CHROMA**2) / (squared_saturation + GREY_CHROMA**2)
            changed = torch.addcmul(changed, share * relative.clamp(0.0, 1.5), self.colours[:, k, :, None, None])
            changed = torch.addcmul(changed, share, object_chroma, value=-1)
            total = total + share
        untouched = (total == 0).expand_as(pixels)
        return torch.where(untouched, pixels, merge_luminance(luminance, changed))
