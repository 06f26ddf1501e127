"""What edits measure of a whole picture: each is a sum over its blocks of rows, see :meth:`Source.over`.

The last is the range that a picture uses. Edits work in [0, 1], and their thresholds are levels of 8 bits. A picture
that uses less than a quarter of [0, 1] (medical and astronomical pictures of 16 bits, underexposed ones), or goes far
beyond it (floats up to 65535), is seen by them with its range stretched to [0, 1], and what they change is added to the
picture in its own units. The range is that of a sample of the pixels, so that a few very bright ones do not count. What
lies far outside keeps its distance.
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import mirrored
from nlfilter_torch.core.checks import FAR_OUTSIDE
from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.photo.declared.rows import WHITE
from nlfilter_torch.photo.picture.pixels import Block, Fitted, M, Planes, WorkingRange, ends_of, part_of
from nlfilter_torch.photo.picture.resizing import SMALL_SHARE, block_counts, block_parts, resized_part
from nlfilter_torch.photo.picture.source import Rest, Source, at, sampled_places, seeded

CACHED_SHARE = 1 / 16  # largest share of the memory for planes that an edit reuses
NARROW = 0.25  # share of [0, 1] below which the range in use is stretched
RARE = 0.005  # share of the values on either side that do not count for the range
AROUND = 0.125  # by which the range is extended on both sides, as a share of itself
LEAST_STEPS = 32  # steps of the depth that the range comprises at least
NEARLY = 1e-2  # distance from a whole number of steps that is due to rounding
LINES = 64  # rows, and columns, whose crossings show whether a picture uses its range
Sums = tuple[Tensor, Tensor | float]  # over pixels: of values times weights, (B, C, 1, 1), and of weights


def mean(source: Source[M], planes: Planes) -> Tensor:
    """Means (B, C, 1, 1) of planes over all pixels."""
    return source.measured(_mean, planes)


def _mean(source: Source[M], planes: Planes) -> Tensor:
    return _quotient(source.over(_sums_of, "Averaging", planes), source.dtype)


def _sums_of(block: Block, planes: Planes) -> Sums:
    return sums(planes(block), block.weights)


def sums(values: Tensor, weights: Tensor | None) -> Sums:
    """Sums over pixels of values (B, C, H, W), with weights (B or 1, 1, H, W), and of the weights, in float64."""
    if weights is None:
        return values.sum((2, 3), keepdim=True, dtype=torch.float64), values.shape[2] * values.shape[3]
    weighted, total = ((part.sum((2, 3), keepdim=True, dtype=torch.float64)) for part in (values * weights, weights))
    return weighted, total


def _quotient(parts: Iterable[Sums], dtype: torch.dtype) -> Tensor:
    values, weights = zip(*parts, strict=True)
    return (sum(values) / sum(weights)).to(dtype)


def mean_of(
    source: Source[M], fitted: Fitted, function: Callable[[Tensor, Tensor, *Rest], Tensor], *arguments: *Rest
) -> Tensor:
    """Means (B, S, 1, 1) of a function of the image and of an edit's result; the function returns (B, S, h, W)."""
    return source.measured(_mean_of, fitted.then(function, *arguments))


def _mean_of(source: Source[M], fitted: Fitted) -> Tensor:
    return _quotient((sums(*part) for part in source.emit(fitted)), source.dtype)


def ends(source: Source[M], planes: Planes) -> tuple[Tensor, Tensor]:
    """Least and largest values (B, C, 1, 1) of planes over all pixels that count."""
    least, largest = source.measured(_ends, planes)
    return least, largest


def _ends(source: Source[M], planes: Planes) -> Tensor:
    parts = torch.stack(list(source.over(_ends_of, "Finding black and white", planes)))
    return torch.stack([parts[:, 0].amin(0), parts[:, 1].amax(0)])


def _ends_of(block: Block, planes: Planes) -> Tensor:
    return torch.stack(ends_of(planes(block), block.weights))


