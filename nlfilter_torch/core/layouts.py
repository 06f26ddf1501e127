"""Layouts of results in memory."""

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_transformed


def shaped_as(image: Tensor, planes: Tensor) -> Tensor:
    """View planes (B, C, ...) with the size of an image of as many pixels, (B', C', ...)."""
    return planes.flatten(2).unflatten(2, image.shape[2:])


def in_format_of(result: Tensor, image: Tensor) -> Tensor:
    """Convert a result (B, C, *size) to the dtype of ``image``, and to channels-last if ``image`` is."""
    result = result.to(image.dtype)
    channels_last = {4: torch.channels_last, 5: torch.channels_last_3d}.get(image.ndim)
    if image.is_contiguous() or channels_last is None:
        return result
    # Dynamo cannot trace this, and has no such tensors.
    if not torch.compiler.is_compiling() and any(map(is_transformed, (image, result))):
        return result
    is_last = image.is_contiguous(memory_format=channels_last)
    return result.contiguous(memory_format=channels_last) if is_last else result
