"""Which part of a mask belongs to the object under a scribble: what is connected with it."""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Extent = Literal["near", "object", "everywhere"]
INSIDE = 0.5  # mask from which on a pixel is inside an object, in which pixels are connected
BORDER = 8  # width in pixels of a soft border, which belongs to the nearest object
SMALL = 0.03  # of the pixels of the object; smaller pieces within its border, such as hair, belong to it


@torch.no_grad()
def connected(masks: Tensor, scribbles: Tensor) -> Tensor:
    """Which pixels belong to what is connected with a scribble, (B, K, H, W) of bool.

    Pixels are connected by their sides through those with a mask of at least :data:`INSIDE`.

    Args:
        masks: of K regions, (B, K, H, W).
        scribbles: weights of those on the regions, (B, K, H, W), above 0 where painted.
    """
    painted = scribbles > 0
    inside = (masks >= INSIDE) | painted
    parts = [_parts(*planes) for planes in zip(inside.flatten(0, 1), painted.flatten(0, 1), strict=True)]
    own, others = (torch.stack(planes).view_as(inside).to(masks) for planes in zip(*parts, strict=True))
    for _ in range(BORDER):
        wider = torch.where(others > 0, 0.0, _widened(own))
        others, own = torch.where(wider > 0, 0.0, _widened(others)), wider
    return own > 0


def _parts(inside: Tensor, painted: Tensor) -> tuple[Tensor, Tensor]:
    """The connected components (H, W) that hold a painted pixel, and other ones that are not small beside them."""
    from skimage.measure import label

    numbers = torch.from_numpy(label(inside.cpu().numpy(), connectivity=1)).to(inside.device)
    own = torch.isin(numbers, numbers[painted].unique()) & inside
    large = numbers.flatten().bincount() >= SMALL * own.sum()
    return own, inside & ~own & large[numbers]


def _widened(planes: Tensor) -> Tensor:
    """Planes (B, K, H, W) of 0 and 1 with another pixel around the ones."""
    return F.max_pool2d(planes, 3, 1, 1)
