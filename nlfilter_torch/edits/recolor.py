"""Strokes of colour that reach everything of the same colour. Paper: Sec. V-A, Figs. 14, 15."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_photograph
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colour import colour_guide, group_colours, merge_luminance, region_means, split_luminance
from nlfilter_torch.edits.components import Components, Scribbles, correlations, find_components
from nlfilter_torch.edits.parameters import RECOLOR
from nlfilter_torch.edits.source import Fitted, Guide, Source, edited
from nlfilter_torch.filtering.scribbles import walk_basis

FAINT, FULL = 0.2, 0.5  # likeness below FAINT leaves a pixel as it is, above FULL it takes the whole colour
DOUBT = 0.05  # variance of what a component tells, in units of a pixel's own: two colours on one thing are no error
TINY = 1e-12  # keeps the derivative of a root finite
SATURATION = 0.05  # chroma below this is grey: it has no texture of its own to keep


@full_precision
def recolor(
    image: Tensor,
    strokes: Tensor,
    stroke_mask: Tensor,
    *,
    keep: Tensor | None = None,
    reach: float | Tensor = RECOLOR.defaults["reach"],
    photometric_bandwidth: float | Tensor = RECOLOR.defaults["photometric_bandwidth"],
    patch_size: int = RECOLOR.defaults["patch_size"],
    **options: Any,
) -> Tensor:
    """Give the colour of strokes to everything that looks like the spots they are painted on.

    Paper: Sec. V-A, with a regression on correlations in place of k-means: it is soft, and any number of spots with any
    number of colours divide the image among them. A spot, which is paint of one colour without a gap, stands for what
    most of it covers, and takes its colour all over. Hue and saturation count before lightness, in CIE Lab.

    Args:
        image: (B, 3, H, W), RGB in [0, 1].
        strokes: (B, 3, H, W), RGB; their hue and saturation count, their lightness does not. Strokes of up to 16
            colours are told apart and reach their own likes.
        stroke_mask: (B, 1, H, W) in [0, 1], above 0 where painted.
        keep: (B, 1, H, W) in [0, 1], above 0 on spots whose likes are to stay as they are; None is none. Strokes paint
            over it.
        reach: in [0, 1), how likely a walk over similar pixels goes on after each step; larger takes in what is less
            alike.
        photometric_bandwidth: in hundredths of Lab: 0.12 is 12 units.
        patch_size: of the patches that are compared.
        **options: further ones of :func:`nonlocal_operator`, such as ``spatial_bandwidth``, ``num_landmarks`` or
            ``generator``.

    Returns:
        (B, 3, H, W), of the luminance of ``image``, and equal to it where a pixel resembles no stroke. Differentiable
        in image, strokes, mask and parameters, with the grouping of colours held.

    Raises:
        TypeError, ValueError: if a tensor has another size, a mask leaves [0, 1], or nothing is painted.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[:, 0, :, 12:] += 0.6  # the right half is reddish
        >>> strokes, painted = torch.zeros(1, 3, 24, 24), torch.zeros(1, 1, 24, 24)
        >>> strokes[:, 2], painted[..., 8:12, 16:20] = 1.0, 1.0  # blue, in its midst
        >>> blue = recolor(image, strokes, painted, num_landmarks=50)
        >>> torch.equal(blue[..., :8], image[..., :8]), bool((blue[:, 2] > blue[:, 0])[..., 14:].all())
        (True, True)
    """
    check_photograph(image, "image", channels=3)
    return edited(
        image,
        fit_recolor,
        strokes,
        stroke_mask,
        keep=keep,
        reach=reach,
        photometric_bandwidth=photometric_bandwidth,
        patch_size=patch_size,
        **options,
    )


def fit_recolor(
    source: Source,
    strokes: Any,
    stroke_mask: Any,
    *,
    keep: Any = None,
    reach: float | Tensor = RECOLOR.defaults["reach"],
    **options: Any,
) -> Fitted:
    """:func:`recolor` for any source."""
    RECOLOR["reach"].check_argument(reach, source.batch)
    scribbles = source.scribbles(stroke_mask, strokes, "stroke_mask")
    kept = None if keep is None else source.scribbles(keep, None, "keep", needed=False)

    colours, regions, counts = _grouped(scribbles)
    old = region_means(split_luminance(scribbles.image.unsqueeze(2))[1], regions.unsqueeze(2))
    marked = scribbles.weighted(regions * counts.unsqueeze(2))
    marked = marked if kept is None else marked.joined(kept)

    options = {name: RECOLOR.defaults[name] for name in ("photometric_bandwidth", "patch_size")} | options
    operator = source.operator(Guide({**options, "guide_channels": "all"}, look=colour_guide, spectral=True))
    basis = walk_basis(operator.pairs, reach).to(source.dtype)
    found = find_components(marked, operator.at(marked.places), basis, source.size)
    directions = [divide(components) for components in found]
    likeness = operator.each(
        lambda columns: torch.stack([correlations(*of) for of in zip(basis, directions, columns.factor, strict=True)])
    )
    change = Recoloring(colours, old)
    return Fitted(lambda pixels: change(pixels.image, likeness(pixels), marked.planes(pixels)))


def _grouped(scribbles: Scribbles) -> tuple[Tensor, Tensor, Tensor]:
    """The chroma (B, K, 3) of scribbles, their regions (B, K, n), and which of these an image has, (B, K)."""
    assert scribbles.colours is not None  # for mypy
    chroma = split_luminance(scribbles.colours.unsqueeze(2))[1]
    regions, colours, counts = group_colours(chroma, scribbles.weights.unsqueeze(2))
    return colours, regions.squeeze(2), counts


@dataclass(frozen=True, eq=False)
class Recoloring:
    """What scribbles of K colours make of any pixel, given how similar it is to what they cover.

    Attributes:
        colours: chroma of the strokes, (B, K, 3).
        old: mean chroma of what they are painted on, (B, K, 3).
    """

    colours: Tensor
    old: Tensor

    def __call__(self, pixels: Tensor, likeness: Tensor, marked: Tensor) -> Tensor:
        """Pixels (B, 3, H, W) in their new colours.

        Args:
            pixels: RGB.
            likeness: to each region, (B, K, H, W), and maybe to one more that stays as it is.
            marked: weights (B, K or K+1, H, W) of what is painted, and kept.
        """
        count = self.colours.shape[1]
        shares = ((likeness[:, :count] - FAINT) / (FULL - FAINT)).clamp(0.0, 1.0)
        shares = shares * shares * (3 - 2 * shares)  # no edge where the colour sets in
        shares = shares / shares.sum(1, keepdim=True).clamp(min=1.0)
        # Scribbled pixels take the colour of the scribble, whatever they look like.
        shares = shares * (1 - marked.sum(1, keepdim=True)) + marked[:, :count]

        # A highlight on red enamel is white, and stays so on blue: the new colour takes the old one's relative
        # saturation.
        luminance, chroma = split_luminance(pixels)
        usual = self.old.square().sum(2)[..., None, None]  # squared saturation, (B, K, 1, 1)
        product = (usual * chroma.square().sum(1, keepdim=True)).clamp(min=TINY).sqrt()
        relative = (product + SATURATION**2) / (usual + SATURATION**2)
        new = torch.einsum("bkhw,bkc->bchw", shares * relative.clamp(0.0, 1.5), self.colours)
        chroma = chroma * (1 - shares.sum(1, keepdim=True)) + new
        untouched = (shares.sum(1, keepdim=True) == 0).expand_as(pixels)
        return torch.where(untouched, pixels, merge_luminance(luminance, chroma))


def divide(components: Components) -> Tensor:
    """The vectors (K, M) whose products with a pixel's say how much it resembles one region rather than the others.

    The components share a pixel, about 0 to 1, by the best linear estimate of its region from its correlations with
    them, so that regions that resemble each other are told apart by what they do not share.
    """
    doubtful = components.between.double() + DOUBT * torch.eye(len(components.means)).to(components.means)
    solved = torch.cholesky_solve(components.owners.double(), torch.linalg.cholesky_ex(doubtful).L)
    return solved.mT.to(components.means) @ components.means
