"""Which part of a mask belongs to the object under a scribble: what is connected with it."""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.torch_internals import is_unreadable

Extent = Literal["near", "object", "everywhere"]
INSIDE = 0.5  # mask from which on a pixel is inside an object, in which pixels are connected
BORDER = 8  # width in pixels of a soft border, which belongs to the nearest object
SMALL = 0.03  # of the pixels of the object; smaller pieces within its border, such as hair, belong to it
SPECK = 0.005  # of the pixels of the object; smaller pieces beyond its border are specks, unless they are painted on


@torch.no_grad()
def connected(masks: Tensor, scribbles: Tensor) -> Tensor:
    """Which pixels belong to what is connected with a scribble, (B, K, H, W) of bool.

    Pixels are connected by their sides through those with a mask of at least :data:`INSIDE`.

    Args:
        masks: of K regions, (B, K, H, W).
        scribbles: weights of those on the regions, (B, K, H, W), above 0 where painted.
    """
    own, others = _pieces(masks, scribbles, SMALL)
    for _ in range(BORDER):
        wider = torch.where(others > 0, 0.0, _widened(own))
        others, own = torch.where(wider > 0, 0.0, _widened(others)), wider
    return own > 0


@torch.no_grad()
def without_specks(masks: Tensor, scribbles: Tensor) -> Tensor:
    """How much of the masks of K regions is left without specks, (B, K, H, W) in [0, 1].

    Specks are pieces smaller than :data:`SPECK` of what is connected with a scribble, and more than :data:`BORDER`
    pixels from that and from larger pieces. It is 0 on them and rises to 1 over as many pixels. Nothing is left out if
    values cannot be read.

    Args:
        masks: of K regions, (B, K, H, W).
        scribbles: weights of those on the regions, (B, K, H, W), above 0 where painted.
    """
    if is_unreadable(masks) or is_unreadable(scribbles):
        return torch.ones_like(masks)
    own, others = _pieces(masks, scribbles, SPECK)
    near = torch.maximum(own, others)
    for _ in range(BORDER):
        near = _widened(near)
    specks = total = (masks >= INSIDE).to(masks) * (1 - near)
    for _ in range(BORDER):
        specks = _widened(specks)
        total = total + specks
    return 1 - (1 - near) * total / (BORDER + 1)


def _pieces(masks: Tensor, scribbles: Tensor, small: float) -> tuple[Tensor, Tensor]:
    """What is connected with a scribble, and other pieces of at least that share of it, (B, K, H, W) of 0 and 1."""
    painted = scribbles > 0
    inside = (masks >= INSIDE) | painted
    planes = zip(inside.flatten(0, 1), painted.flatten(0, 1), strict=True)
    parts = zip(*(_parts(*pair, small) for pair in planes), strict=True)
    own, others = (torch.stack(part).view_as(inside).to(masks) for part in parts)
    return own, others


def _parts(inside: Tensor, painted: Tensor, small: float) -> tuple[Tensor, Tensor]:
    """The connected components (H, W) that hold a painted pixel, and other ones that are not small beside them."""
    from skimage.measure import label

    numbers = torch.from_numpy(label(inside.cpu().numpy(), connectivity=1)).to(inside.device)
    own = torch.isin(numbers, numbers[painted].unique()) & inside
    large = numbers.flatten().bincount() >= small * own.sum()
    return own, inside & ~own & large[numbers]


def _widened(planes: Tensor) -> Tensor:
    """Planes (B, K, H, W) of 0 and 1 with another pixel around the ones."""
    return F.max_pool2d(planes, 3, 1, 1)
