"""Layouts of results in memory."""

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_transformed


def in_format_of(result: Tensor, image: Tensor) -> Tensor:
    """Convert a result (B, C, H, W) to the dtype of ``image``, and to channels-last if ``image`` is."""
    result = result.to(image.dtype)
    if image.is_contiguous():
        return result
    # Dynamo cannot trace this, and has no such tensors.
    if not torch.compiler.is_compiling() and any(map(is_transformed, (image, result))):
        return result
    channels_last = image.is_contiguous(memory_format=torch.channels_last)
    return result.contiguous(memory_format=torch.channels_last) if channels_last else result
