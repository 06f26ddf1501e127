"""Corrections of masks for edits of hue and saturation, which hardly depend on light and shade.

A mask follows brightness and texture, too, and selects grey shadows and brown wood beside red paint. What it selects
counts less if the hues and saturations around a pixel are not among those under the stroke, above all where the mask is
in doubt. Means over the surroundings decide, not single pixels: a white highlight belongs to the paint around it.

The shade in folds is often so dark that no mask selects it. Where selected pixels enclose darker ones of a similar hue
that are no less saturated, these are selected, too.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.precision import squarable
from nlfilter_torch.operator.features import blur
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.picture.colour import dot, split_luminance
from nlfilter_torch.photo.picture.resizing import block_means, enlarged
from nlfilter_torch.photo.selections.scribbled_colours import (
    EPSILON,
    SIMILAR_SHARE,
    colours_in_lab,
    density,
    every_nth,
)

NUM_COLOURS = 128  # approximate number of scribbled pixels that all are compared with
DARK_LUMINANCE = 0.02  # luminance below which hue and saturation are uncertain
HALF_COUNTED = 0.1  # luminance of a scribbled pixel that counts half, for the same reason
BLACK = 1e-4  # added to it, so that pixels of a black object count, too
BANDWIDTH, PER_SATURATION = 0.06, 0.08  # of this comparison: for a grey object, and how it grows with the saturation
AROUND_SIGMA, AROUND_GRID = 0.02, 60  # surroundings: standard deviation, share of the short side; rows or columns
LEAST_SIGMA = 3.0  # the least of it, in pixels: wider than a soft border, whose pixels are mixtures
# Mean likeness of the surroundings up to which what a mask of 1 selects does not count, and from which on it does.
UNLIKE, ALIKE = 0.02, 0.2
DOUBT = 0.9  # by how much these grow as the mask approaches 0
WIDEST = 0.03  # width of shade that is enclosed, as a share of the short side
# What is shade: luminance and saturation relative to those under the stroke, and cosine of the angle between hues. The
# first number is where the step between shade and other things begins, and the second where it ends.
SHADED = (0.5, 0.8)
SATURATED = (0.5, 0.9)
SAME_HUE = (0.75, 0.9)
#: Bandwidth in which colours are compared with those of scribbles to keep: that of masks, as both say what is alike.
KEPT_BANDWIDTH: float = MASK.defaults["photometric_bandwidth"]


@dataclass(frozen=True, eq=False)
class HueSamples:
    """Scribbled pixels that hues and saturations are compared with.

    Attributes:
        values: :func:`relative_chroma` of the pixels, (B, 2, n).
        shares: of the pixels, which sum up to 1 or are 0, (B, 1, n).
    """

    values: Tensor
    shares: Tensor

    @staticmethod
    def of(colours: Tensor, weights: Tensor) -> "HueSamples":
        """Choose from scribbled pixels of colours (B, 3, n), in order :func:`outwards`, and of weights (B, 1, n)."""
        sample, shares = every_nth(colours.clamp(0.0, 1.0), weights, NUM_COLOURS)  # as the reduced picture is
        luminance = split_luminance(sample.unsqueeze(2))[0].squeeze(2)
        shares = shares * (luminance + BLACK) / (luminance + HALF_COUNTED)
        return HueSamples(relative_chroma(sample), shares / shares.sum(2, keepdim=True).clamp(min=EPSILON))

    def likeness(self, image: Tensor) -> Tensor:
        """Likeness (B, 1, h, w), in [0, 1], of the pixels of an image (B, 3, h, w)."""
        middle = (self.values * self.shares).sum(2, keepdim=True)
        bandwidth = BANDWIDTH + PER_SATURATION * (dot(middle, middle) + EPSILON).sqrt()
        near = density(relative_chroma(image.flatten(2)), self.values, self.shares, bandwidth)
        return (near / SIMILAR_SHARE).clamp(max=1.0).unflatten(2, image.shape[-2:])


def relative_chroma(colours: Tensor) -> Tensor:
    """Red and blue chroma, (B, 2, n), of colours (B, 3, n) relative to their luminance: the same in light and shade."""
    luminance, chroma = (part.squeeze(2) for part in split_luminance(colours.unsqueeze(2)))
    return (chroma / (luminance.clamp(min=0.0) + DARK_LUMINANCE + (dot(chroma, chroma) + EPSILON).sqrt()))[:, ::2]


def corrections(
    image: Tensor, mask: Tensor, share: Tensor, samples: HueSamples, kept: tuple[Tensor, Tensor] | None
) -> Tensor:
    """Factor of a share, and how much of a pixel the corrected share encloses, in [0, 1], (B, 2, h, w).

    Args:
        image: the reduced picture, (B, 3, h, w).
        mask: of the object, (B, 1, h, w).
        share: of the pixels, to correct; sharper than the mask, (B, 1, h, w).
        samples: of the scribbles on the object.
        kept: colours (B, 3, n) and weights (B, 1, n) of scribbles on the background, the like of which is not enclosed.
    """
    factor = trusted(mask, samples.likeness(image))
    within = enclosed(share * factor)
    if kept is not None:
        sample, shares = every_nth(*kept, NUM_COLOURS)
        places, points = (colours_in_lab(colours) for colours in (image.flatten(2), sample))
        near = density(places, points, shares, image.new_tensor(KEPT_BANDWIDTH)).unflatten(2, image.shape[-2:])
        within = within * (1 - (near / SIMILAR_SHARE).clamp(max=1.0))
    return torch.cat([factor, within], dim=1)


def trusted(mask: Tensor, alike: Tensor) -> Tensor:
    """Factor (B, 1, h, w), in [0, 1], of a mask whose pixels are so alike to the scribbled ones, (B, 1, h, w)."""
    size = (mask.shape[-2], mask.shape[-1])
    step = max(1, min(size) // AROUND_GRID)
    weight = mask.square()
    coarse = block_means(torch.cat([weight, weight * alike, weight * mask], dim=1), step)
    around = blur(coarse, max(AROUND_SIGMA * min(size), LEAST_SIGMA) / step)
    total = around[:, :1].clamp(min=EPSILON)
    likeness, certainty = (around[:, 1:] / total).split(1, dim=1)
    doubt = DOUBT * (1 - certainty)
    factor = ramp(likeness - doubt, UNLIKE, ALIKE)
    return enlarged(factor, (size[0] / coarse.shape[-2], size[1] / coarse.shape[-1]), (0, 0), size)


def enclosed(share: Tensor) -> Tensor:
    """How much a share (B, 1, h, w) encloses: it and its gaps up to :data:`WIDEST`, without those at its border."""
    radius = round(WIDEST * min(share.shape[-2:]) / 2)
    margin = radius // 2  # nooks along the border of the object are not part of it
    wide = F.pad(share, (2 * radius + margin,) * 4)
    for sign, reach in ((1, radius), (-1, radius + margin)):
        side = 2 * reach + 1
        wide = sign * F.max_pool2d(F.max_pool2d(sign * wide, (side, 1), 1), (1, side), 1)
    return wide


def shade(luminance: Tensor, chroma: Tensor, scribbled_luminance: Tensor, scribbled_chroma: Tensor) -> Tensor:
    """How far pixels are shade of an object, (B, 1, H, W) in [0, 1].

    Args:
        luminance: of the pixels, (B, 1, H, W).
        chroma: of the pixels, (B, 3, H, W).
        scribbled_luminance: mean under the scribbles on the object, (B, 1, 1, 1).
        scribbled_chroma: likewise, (B, 3, 1, 1).
    """
    luminance, chroma, scribbled_luminance, scribbled_chroma = map(
        squarable, (luminance, chroma, scribbled_luminance, scribbled_chroma)
    )
    product = dot(chroma, scribbled_chroma.expand_as(chroma))
    squares = dot(chroma, chroma), dot(scribbled_chroma, scribbled_chroma)
    cosine = product * (squares[0] + EPSILON).rsqrt() * (squares[1] + EPSILON).rsqrt()
    darkness = luminance.clamp(min=DARK_LUMINANCE) / scribbled_luminance.clamp(min=EPSILON)
    saturation = product / (squares[1] + EPSILON) / darkness.clamp(min=EPSILON)
    return (1 - ramp(darkness, *SHADED)) * ramp(saturation, *SATURATED) * ramp(cosine, *SAME_HUE)


def ramp(values: Tensor, low: float, high: float) -> Tensor:
    """A smooth step from 0, for values up to ``low``, to 1, for values from ``high`` on."""
    place = ((values - low) / (high - low)).clamp(0.0, 1.0)
    return place.square() * (3 - 2 * place)
