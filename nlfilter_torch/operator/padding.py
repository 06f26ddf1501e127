"""Batches of images of different sizes."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_dtype, described


def pad_images(images: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Pad images of different sizes to a batch, with the weights of its pixels.

    Layers, operators and masks that are computed with these weights give for each image what they give for the image
    alone; see ``weights`` of :func:`nonlocal_operator`. As a part of a ``collate_fn``, it makes batches of the images
    of a data set.

    Args:
        images: B images (C, H, W) with the same channels, dtype and device, or volumes (C, D, H, W).

    Returns:
        The batch (B, C, H, W) of the largest height and width, with the images at the top left and zeros elsewhere, and
        weights (B, 1, H, W) in its dtype, 1 at pixels of the images and 0 elsewhere. Differentiable in the images.

    Raises:
        TypeError, ValueError: if ``images`` is no list of such tensors.

    Example:
        >>> batch, weights = pad_images([torch.ones(3, 5, 8), torch.ones(3, 7, 6)])
        >>> batch.shape, weights.sum((1, 2, 3))
        (torch.Size([2, 3, 7, 8]), tensor([40., 42.]))
    """
    if not isinstance(images, list | tuple) or not images:
        raise TypeError(f"images must be a list of one or more tensors, got {described(images)}; pass [image]")
    for image in images:
        check_dtype(image, "images", "divide integer pixels by the value of white, such as 255")
    first = images[0]
    for image in images:
        alike = (image.ndim, image.shape[:1], image.dtype, image.device) == (
            first.ndim, first.shape[:1], first.dtype, first.device,
        )  # fmt: skip
        if not alike or first.ndim not in (3, 4):
            shapes = ", ".join(str(tuple(part.shape)) for part in (first, image))
            raise ValueError(
                f"images must have shape (C, H, W), with the same channels, dtype and device, got {shapes}; convert "
                "them, and remove the dimension of a batch with image[0]"
            )
    size = [max(lengths) for lengths in zip(*(image.shape[1:] for image in images), strict=True)]
    widths = [
        [width for length, most in zip(image.shape[:0:-1], size[::-1], strict=True) for width in (0, most - length)]
        for image in images
    ]
    batch = torch.stack([F.pad(image, width) for image, width in zip(images, widths, strict=True)])
    weights = [F.pad(torch.ones_like(image[:1]), width) for image, width in zip(images, widths, strict=True)]
    return batch, torch.stack(weights)
