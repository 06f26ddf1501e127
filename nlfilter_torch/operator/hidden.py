"""Pixels of weight 0: their values, read by patches of others, come from pixels that count; batches padded by them."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_dtype, check_finite, described

NEAR = 32  # pixels of its row or column up to which :func:`fill_nearby` looks for one that counts
MIRRORED = 8  # pixels that are continued by their mirror images
#: Rows around a hidden pixel that its value by :func:`fill_nearby` depends on.
REACH = 2 * (NEAR + MIRRORED + 1)


def fill_hidden(planes: Tensor, counts: Tensor, margin: int, *, mirrored: bool = True) -> Tensor:
    """Pad planes by ``margin`` pixels on all sides, and replace there and at hidden pixels what is unknown.

    A hidden pixel takes the values of its mirror images at the nearest pixels that count, in both directions of its row
    and of its column, weighted by the inverse distance. Where no pixel of row and column counts, this is repeated with
    the filled ones. Reflection turns into replication where ``margin`` pixels or fewer count in a line. A rectangle of
    pixels that count is thus continued as an image of that size is padded.

    Args:
        planes: (B, C, ...), with any number of axes of pixels.
        counts: (B or 1, 1, ...), true where a pixel counts; some pixel of every image must.
        margin: half a patch.
        mirrored: whether to reflect; replication otherwise.

    Returns:
        Planes that are longer by twice the margin along each axis of pixels; differentiable.
    """
    axes = range(2, planes.ndim)
    widths = (margin, margin) * len(axes)
    planes = F.pad(torch.where(counts, planes, 0.0), widths)
    counts = F.pad(counts.byte(), widths).bool()
    for _ in axes:
        planes, counts = _filled_along_axes(planes, counts, margin if mirrored else 0)
    return planes


def fill_nearby(planes: Tensor, counts: Tensor) -> Tensor:
    """Replace hidden pixels of planes (B, C, H, W) by pixels that count nearby, as :func:`fill_hidden`; else by 0.

    Where no pixel of row and column within :data:`NEAR` counts, this is repeated once with the filled ones. A value
    depends on :data:`REACH` rows around a pixel at most, so that parts of an image can be filled by themselves.
    ``counts`` is (B or 1, 1, H, W), true where a pixel counts. Differentiable.
    """
    planes = torch.where(counts, planes, 0.0)
    for _ in range(2):
        if bool(counts.all()):
            break
        planes, counts = _filled_along_axes(planes, counts, MIRRORED, NEAR)
    return planes


def _filled_along_axes(
    planes: Tensor, counts: Tensor, reach: int, farthest: int | None = None
) -> tuple[Tensor, Tensor]:
    """Fill pixels of rows and columns with pixels that count; return the planes and what counts now.

    Up to ``reach`` pixels are mirrored. Pixels farther than ``farthest`` are not used.
    """
    total, shares = torch.zeros_like(planes), torch.zeros_like(planes[:, :1])
    for axis in range(2, planes.ndim):
        for backwards in (False, True):
            source, distance = _mirror_images(counts, axis, reach, backwards=backwards)
            near = distance > 0 if farthest is None else (distance > 0) & (distance <= farthest)
            share = torch.where(near, 1.0 / distance.clamp(min=1), 0.0).to(planes)
            total = total + share * planes.gather(axis, source.expand(*planes.shape[:2], *source.shape[2:]))
            shares = shares + share
    filled = total / torch.where(shares > 0, shares, 1.0)
    return torch.where(counts, planes, filled), counts | (shares > 0)


def _mirror_images(counts: Tensor, axis: int, reach: int, *, backwards: bool) -> tuple[Tensor, Tensor]:
    """Indices along an axis of mirror images at the last pixel before that counts, and distances to that pixel.

    Both have the shape of ``counts``. The distance is 0 at pixels that count, and where no pixel before counts.
    """
    length = counts.shape[axis]
    if backwards:
        source, distance = _mirror_images(counts.flip(axis), axis, reach, backwards=False)
        return (length - 1 - source).flip(axis), distance.flip(axis)
    index = torch.arange(length, device=counts.device).view(-1, *[1] * (counts.ndim - 1 - axis)).expand_as(counts)
    last = torch.where(counts, index, -1).cummax(axis).values
    hidden = torch.where(counts, -1, index).cummax(axis).values
    nearest = last.clamp(min=0)
    run = nearest - hidden.gather(axis, nearest)  # number of pixels that count, up to the nearest
    distance = torch.where(last >= 0, index - last, 0)
    return nearest - torch.where(run > reach, distance.clamp(max=reach), 0), distance


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
        check_finite(image, "images")
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
