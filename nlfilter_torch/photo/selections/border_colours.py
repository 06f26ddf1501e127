"""Colours on both sides of the borders of a mask, and the mixing ratios of pixels on soft borders."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.photo.picture.colour import dot
from nlfilter_torch.photo.picture.resizing import block_means
from nlfilter_torch.photo.selections.matting import linear_mask, pyramid_levels

REFINEMENT_ROUNDS, HALF_TRUST_CONTRAST = 2, 0.03  # rounds of refinement; colour difference at which it is half trusted
SIDE_RADIUS = 4  # radius over which the colours on each side of a border are averaged, in pixels of the coarsest level
HALF_TRUST_SHARE = 0.02  # share of nearby pixels on one side at which the colour of that side is half trusted
MIN_SIDE_WEIGHT = 1e-4  # smallest weight of a pixel on either side


@dataclass(frozen=True, eq=False)
class Sides:
    """Comparison of pixels with the mean colours of nearby pixels inside and outside a mask.

    Attributes:
        mixture: linear function (B, C+1, H, W), see :func:`linear_mask`, from the colour of a pixel to the fraction of
            the colour inside in it, if it is a mixture of both.
        trust: confidence in that fraction, (B, 1, H, W) in [0, 1]; low where the two colours are similar, or nearly all
            nearby pixels are on one side.
        across: colour inside minus colour outside, (B, C, H, W), towards 0 where nearly all are on one side.
    """

    mixture: Tensor
    trust: Tensor
    across: Tensor

    @staticmethod
    def of(planes: Tensor) -> "Sides":
        """Separate :attr:`planes`."""
        count = (planes.shape[1] - 2) // 2
        return Sides(*planes.split([count + 1, 1, count], dim=1))

    @property
    def planes(self) -> Tensor:
        """All attributes, one below the other, (B, 2C+2, H, W)."""
        return torch.cat([self.mixture, self.trust, self.across], dim=1)

    def refine(self, image: Tensor, mask: Tensor) -> Tensor:
        """Replace border values of a mask (B, 1, H, W) by the mixing ratio of the two colours in each pixel.

        Meant for plain colours on both sides; in textures it would produce patterns.
        """
        decided = (2 * mask - 1).square().square().square()  # 0 and 1 are certain
        return torch.lerp(mask, linear_mask(image, self.mixture).clamp(0.0, 1.0), self.trust * (1 - decided))


def colours_beside(image: Tensor, mask: Tensor) -> Sides:
    """Compare an image (B, C, H, W) with the colours on both sides of the borders of a mask (B, 1, H, W)."""
    step = 1 << pyramid_levels(min(image.shape[-2:]))
    weights = torch.cat([mask, 1 - mask], dim=1).square().square() + MIN_SIDE_WEIGHT  # (B, 2, H, W)
    planes = torch.cat([weights, image * weights[:, :1], image * weights[:, 1:]], dim=1)
    coarse = block_means(planes, step)
    size = 2 * SIDE_RADIUS + 1
    # Separable box sums; pixels outside the picture do not count.
    sums = F.avg_pool2d(coarse, (size, 1), 1, (SIDE_RADIUS, 0))
    sums = F.avg_pool2d(sums, (1, size), 1, (0, SIDE_RADIUS))
    inside, outside = (sums[:, 2:].unflatten(1, (2, -1)) / sums[:, :2].unsqueeze(2)).unbind(1)  # (B, C, h, w)
    least = sums[:, :2].amin(1, keepdim=True)
    beside = torch.cat([outside, inside - outside, least / (least + HALF_TRUST_SHARE)], dim=1)
    if step > 1:
        beside = F.interpolate(beside, image.shape[-2:], mode="bilinear", align_corners=False)
    channels = image.shape[1]
    outside, across, known = beside.split([channels, channels, 1], dim=1)
    contrast = dot(across, across) / channels
    slopes = across / (channels * (contrast + MIN_SIDE_WEIGHT * HALF_TRUST_CONTRAST))
    mixture = torch.cat([slopes, -dot(outside, slopes)], dim=1)
    return Sides(mixture, known * contrast / (contrast + HALF_TRUST_CONTRAST**2), known * across)


def refine_mask(image: Tensor, mask: Tensor) -> Tensor:
    """Refine a mask (B, 1, H, W) by the colours beside its borders, which are computed anew in each round."""
    for _ in range(REFINEMENT_ROUNDS):
        mask = colours_beside(image, mask).refine(image, mask)
    return mask
