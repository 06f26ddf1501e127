"""Planes of pixels: cut into blocks that stay in the processor's cache, folded with their batch, and weighted."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.values import is_hidden

# Pixels in a block, per core. A block of affinities is M x CACHED floats, 0.8 MB for M = 100, and stays in the cache of
# its core until it is multiplied by the inverse Cholesky factor. Rows of 2048 floats would map to the same few cache
# sets and evict each other; 2032 floats are an odd number of cache lines. A sweep writes only vectors, so its blocks
# may be longer, which saves calls; torch splits vectors among cores from 32768 numbers on, two of these blocks.
CACHED = 2032
SWEPT = 16400
# Accelerators need long blocks; this length limits intermediate results to about 1 GB for M = 100.
ACCELERATED = 1 << 21
LINE = 16  # numbers: one cache line in float32, two in float64


def large_empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Uninitialised tensor in the dtype and on the device of ``like``, in memory that is fast to write first.

    On Linux numpy requests huge pages and torch does not: the first write of 400 MB takes 50 ms instead of 200. The
    tensor is aligned to a cache line, so that whole lines can be written without being read first.
    """
    if is_hidden(like) or like.dtype not in (torch.float32, torch.float64):
        return like.new_empty(shape)
    numbers = np.empty(math.prod(shape) + LINE, np.float64 if like.dtype == torch.float64 else np.float32)
    start = -(numbers.ctypes.data // numbers.itemsize) % LINE
    return torch.from_numpy(numbers[start : start + math.prod(shape)].reshape(shape))


def cores() -> int:
    """Number of threads torch uses for one operation; 1 while compiling, where it cannot be queried."""
    return 1 if torch.compiler.is_compiling() else torch.get_num_threads()


def strip_count(batch: int, pixels: int, device: torch.device) -> int:
    """Number of strips of an image: one per core, but one for a batch or a number of pixels that does not divide."""
    count = cores()
    return count if batch == 1 and device.type == "cpu" and pixels % count == 0 else 1


def strips(planes: Tensor, count: int) -> Tensor:
    """A view of (1, C, N) as a batch (P, C, N / P) of strips; a batch (B, C, N) is returned as it is.

    Each core then works on its own strip, and finds what it has just computed in its own cache.
    """
    return planes if count == 1 else planes[0].unflatten(1, (count, -1)).transpose(0, 1)


def block_length(batch: int, device: torch.device, length: int) -> int:
    """Pixels of each image in a block of about ``length`` pixels per core."""
    return max(256, (length * cores() if device.type == "cpu" else ACCELERATED) // batch)


def pixel_blocks(count: int, batch: int, device: torch.device, *, length: int = CACHED) -> Iterator[slice]:
    """Slices that cover ``range(count)``, each with about ``length`` pixels per core over the whole batch."""
    step = block_length(batch, device, length)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def buffered_blocks(factor: Tensor, count: int) -> Iterator[tuple[slice, list[Tensor]]]:
    """The blocks of :func:`pixel_blocks`, each with ``count`` uninitialised (B, M, n) buffers that are reused.

    Args:
        factor: (B, M, N), from which the buffers take shape, dtype and device.
        count: number of buffers.
    """
    batch, landmarks, pixels = factor.shape
    storage: list[Tensor] = []
    for block in pixel_blocks(pixels, batch, factor.device):
        length = block.stop - block.start
        if not storage or length != storage[0].shape[2]:
            storage = [factor.new_empty(batch, landmarks, length) for _ in range(count)]
        yield block, storage


def fold_batch(image: Tensor, batch: int) -> Tensor:
    """Images (b, C, H, W) as (batch, C', N) for an operator of ``batch`` images; either batch may be 1.

    Several images under one operator become channels, so that the factor is read once.

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


def unfold_batch(planes: Tensor, images: int, size: tuple[int, int]) -> Tensor:
    """Stacks (batch, k, C', N) back to (B, k, C, H, W), B the larger batch: the inverse of :func:`fold_batch`."""
    if planes.shape[0] == 1:
        planes = planes.squeeze(0).unflatten(1, (images, -1)).transpose(0, 1)
    return planes.unflatten(-1, size)


def weighted(values: Tensor, weights: Tensor | None) -> Tensor:
    """Values (B, ..., N) times the number of pixels that each point stands for, (B, N); None is one each."""
    if weights is None:
        return values
    return values * weights.view(weights.shape[0], *[1] * (values.ndim - 2), -1).to(values)


def root_weighted(scaling: Tensor, weights: Tensor | None) -> Tensor:
    """``d sqrt(w)``, (B, N): the scaling of the symmetric matrix that has the eigenvalues of W."""
    return scaling if weights is None else scaling * weights.sqrt()
