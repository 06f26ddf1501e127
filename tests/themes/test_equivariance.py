"""Masks and edits turn and flip with the image. Operators and layers: tests/operator/test_orientation.py."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    SegmentMask,
    abstract,
    adjust_tone,
    colorize,
    diffusion_mask,
    enhance,
    nonlocal_operator,
    refine,
)
from tests.images import photograph

LEVELS = 0.05 / 255
TURNED: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]] = {
    "left and right": (lambda x: x.flip(3), lambda x: x.flip(3)),
    "upside down": (lambda x: x.flip(2), lambda x: x.flip(2)),
    "transposed": (lambda x: x.mT, lambda x: x.mT),
    "rotated": (lambda x: x.rot90(1, (2, 3)), lambda x: x.rot90(-1, (2, 3))),
}


def colours() -> Tensor:
    planes = [photograph(name, 80, 112) for name in ("astronaut", "coffee", "camera")]
    return torch.stack([torch.from_numpy(plane.copy()).float() for plane in planes])[None] * 0.8 + 0.1


def spots(*corners: tuple[int, int]) -> Tensor:
    """A mask (1, 1, 80, 112) of squares of 12 pixels."""
    mask = torch.zeros(1, 1, 80, 112)
    for row, column in corners:
        mask[:, :, row : row + 12, column : column + 12] = 1
    return mask


SPOT, BACK = spots((10, 20), (50, 70)), spots((60, 5), (20, 90))
PAINT = torch.tensor([0.9, 0.2, 0.1]).view(1, 3, 1, 1).expand(1, 3, 80, 112) * SPOT


def mask(image: Tensor, region: Tensor) -> Tensor:
    return diffusion_mask(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), region)


def classes(image: Tensor, regions: Tensor) -> Tensor:
    return SegmentMask()(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), regions)


# Not yet: recolor, colorize by regression, defocus and region_mask, which compare with every n-th scribbled pixel, and
# sharpen, which measures noise in windows at fixed places.
EDITS: dict[str, tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = {
    "abstract": (lambda x: abstract(x, tones=6, edges=0.5), ()),
    "adjust_tone": (lambda x: adjust_tone(x, contrast=1.2, clarity=2.0), ()),
    "colorize by kmeans": (lambda x, s, m: colorize(x[:, :1], s, m, method="kmeans"), (PAINT, SPOT)),
    "diffusion_mask": (mask, (SPOT,)),
    "enhance": (lambda x: enhance(x, torch.tensor([2.0, 1.5, 1.0])), ()),
    "refine": (lambda x, m: refine(0.3 + 0.4 * m, x), (SPOT,)),
    "segment_mask": (classes, (torch.cat([SPOT, BACK], dim=1),)),
}


@pytest.mark.parametrize("turned", TURNED)
@pytest.mark.parametrize("name", EDITS)
def test_edits_and_masks_turn_with_the_image(name: str, turned: str) -> None:
    (edit, others), (turn, back) = EDITS[name], TURNED[turned]
    image = colours()
    with torch.no_grad():
        expected = edit(image, *others)
        result = back(edit(*(turn(planes) for planes in (image, *others))))
    assert (result - expected).abs().max() < LEVELS
