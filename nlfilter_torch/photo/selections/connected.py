"""Which part of a mask belongs to the object under a scribble: what is connected with it."""

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

Extent = Literal["near", "object", "everywhere"]
EXTENTS: tuple[Extent, ...] = get_args(Extent)
INSIDE = 0.5  # mask from which on a pixel is inside an object, in which pixels are connected
BORDER = 8  # width in pixels of a soft border, which belongs to the nearest object


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
    own = torch.stack([_reached(*planes) for planes in zip(inside.flatten(0, 1), painted.flatten(0, 1), strict=True)])
    own = own.view_as(inside).to(masks)
    others = inside.to(masks) - own
    for _ in range(BORDER):
        wider = torch.where(others > 0, 0.0, _widened(own))
        others, own = torch.where(wider > 0, 0.0, _widened(others)), wider
    return own > 0


def _reached(inside: Tensor, painted: Tensor) -> Tensor:
    """The connected components (H, W) that hold a painted pixel."""
    from skimage.measure import label

    numbers = torch.from_numpy(label(inside.cpu().numpy(), connectivity=1)).to(inside.device)
    return torch.isin(numbers, numbers[painted].unique()) & inside


def _widened(planes: Tensor) -> Tensor:
    """Planes (B, K, H, W) of 0 and 1 with another pixel around the ones."""
    return F.max_pool2d(planes, 3, 1, 1)
