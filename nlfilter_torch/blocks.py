"""Cutting the pixels of an image into blocks whose intermediate results stay in the processor's cache."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

# A block of affinities is M x CACHED floats; at M = 100 that is 1.6 MB, which the shared cache of a core holds together
# with its whitened copy. Rows of 4096 floats would start in the same few sets of that cache, and drive each other out;
# those of 4080 are an odd number of its lines. A sweep writes only vectors, so its blocks may be longer, and cost fewer calls.
CACHED = 4080
SWEPT = 16384
# An accelerator wants long blocks; this one bounds the memory of intermediate results at about 1 GB for M = 100.
ACCELERATED = 1 << 21


def large_empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """Uninitialised tensor in the dtype and on the device of ``like``, from memory that is quick to touch first.

    On Linux numpy asks for huge pages where torch does not: a fresh 400 MB costs 50 ms instead of 200.
    """
    if like.device.type != "cpu" or like.dtype not in (torch.float32, torch.float64):
        return like.new_empty(shape)
    return torch.from_numpy(np.empty(shape, np.float64 if like.dtype == torch.float64 else np.float32))


def block_length(batch: int, device: torch.device, length: int) -> int:
    """Pixels in a block of about ``length`` over a whole batch."""
    return max(256, (length if device.type == "cpu" else ACCELERATED) // batch)


def pixel_blocks(count: int, batch: int, device: torch.device, *, length: int = CACHED) -> Iterator[slice]:
    """Slices that cover ``range(count)``, each of about ``length`` pixels over the whole batch."""
    step = block_length(batch, device, length)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def buffered_blocks(factor: Tensor, count: int) -> Iterator[tuple[slice, list[Tensor]]]:
    """The blocks of :func:`pixel_blocks`, each with ``count`` uninitialised (B, M, n) buffers that are used again.

    Args:
        factor: (B, M, N), whose shape, dtype and device the buffers take.
        count: how many buffers.
    """
    batch, marks, pixels = factor.shape
    storage: list[Tensor] = []
    for block in pixel_blocks(pixels, batch, factor.device):
        length = block.stop - block.start
        if not storage or length != storage[0].shape[2]:
            storage = [factor.new_empty(batch, marks, length) for _ in range(count)]
        yield block, storage
