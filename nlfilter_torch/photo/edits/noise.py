"""Estimation of the noise of any source, and of hot and dead pixels, which are replaced before noise is removed.

Hot and dead pixels are single ones far from all around them. A value is an outlier if it is much farther from the
median of the 24 values around it than these spread, and if the nearest of them do not share the deviation, as those of
a star do. Textures have few of them among many values that come close to it; text, drawings and dithered pictures have
them beside many others that deviate as much. Where a picture has more outliers than values that come close, and they
are rare, they are defects.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_hidden
from nlfilter_torch.nn.denoiser.estimate import has_few_colours, measured_profile, profile_of_measured, profile_places
from nlfilter_torch.nn.denoiser.noise import Noise, measured_noise, window_places
from nlfilter_torch.nn.denoiser.profile import NoiseProfile
from nlfilter_torch.operator.features import pad_border
from nlfilter_torch.operator.options import GuideChannels
from nlfilter_torch.photo.picture.pixels import Block, M
from nlfilter_torch.photo.picture.source import Source, at, sampled_places

MARGIN = 2  # pixels around a pixel that it is compared with
SMALLEST = 2 * MARGIN + 1  # side of a picture in which they are looked for
RANGE = 0.01, 0.99  # quantiles of the values of a picture between which is its range
FLOOR = 0.04  # share of the range that is added to the spread, so that steps of the depth are no outliers
ISOLATED = 2.5  # ratio of the deviation to the spread from which a value is an outlier
CLEARER = 2  # multiple of the spread without four of the values around that counts like that without two
CLOSE = ISOLATED / 2  # from which it comes close
COUPLED = 0.08  # share of its deviation up to which the nearest values have it as well
RARE = 0.01  # share of the pixels that may be outliers
AS_STRONG = 8  # multiple of their number that other values may have that deviate half as much
BINS, PER_OCTAVE = 24, 2  # of deviations over the floor
AROUND = [(i, j) for i in range(-MARGIN, MARGIN + 1) for j in range(-MARGIN, MARGIN + 1) if (i, j) != (0, 0)]
EIGHT = [k for k, (i, j) in enumerate(AROUND) if max(abs(i), abs(j)) == 1]
FOUR = [k for k, (i, j) in enumerate(AROUND) if abs(i) + abs(j) == 1]
STRIP = 1 << 18  # pixels that are looked at together


@dataclass(frozen=True, eq=False)
class HotPixels:
    """The outliers of a batch of pictures.

    Attributes:
        floor: (B,), what is added to the spread.
        count: (B,), number of pixels that are replaced; 0 where outliers are no defects.
        values: those that are replaced: the numbers of picture and channel, and the place in it, (3, n), ascending.
        medians: by what, (n,).
    """

    floor: Tensor
    count: Tensor
    values: Tensor
    medians: Tensor

    def removed_at(self, places: Tensor, colours: Tensor) -> Tensor:
        """Replace the outliers in the colours (B, C, n) of pixels with row-major indices (n,)."""
        result = colours.clone()
        for picture, channel in self.values[:2].unique(dim=1).T.tolist():
            chosen = (self.values[0] == picture) & (self.values[1] == channel)
            outliers, medians = self.values[2, chosen], self.medians[chosen]
            nearest = torch.searchsorted(outliers, places).clamp(max=len(outliers) - 1)
            same = outliers[nearest] == places
            result[picture, channel, same] = medians[nearest[same]]
        return result

    def repaired(self, image: Tensor, span: Tensor) -> Tensor:
        """:meth:`removed` for images (B, C, H, W) in units of which ``span`` (B, 1, 1, 1) are 1."""
        return replace(self, floor=self.floor * span.flatten().to(self.floor)).removed(image)

    def removed(self, image: Tensor) -> Tensor:
        """Replace the outliers in images (B, C, H, W) by the median around them; differentiable."""
        if not bool((self.count > 0).any()):
            return image
        result, floor = image.clone(), torch.where(self.count > 0, self.floor, torch.inf)
        for start in range(0, image.shape[2], max(1, STRIP // image.shape[3])):
            rows = slice(start, start + max(1, STRIP // image.shape[3]))
            values = Deviating.of(image, floor, rows)
            chosen = values.are_outliers
            result[tuple(place[chosen] for place in values.places)] = values.median[chosen]
        return result


@dataclass(frozen=True, eq=False)
class Deviating:
    """Values of images that deviate from those around them.

    Attributes:
        places: where they are: image, channel, row and column, each (n,).
        median: of the 24 values around each.
        deviation: from it, not negative.
        ratio: of the deviation to the spread of the values around and the floor.
        shared: share of the deviation that the nearest values have as well.
    """

    places: tuple[Tensor, ...]
    median: Tensor
    deviation: Tensor
    ratio: Tensor
    shared: Tensor

    @staticmethod
    def of(image: Tensor, floor: Tensor, rows: slice) -> "Deviating":
        """The values in some rows of images (B, C, H, W), for floors (B,)."""
        first, last, _ = rows.indices(image.shape[2])
        above, below = min(first, MARGIN), min(image.shape[2] - last, MARGIN)
        part = image[:, :, first - above : last + below]
        padded = pad_border(part, MARGIN)
        padded = padded[:, :, above : padded.shape[2] - below]
        centre = padded[..., MARGIN:-MARGIN, MARGIN:-MARGIN]
        least, most = _second_of_four(padded)
        far = CLOSE * floor.view(-1, 1, 1, 1).to(image)
        picture, channel, row, column = ((centre - most > far) | (least - centre > far)).nonzero(as_tuple=True)
        values, floors = centre[picture, channel, row, column], floor.to(image)[picture]
        # Most of them are ruled out by the eight nearest values, whose spread is that of all 24 at most.
        near = torch.stack([padded[picture, channel, row + 2 + AROUND[k][0], column + 2 + AROUND[k][1]] for k in EIGHT])
        ordered = in_order(near.detach())
        spread = ordered[-3] - ordered[2]
        ends = torch.maximum(values.detach() - ordered[2], ordered[-3] - values.detach())
        kept = ends > CLOSE * (spread + floors)
        picture, channel, row, column = (place[kept] for place in (picture, channel, row, column))
        values, floors = values[kept], floors[kept]
        around = torch.stack([padded[picture, channel, row + 2 + i, column + 2 + j] for i, j in AROUND])
        ordered = in_order(around)
        median = (ordered[11] + ordered[12]) / 2
        deviation = values - median
        # Among the values around there may be another outlier, or two if this one is the clearer.
        spread, smaller = ordered[-2] - ordered[1], ordered[-3] - ordered[2]
        ratio = deviation.abs() / torch.minimum(spread + floors, CLEARER * (smaller + floors))
        beside = (around[FOUR] - median) * deviation.sign()
        shared = (beside.sum(0) - beside.amax(0)) / 3 / deviation.abs().clamp(min=torch.finfo(image.dtype).tiny)
        return Deviating((picture, channel, row + first, column), median, deviation.abs(), ratio, shared)

    @property
    def are_outliers(self) -> Tensor:
        """Which of them are outliers, (n,)."""
        return (self.ratio > ISOLATED) & (self.shared < COUPLED)


def in_order(values: Tensor) -> list[Tensor]:
    """Sort few values of many pixels, (K, n), in ascending order, as K tensors (n,); differentiable.

    A network of comparisons (Batcher's, as in Knuth's algorithm 5.2.2M) does whole rows at once; ``Tensor.sort``, for
    which the values of a pixel are far apart in memory, takes ten times as long.
    """
    rows = list(values.unbind())
    for low, high in comparisons(len(rows)):
        rows[low], rows[high] = torch.minimum(rows[low], rows[high]), torch.maximum(rows[low], rows[high])
    return rows


@cache
def comparisons(count: int) -> list[tuple[int, int]]:
    """The comparisons of a network that sorts so many values."""
    pairs, largest = list[tuple[int, int]](), 1 << max(0, (count - 1).bit_length() - 1)
    step = largest
    while step:
        distance, offset, following = step, 0, largest
        while True:
            pairs += [(i, i + distance) for i in range(count - distance) if i & step == offset]
            if following == step:
                break
            distance, offset, following = following - step, step, following // 2
        step //= 2
    return pairs


def _second_of_four(padded: Tensor) -> tuple[Tensor, Tensor]:
    """The second least and the second largest of the values above, below and beside each pixel."""
    inside, last = slice(MARGIN, -MARGIN), MARGIN - 1
    shifted = slice(last, -MARGIN - 1), slice(MARGIN + 1, -last)
    up, down = (padded[..., rows, inside] for rows in shifted)
    left, right = (padded[..., inside, columns] for columns in shifted)
    higher, lower = torch.maximum(up, down), torch.minimum(up, down)
    more, less = torch.maximum(left, right), torch.minimum(left, right)
    least = torch.minimum(torch.maximum(lower, less), torch.minimum(higher, more))
    most = torch.maximum(torch.minimum(higher, more), torch.maximum(lower, less))
    return least, most


@torch.no_grad()
def hot_pixels_of(source: Source[M]) -> HotPixels | None:
    """Find the outliers of a picture, and whether they are defects; None if it is too small to tell."""
    if min(source.size) < SMALLEST:
        return None
    places = sampled_places(source.size)
    colours, weights = at(source, places)
    if is_hidden(colours):
        return None
    values = colours.double() if weights is None else torch.where(weights > 0, colours.double(), torch.nan)
    ends = torch.nanquantile(values.flatten(1), colours.new_tensor(RANGE).double(), dim=1)
    ends = torch.where(ends.isfinite(), ends, 0.0)
    floor = FLOOR * (ends[1] - ends[0])
    parts = list(source.over(_numbers, "Looking closely", floor, margin=MARGIN))
    sums = torch.stack([part.numbers for part in parts]).sum(0)
    count, outliers, close = sums[:, :3].unbind(1)
    strong, others = sums[:, 3:].unflatten(1, (2, BINS)).unbind(1)
    # The bin of the median outlier, and all values from an octave below on.
    middle = (strong.cumsum(1) < strong.sum(1, keepdim=True) / 2).sum(1, keepdim=True)
    as_strong = (others * (torch.arange(BINS) >= middle - PER_OCTAVE)).sum(1)
    few = torch.stack([has_few_colours(picture[None, :, :, None]) for picture in colours])
    rare = count <= RARE * source.size[0] * source.size[1]
    defects = rare & (outliers > close) & (as_strong <= AS_STRONG * outliers) & ~few.to(rare.device)
    values, medians = torch.cat([part.values for part in parts], 1), torch.cat([part.medians for part in parts])
    replaced = defects[values[0]]
    values, medians = values[:, replaced], medians[replaced]
    order = values[2].argsort()
    return HotPixels(floor, torch.where(defects, count, 0), values[:, order], medians[order])


@dataclass(frozen=True, eq=False)
class Part:
    """Part of a picture.

    Attributes:
        numbers: (B, 3 + 2 * BINS) of pixels with an outlier, of outliers, of values that come close, and of outliers
            and of others by their deviation.
        values: the outliers, as in :class:`HotPixels`.
        medians: around them, (n,).
    """

    numbers: Tensor
    values: Tensor
    medians: Tensor


def _numbers(block: Block, floor: Tensor) -> Part:
    """Count the outliers in a block of pictures."""
    image, inner, width = block.pixels, block.inner, block.width
    first_row = block.first // width
    total = torch.zeros(len(image), 3 + 2 * BINS, dtype=torch.float64)
    first, last, _ = inner[0].indices(image.shape[2])
    step, outliers, medians = max(1, STRIP // image.shape[3]), [], []
    for start in range(first, last, step):
        values = Deviating.of(image, floor, slice(start, min(start + step, last)))
        chosen, (picture, channel, row, column) = values.are_outliers, values.places
        place = (row - first + first_row) * width + column
        outliers.append(torch.stack([picture, channel, place])[:, chosen])
        medians.append(values.median[chosen])
        pixels = outliers[-1][::2].unique(dim=1)
        close = (values.ratio > CLOSE) & (values.ratio <= ISOLATED)
        floors = floor.to(values.deviation)[picture].clamp(min=torch.finfo(values.deviation.dtype).tiny)
        octave = (values.deviation / floors).clamp(1.0, 2.0**BINS).log2()
        bins = 3 + (PER_OCTAVE * octave).long().clamp(max=BINS - 1) + BINS * ~chosen
        for column_of, pictures in ((0, pixels[0]), (1, picture[chosen]), (2, picture[close])):
            total[:, column_of] += torch.bincount(pictures, minlength=len(image))
        flat = torch.bincount(picture * total.shape[1] + bins, minlength=total.numel())
        total += flat.view_as(total)
    return Part(total, torch.cat(outliers, 1), torch.cat(medians))


Repaired = Callable[[Tensor, Tensor], Tensor]  # of places (n,) and their colours (B, C, n)


@torch.no_grad()
def noise_of(source: Source[M], channels: GuideChannels = "all") -> Noise:
    """Estimate the noise of any source, or of its luminance, as white noise."""
    return Noise(*source.measured(_measured, channels))


@torch.no_grad()
def profile_of(source: Source[M], repaired: Repaired | None = None) -> NoiseProfile:
    """Estimate the noise of any source, some of whose colours are replaced, by scale, plane and brightness."""
    return profile_of_measured(source.measured(_measured_profile, repaired))


def _measured_profile(source: Source[M], repaired: Repaired | None) -> Tensor:
    places = profile_places(source.size)
    colours = _visible(source, places)
    if repaired is not None:
        colours = repaired(places.to(colours.device), colours)
    return measured_profile(source.size, colours)


def _visible(source: Source[M], places: Tensor) -> Tensor:
    """Colours of single pixels, 0 where they do not count: windows with much black are not measured."""
    colours, weights = at(source, places)
    return colours if weights is None else colours * (weights > 0)


def _measured(source: Source[M], channels: GuideChannels) -> Tensor:
    return measured_noise(source.size, _visible(source, window_places(source.size)), channels)
