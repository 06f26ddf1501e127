"""What edits measure of a whole picture: each is a sum over its blocks of rows, see :meth:`Source.over`."""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from nlfilter_torch.photo.picture.pixels import Block, Fitted, M, Planes, ends_of, part_of
from nlfilter_torch.photo.picture.resizing import block_counts, block_parts, resized_part
from nlfilter_torch.photo.picture.source import Source

CACHED_SHARE = 1 / 16  # largest share of the memory for planes that an edit reuses
LEAST_SHARE = 1e-3  # share of a block of pixels that must count
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


def mean_of(source: Source[M], fitted: Fitted, function: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Means (B, S, 1, 1) of a function of the image and of an edit's result; the function returns (B, S, h, W)."""
    return source.measured(_mean_of, fitted.then(function))


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
    return torch.where(weights > LEAST_SHARE, weighted / weights.clamp(min=LEAST_SHARE), means), weights


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
