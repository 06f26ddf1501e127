"""Corrections of masks for edits of hue and saturation, which hardly depend on light and shade.

A mask follows brightness and texture, too, and selects grey shadows and brown wood beside red paint. What it selects
counts less if the hues and saturations around a pixel are not among those under the stroke, above all where the mask is
in doubt. Means over the surroundings decide, not single pixels: a white highlight belongs to the paint around it.

The side of an object in shade is often so dark that no mask selects it. Areas of its hue that are connected with what
is selected, and end where that hue ends, are selected, too, as far as they are dark. A shadow on wood beside a red
saucer has the hue of the saucer, but fades into wood of nearly that hue: it is not.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes, distance_transform_edt
from skimage.measure import label
from skimage.segmentation import expand_labels
from torch import Tensor

from nlfilter_torch.core.precision import squarable
from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.operator.features import blur
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.picture.colour import dot, split_luminance
from nlfilter_torch.photo.picture.resizing import block_means, enlarged
from nlfilter_torch.photo.selections.connected import INSIDE_MASK, SMALL_PIECE, connected
from nlfilter_torch.photo.selections.scribbled_colours import (
    EPSILON,
    SIMILAR_SHARE,
    colours_in_lab,
    density,
    every_nth,
)

Mask = NDArray[np.bool_]

NUM_COLOURS = 128  # approximate number of scribbled pixels that all are compared with
DARK_LUMINANCE = 0.02  # luminance below which hue and saturation are uncertain
HALF_COUNTED = 0.1  # luminance of a scribbled pixel that counts half, for the same reason
BANDWIDTH, PER_SATURATION = 0.06, 0.08  # of this comparison: for a grey object, and how it grows with the saturation
AROUND_SIGMA, AROUND_GRID = 0.02, 60  # surroundings: standard deviation, share of the short side; rows or columns
LEAST_SIGMA = 3.0  # the least of it, in pixels: wider than a soft border, whose pixels are mixtures
# Mean likeness of the surroundings up to which what a mask of 1 selects does not count, and from which on it does.
UNLIKE, ALIKE = 0.02, 0.2
DOUBT = 0.9  # by how much these grow as the mask approaches 0
# What is shade: luminance and saturation relative to those under the stroke, and cosine of the angle between hues. The
# first number is where the step between shade and other things begins, and the second where it ends.
SHADED = (0.7, 1.0)
SATURATED = (0.2, 0.4)  # glossy paint reflects the sky
SAME_HUE = (0.75, 0.9)
# Of areas in shade: pixels that thinner ones than twice that are no sides of an object, pixels beyond them that are
# compared, and their mean likeness from which on an area goes on. Chosen on choosing composites and one photograph.
THIN, BEYOND, OPEN = 2, 4, 0.32
# Widest gap, as a share of the short side, between equally large pieces of an object, and between any: a strap, an arm.
GAP, WIDEST_GAP = 0.03, 0.08
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
        shares = shares * (luminance + EPSILON) / (luminance + HALF_COUNTED)  # those of a black object count, too
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
    """Factor of a share, and where shade belongs to the object, in [0, 1], (B, 2, h, w).

    Args:
        image: the reduced picture, (B, 3, h, w).
        mask: of the object, (B, 1, h, w).
        share: of the pixels, to correct; sharper than the mask, (B, 1, h, w).
        samples: of the scribbles on the object.
        kept: colours (B, 3, n) and weights (B, 1, n) of scribbles on the background, the like of which is no shade.
    """
    alike = samples.likeness(image)
    factor = trusted(mask, alike)
    if kept is not None:
        sample, shares = every_nth(*kept, NUM_COLOURS)
        places, points = (colours_in_lab(colours) for colours in (image.flatten(2), sample))
        near = density(places, points, shares, image.new_tensor(KEPT_BANDWIDTH)).unflatten(2, image.shape[-2:])
        alike = alike * (near < EPSILON)  # shade is far darker: even a remote likeness tells
    return torch.cat([factor, shaded_parts(share * factor, alike)], dim=1)


@torch.no_grad()
def shaded_parts(core: Tensor, alike: Tensor) -> Tensor:
    """Where shade belongs to what is selected, ``core``, (B, 1, h, w): 1 or 0; ``alike`` is likeness of hue, likewise.

    None if values cannot be read.
    """
    if is_unreadable(core):
        return torch.zeros_like(core)
    planes = (plane.squeeze(1).cpu().numpy() for plane in (core >= INSIDE_MASK, alike))
    parts = [_closed_off(*pair) for pair in zip(*planes, strict=True)]
    return torch.stack(parts).unsqueeze(1).to(core)


def _closed_off(core: Mask, alike: NDArray[np.float64]) -> Tensor:
    """The wide areas of (h, w) beside what is selected beyond which pixels are not alike, and the gaps that they close.

    None is more than half as large as what is selected, which they could not be a side of.
    """
    added = (alike >= 1) & ~core
    numbers = label(added)
    beside = np.bincount(numbers.ravel(), binary_dilation(core).ravel()) > 0
    beyond = np.where(added | binary_dilation(core, iterations=BEYOND), 0, expand_labels(numbers, BEYOND)).ravel()
    areas, around = np.bincount(numbers.ravel()), np.bincount(beyond, minlength=numbers.max() + 1)
    going_on = np.bincount(beyond, alike.ravel(), len(around)) / around.clip(1)
    wide = np.bincount(numbers.ravel(), binary_erosion(added, iterations=THIN).ravel()) > 0
    closed = beside & wide & (going_on < OPEN) & (2 * areas <= core.sum())
    reach = max(1, round(GAP * min(core.shape) / 2))
    folds = binary_dilation(np.pad(core, reach), iterations=reach)
    folds = binary_erosion(folds, iterations=reach + reach // 2)[reach:-reach, reach:-reach]
    whole = binary_fill_holes(core | folds | (added & closed[numbers]))
    return torch.from_numpy(binary_dilation(whole & ~core))


@torch.no_grad()
def pieces_of(masks: Tensor, painted: Tensor) -> Tensor:
    """Which pixels (B, K, h, w) of masks belong to the object under strokes, ``painted`` (B, K, h, w), as bool.

    An arm or a strap before an object hides part of it. Pieces of a mask belong to it if they are connected with a
    stroke, or if the gap between is narrow, which is judged by how much smaller the piece is than the rest; specks do
    not. All do if values cannot be read.
    """
    if is_unreadable(masks):
        return torch.ones_like(masks, dtype=torch.bool)
    inside = (masks >= INSIDE_MASK) | (painted > 0)
    planes = (part.flatten(0, 1).cpu().numpy() for part in (inside, painted > 0))
    pieces = [_beside(*pair) for pair in zip(*planes, strict=True)]
    return connected(masks, torch.stack(pieces).view_as(masks).to(masks))


def _beside(inside: Mask, own: Mask) -> Tensor:
    """What is painted, (h, w), with the pieces of a mask that belong to it."""
    numbers = label(inside)
    areas = np.bincount(numbers.ravel()).clip(1)
    while own.any():
        gaps = np.full(len(areas), np.inf)
        np.minimum.at(gaps, numbers.ravel(), distance_transform_edt(~own).ravel())
        near = gaps <= min(inside.shape) * np.minimum(GAP * np.sqrt(own.sum() / areas), WIDEST_GAP)
        near &= areas >= SMALL_PIECE * own.sum()
        near[0] = False
        if (near[numbers] <= own).all():
            break
        own = own | near[numbers]
    return torch.from_numpy(own)


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