def everywhere(source: Source[M], fitted: Fitted) -> Tensor:
    """Result (B, C, H, W) of an edit at all pixels, for pictures that are small enough."""
    parts = [values for values, _ in source.emit(fitted)]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=2)


def check_in_memory(source: Source[M], sentence: str) -> None:
    """Raise ValueError with this sentence if the picture is read in parts."""
    if math.isfinite(source.memory):
        raise ValueError(sentence)


def cached(source: Source[M], fitted: Fitted) -> Fitted:
    """Compute the result of an edit and keep it in memory, if there is room; else it is computed on every use."""
    if math.prod(source.size) * source.channels * source.dtype.itemsize > CACHED_SHARE * source.memory:
        return fitted
    return Fitted(part_of(everywhere(source, fitted)))


def shrunk(source: Source[M], planes: Planes, size: tuple[int, int]) -> Tensor:
    """Planes (B, C, h, w) of all pixels in a smaller size."""
    return _joined(source.over(_resized, "Reducing", planes, source.size, size), size[0])


def _resized(block: Block, planes: Planes, size: tuple[int, int], wanted: tuple[int, int]) -> tuple[int, Tensor]:
    return resized_part(planes(block), block.first // block.width, size, wanted)


def reduced(source: Source[M], planes: Planes, step: float) -> Tensor:
    """Means (B, C, H / step, W / step), sizes rounded up, over blocks of ``step`` x ``step`` pixels that count.

    Where none of a block counts, all do. The step is an integer except for pictures in memory.
    """
    return reduced_with_weights(source, planes, step)[0]


def reduced_with_weights(source: Source[M], planes: Planes, step: float) -> tuple[Tensor, Tensor | None]:
    """The same, and the means (B, 1, H / step, W / step) of how much the pixels count; None is 1 each."""
    rows = block_counts(source.size, step)[0]
    parts = list(source.over(_reduced, "Reducing", planes, source.size, step, step=max(1, int(step))))
    means = _joined(((first, means) for first, means, _ in parts), rows).to(source.dtype)
    counted = [(first, part) for first, _, part in parts if part is not None]
    if not counted:
        return means, None
    weighted, weights = _joined(counted, rows).to(source.dtype).tensor_split([-1], dim=1)
    return torch.where(weights > SMALL_SHARE, weighted / weights.clamp(min=SMALL_SHARE), means), weights


def _reduced(block: Block, planes: Planes, size: tuple[int, int], step: float) -> tuple[int, Tensor, Tensor | None]:
    """The first row that a block contributes to, and its part of the means: of planes, and those that count."""
    values, weights, start = planes(block), block.weights, block.first // block.width
    first, means = block_parts(values, start, size, step)
    if weights is None:
        return first, means, None
    return first, means, block_parts(torch.cat([values * weights, weights], dim=1), start, size, step)[1]


def _joined(parts: Iterable[tuple[int, Tensor]], rows: int) -> Tensor:
    """Sum of parts (B, C, n, w), each from a row on."""
    total: Tensor | None = None
    for first, part in parts:
        if total is None and part.shape[2] == rows:
            total = part
            continue
        if total is None:
            total = part.new_zeros(*part.shape[:2], rows, part.shape[3])
        total[:, :, first : first + part.shape[2]] += part
    assert total is not None  # for mypy; a picture has a row
    return total


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
    for white in reversed(WHITE.values()):  # of the depths whose values have steps
        steps = values * white
        is_whole = ((steps - steps.round()).abs() < NEARLY).all(1)
        step = torch.where(is_whole, 1 / white, step)
    return torch.cat([ends, step[None]])


def _is_unusual(used: Tensor) -> Tensor:
    """Whether pictures with these results of :func:`_used_at` are seen in the range that they use, (B,)."""
    low, high, _ = used
    return ((high - low < NARROW) | (low < -FAR_OUTSIDE) | (high > FAR_OUTSIDE)) & (high > low)


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
