"""Masks and edits turn and flip with the image. Operators and layers: tests/operator/test_orientation.py."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from nlfilter_torch import SegmentMask, diffusion_mask, nonlocal_operator, refine
from nlfilter_torch.photo import (
    abstract,
    adjust_tone,
    apply_look,
    colorize,
    defocus,
    enhance,
    filter_frames,
    recolor,
    region_mask,
    sharpen,
)
from tests.images import photograph

LEVELS = 0.05 / 255
# Where the colours on both sides of a border are nearly equal, recolor multiplies rounding errors of its masks by 100.
RECOLORED_LEVELS = 0.15 / 255
# All eight orientations are compositions of these two.
TURNED: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]] = {
    "left and right": (lambda x: x.flip(3), lambda x: x.flip(3)),
    "rotated": (lambda x: x.rot90(1, (2, 3)), lambda x: x.rot90(-1, (2, 3))),
}


HEIGHT, WIDTH = 83, 111
ALPHA = torch.tensor([2.0, 1.5, 1.0])


def colours() -> Tensor:
    planes = [photograph(name, HEIGHT, WIDTH) for name in ("astronaut", "coffee", "camera")]
    return torch.stack([torch.from_numpy(plane.copy()).float() for plane in planes])[None] * 0.8 + 0.1


def spots(*corners: tuple[int, int]) -> Tensor:
    """A mask (1, 1, H, W) of squares of 12 pixels."""
    mask = torch.zeros(1, 1, HEIGHT, WIDTH)
    for row, column in corners:
        mask[:, :, row : row + 12, column : column + 12] = 1
    return mask


SPOT, BACK = spots((10, 20), (50, 70)), spots((60, 5), (20, 90))
BOTH = torch.cat([SPOT, BACK], dim=1)
PAINT = torch.tensor([0.9, 0.2, 0.1]).view(1, 3, 1, 1) * SPOT
COLOURS = PAINT + torch.tensor([0.1, 0.3, 0.8]).view(1, 3, 1, 1) * BACK
LOOK = {"bands": (1.2,) * 7, "texture": (1.3,) * 6, "stretch": (0.5, 0.2, 0.2), "local": (0.1,) * 8}


def mask(image: Tensor, region: Tensor) -> Tensor:
    return diffusion_mask(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), region)


def weighted_mask(image: Tensor, region: Tensor, hidden: Tensor) -> Tensor:
    operator = nonlocal_operator(image, photometric_bandwidth=0.1, weights=1 - hidden)
    return diffusion_mask(operator.spectrum(), region)


def classes(image: Tensor, regions: Tensor, temperature: float) -> Tensor:
    layer = SegmentMask(temperature=temperature)
    return layer(nonlocal_operator(image, photometric_bandwidth=0.1).spectrum(), regions)


def frames(image: Tensor) -> Tensor:
    return next(filter_frames([image, image.square()], ALPHA, references=[image]))


EDITS: dict[str, tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = {
    "abstract": (lambda x: abstract(x, tones=6, edges=0.5), ()),
    "adjust_tone": (lambda x: adjust_tone(x, contrast=1.2, clarity=2.0), ()),
    "apply_look": (lambda x: apply_look(x, alpha=(1.5, 1.2, 1.0), **LOOK), ()),
    "colorize": (lambda x, s, m: colorize(x[:, :1], s, m), (COLOURS, SPOT + BACK)),
    "colorize by kmeans": (lambda x, s, m: colorize(x[:, :1], s, m, method="kmeans"), (COLOURS, SPOT + BACK)),
    "defocus": (defocus, (SPOT,)),
    "diffusion_mask": (mask, (SPOT,)),
    "diffusion_mask with hidden pixels": (weighted_mask, (SPOT, BACK)),
    "enhance": (lambda x: enhance(x, ALPHA), ()),
    "enhance with masks": (lambda x, m: enhance(x, torch.stack([ALPHA, ALPHA.flip(0)]), regions=m), (BOTH,)),
    "filter_frames": (frames, ()),
    "recolor": (recolor, (PAINT, SPOT)),
    "recolor with keep": (lambda x, s, m, k: recolor(x, s, m, keep=k), (PAINT, SPOT, BACK)),
    "refine": (lambda x, m: refine(0.3 + 0.4 * m, x), (SPOT,)),
    "region_mask": (region_mask, (SPOT,)),
    "region_mask with a background": (region_mask, (SPOT, BACK)),
    "segment_mask": (partial(classes, temperature=0.0), (BOTH,)),
    "segment_mask with a temperature": (partial(classes, temperature=0.3), (BOTH,)),
    "sharpen": (lambda x: sharpen(x, amount=3.0), ()),
}


@pytest.mark.parametrize("name", EDITS)
def test_edits_and_masks_turn_with_the_image(name: str) -> None:
    (edit, others), image = EDITS[name], colours()
    limit = RECOLORED_LEVELS if name == "recolor" else LEVELS
    with torch.no_grad():
        expected = edit(image, *others)
        for turned, (turn, back) in TURNED.items():
            result = back(edit(*(turn(planes) for planes in (image, *others))))
            assert (result - expected).abs().max() < limit, turned
