"""The range that a picture uses.

Edits work in [0, 1], and their thresholds are levels of 8 bits. A picture that uses less than a quarter of [0, 1]
(medical and astronomical pictures of 16 bits, underexposed ones), or goes far beyond it (floats up to 65535), is seen
by them with its range stretched to [0, 1], and what they change is added to the picture in its own units. The range is
that of a sample of the pixels, so that a few very bright ones do not count. What lies far outside keeps its distance.
"""

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import mirrored
from nlfilter_torch.core.checks import FAR_OUTSIDE
from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.photo.picture.pixels import M, WorkingRange
from nlfilter_torch.photo.picture.source import Source, at, sampled_places, seeded

SMALL_SHARE = 0.25  # share of [0, 1] below which the range in use is stretched
RARE = 0.005  # share of the values on either side that do not count for the range
AROUND = 0.125  # by which the range is extended on both sides, as a share of itself
LEAST_STEPS = 32  # steps of the depth that the range comprises at least
WHOLE = (255.0, 65535.0)  # white of the depths whose values have steps
NEARLY = 1e-2  # distance from a whole number of steps that is due to rounding
LINES = 64  # rows, and columns, whose crossings show whether a picture uses its range


@torch.no_grad()
def range_of(source: Source[M]) -> WorkingRange | None:
    """The ranges that the pictures of a source use, or None if all are to be seen as they are.

    Values that cannot be read, and images of other than 1 or 3 channels, are seen as they are.
    """
    if source.channels not in (1, 3) or source.batch == 0:
        return None
    source = source.in_range(None)
    crossings = source.measured(_used_at, _crossings(source.size))
    if is_unreadable(crossings) or not bool(_is_unusual(crossings).any()):
        return None
    used = source.measured(_used_at, sampled_places(source.size))
    unusual = _is_unusual(used)
    if not bool(unusual.any()):
        return None
    low, high = _extended(*used)
    return WorkingRange(*(values.view(-1, 1, 1, 1) for values in (low, high, unusual)))


def _crossings(size: tuple[int, int]) -> Tensor:
    """Row-major indices (n,), ascending, of pixels in at most :data:`LINES` rows, which turn with the picture."""
    short, long = sorted(size)
    if short * long <= LINES**2:
        return torch.arange(short * long)
    places = torch.rand(2, LINES // 2, generator=seeded())
    across, along = ((places[axis] * side / 2).long() for axis, side in ((0, short), (1, long)))
    if short == long:
        along = across
    pairs = torch.cartesian_prod(across, along)
    return mirrored(pairs[:, 0], pairs[:, 1], size).unique()


def _used_at(source: Source[M], places: Tensor) -> Tensor:
    """Range that the values of some pixels comprise, and the step of their depth or 0: (3, B)."""
    colours, weights = at(source, places)
    colours = colours.detach().to(torch.promote_types(colours.dtype, torch.float32))
    values, quantile = colours.flatten(1), torch.quantile
    if weights is not None and bool((weights > 0).any(2).all()):
        values = torch.where(weights > 0, colours, torch.nan).flatten(1)
        quantile = torch.nanquantile
    ends = quantile(values, values.new_tensor([RARE, 1 - RARE]), dim=1)
    values = colours.flatten(1)
    step = values.new_zeros(len(values))
    for white in reversed(WHOLE):
        steps = values * white
        is_whole = ((steps - steps.round()).abs() < NEARLY).all(1)
        step = torch.where(is_whole, 1 / white, step)
    return torch.cat([ends, step[None]])


def _is_unusual(used: Tensor) -> Tensor:
    """Whether pictures with these results of :func:`_used_at` are seen in the range that they use, (B,)."""
    low, high, _ = used
    return ((high - low < SMALL_SHARE) | (low < -FAR_OUTSIDE) | (high > FAR_OUTSIDE)) & (high > low)


def _extended(low: Tensor, high: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """The range with room on both sides, but not beyond black and white, which clipped pixels have."""
    resolution = 2 * LEAST_STEPS * torch.finfo(low.dtype).eps * torch.maximum(low.abs(), high.abs())
    least = torch.maximum(LEAST_STEPS * step, resolution)
    around = AROUND * (high - low) + (least - (high - low)).clamp(min=0) / 2
    below, above = low - around, high + around
    below = torch.where(low >= 0, below.clamp(min=0), below)
    above = torch.maximum(above, below + least)
    above = torch.where(high <= 1, above.clamp(max=1), above)
    return torch.minimum(below, above - least), above
