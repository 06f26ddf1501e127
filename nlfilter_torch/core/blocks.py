"""Planes of pixels: blocks that fit the cache, inner parts, batches folded into channels, and a sample."""

from collections.abc import Iterator

import torch
from torch import Tensor

# Pixels in a block, per core. A block of affinities is M x CACHED floats, 1.6 MB for M = 100, and stays in a cache near
# its core until it is multiplied by the inverse Cholesky factor; at half the length twice as many calls take as long.
# Rows of 4096 floats would map to the same few cache sets and evict each other; 4080 floats are an odd number of cache
# lines. A sweep writes only vectors, so its blocks
# may be longer (SWEPT), which saves calls; torch divides vectors of 32768 numbers or more among cores: two such blocks.
CACHED = 4080
SWEPT = 16400
# Accelerators need long blocks; this length limits intermediate results to about 1 GB for M = 100.
ACCELERATED = 1 << 21


def cores() -> int:
    """Number of threads torch uses for one operation; 1 while compiling, when it cannot be queried."""
    return 1 if torch.compiler.is_compiling() else torch.get_num_threads()


def strip_count(batch: int, pixels: int, device: torch.device) -> int:
    """Number of strips to divide an image into: one per core; 1 for a batch or an indivisible number of pixels."""
    count = cores()
    return count if batch == 1 and device.type == "cpu" and pixels % count == 0 else 1


def strips(planes: Tensor, count: int) -> Tensor:
    """View (1, C, N) as a batch (P, C, N / P) of ``count`` strips; if ``count`` is 1, return ``planes`` unchanged.

    Each core then works on its own strip, and intermediate results stay in its own cache.
    """
    return planes if count == 1 else planes[0].unflatten(1, (count, -1)).transpose(0, 1)


def block_length(batch: int, device: torch.device, length: int) -> int:
    """Number of pixels of each image in a block of about ``length`` pixels per core."""
    # A program is traced through every block; there, caches are its compiler's concern.
    blocked = device.type == "cpu" and not torch.compiler.is_compiling()
    return max(256, (length * cores() if blocked else ACCELERATED) // max(batch, 1))


def pixel_blocks(count: int, batch: int, device: torch.device, *, length: int = CACHED) -> Iterator[slice]:
    """Generate slices that cover ``range(count)``, each with about ``length`` pixels per core over the whole batch."""
    step = block_length(batch, device, length)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def buffered_blocks(factor: Tensor, count: int) -> Iterator[tuple[slice, list[Tensor]]]:
    """Generate the blocks of :func:`pixel_blocks` with ``count`` uninitialised (B, M, n) buffers, which are reused."""
    batch, landmarks, pixels = factor.shape
    storage: list[Tensor] = []
    for block in pixel_blocks(pixels, batch, factor.device):
        length = block.stop - block.start
        if not storage or length != storage[0].shape[2]:
            storage = [factor.new_empty(batch, landmarks, length) for _ in range(count)]
        yield block, storage


def fold_batch(image: Tensor, batch: int) -> Tensor:
    """Reshape images (b, C, *size) to (batch, C', N) for an operator of ``batch`` images; either batch may be 1.

    Several images for one operator become channels, so that the factor is read once.

    Raises:
        ValueError: if the batches differ and neither is 1.
    """
    if image.shape[0] != batch and 1 not in (image.shape[0], batch):
        raise ValueError(
            f"image must have batch size 1 or that of the operator, {batch}, got {image.shape[0]}; "
            "build the operator from one guide per image"
        )
    if batch == 1:
        return image.flatten(2).flatten(0, 1).unsqueeze(0)
    return image.flatten(2).expand(batch, -1, -1)


def unfold_batch(planes: Tensor, images: int, size: tuple[int, ...]) -> Tensor:
    """Invert :func:`fold_batch` for stacks (batch, k, C', N): (B, k, C, *size), where B is the larger batch."""
    if planes.shape[0] == 1:
        planes = planes.squeeze(0).unflatten(1, (images, -1)).transpose(0, 1)
    return planes.unflatten(-1, size)


def weighted(values: Tensor, weights: Tensor | None) -> Tensor:
    """Multiply values (B, ..., N) by the number of pixels that each point represents, (B, N); None means one each."""
    if weights is None:
        return values
    return values * weights.view(weights.shape[0], *[1] * (values.ndim - 2), -1).to(values)


def for_planes(values: Tensor, dimensions: int) -> Tensor:
    """View values (...) as (..., 1, ..., 1), to be broadcast over planes of so many dimensions."""
    return values.reshape(*values.shape, *[1] * dimensions)


def root_weighted(scaling: Tensor, weights: Tensor | None) -> Tensor:
    """``d sqrt(w)``, (B, N): the scaling of the symmetric matrix with the same eigenvalues as W."""
    return scaling if weights is None else scaling * weights.sqrt()


def reflected(places: Tensor, length: int) -> Tensor:
    """Indices of pixels at any places along an axis, which is continued by reflection beyond both ends."""
    places = places % max(1, 2 * length - 2)
    return torch.minimum(places, 2 * length - 2 - places)


def order_by(first: Tensor, second: Tensor) -> Tensor:
    """Indices (B, n) that sort values (B, n), and where these are equal others (B, n); they turn with an image."""
    order = second.argsort(1)
    return order.gather(1, first.gather(1, order).argsort(dim=1, stable=True))


def symmetric_places(size: tuple[int, int], count: int, generator: torch.Generator) -> Tensor:
    """Draw about ``count`` pixels of an image (H, W), together with their mirror images: row-major indices (n,).

    The same pixels are drawn of an image that is flipped, transposed or rotated by 90 degrees, in another order.
    Some may be drawn twice.
    """
    short, long = sorted(size)
    orientations = 8 if short == long else 4
    places = torch.randint(short * long, (max(1, count // orientations),), generator=generator).to(generator.device)
    return mirrored(places // long, places % long, size)


def mirrored(short: Tensor, long: Tensor, size: tuple[int, int]) -> Tensor:
    """Row-major indices (n,) of places (m,) along the short and the long side of an image (H, W), and of their mirrors.

    There are four images of a place, or eight in a square.
    """
    height, width = size
    down, across = (short, long) if height <= width else (long, short)
    pairs = [(down, across), (across, down)] if height == width else [(down, across)]
    return torch.cat(
        [
            (height - 1 - row if upset else row) * width + (width - 1 - column if turned else column)
            for row, column in pairs
            for upset in (False, True)
            for turned in (False, True)
        ]
    )


def stratified(pixels: int, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` pixels, one from each of ``count`` equal intervals of pixel indices.

    They are distinct if an interval has one pixel or at least two; between that, some may be drawn twice.
    In ascending order, since gathering them takes a third of the time that it takes in random order.
    """
    device = generator.device
    offsets = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
    return ((torch.arange(count, device=device) + offsets) * (pixels / count)).long().clamp_(max=pixels - 1)


Inner = tuple[slice, slice]  # rows and columns
EVERYWHERE: Inner = (slice(None), slice(None))


def shaped_as(image: Tensor, planes: Tensor) -> Tensor:
    """View planes (B, C, ...) with the size of an image of as many pixels, (B', C', ...)."""
    return planes.flatten(2).unflatten(2, image.shape[2:])
