"""Objects cut out by their masks: transparent pictures in the colours of the objects alone.

A pixel on a soft border shows a mixture ``I = a F + (1 - a) B`` of object and background. Over another background the
old one would shine through as a rim, so the colours F of the object are estimated: of all pairs F, B that explain the
picture, the smoothest, whose colours may change most where the mask does not.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_same_size, check_unit_range
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.photo.declared.shared_parameters import VIEWING_SIZE
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.measuring import shrunk
from nlfilter_torch.photo.picture.pixels import M, Pixels, Planes, WorkingRange, corner, part_of
from nlfilter_torch.photo.picture.resizing import enlarged
from nlfilter_torch.photo.picture.source import Fitted, Source
from nlfilter_torch.photo.picture.viewing import viewed_size

VIEWING = VIEWING_SIZE.default_number  # megapixels, at which colours are estimated
LEAST_WEIGHT, BORDER_WEIGHT = 1e-4, 0.1  # of the difference of neighbours: anywhere, and times that of their masks
COARSE, COARSE_ROUNDS, ROUNDS = 32, 10, 3  # pixels of a coarse level along its long side, and rounds there and beyond


def cutout(image: Tensor, mask: Tensor) -> Tensor:
    """An object, cut out by its mask, in colours freed of those of the background behind soft borders.

    Laid over another background, ``mask * colours + (1 - mask) * background``, it has no rim of the old one. The
    colours are estimated together with those of the background, from coarse to fine, such that both explain the image
    and are as smooth as it allows; larger images than the viewing size, at that size first.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        mask: (B, 1, H, W) in [0, 1], such as that of :func:`region_mask`; (1, 1, H, W) for all images.

    Returns:
        (B, 4, H, W), RGB, not multiplied by the mask, and the mask, to be written as a transparent picture. Where the
        mask is 1, the colours are those of the image, to rounding; where it is 0, those of the object nearby.
        Differentiable in image and mask.

    Raises:
        TypeError, ValueError: if the sizes differ, or the mask leaves [0, 1].

    Example:
        >>> mask = torch.linspace(0, 1, 16).expand(1, 1, 16, 16)
        >>> red, blue = torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])
        >>> image = mask * red.view(3, 1, 1) + (1 - mask) * blue.view(3, 1, 1)
        >>> colours = cutout(image, mask)[:, :3]
        >>> bool((colours[..., 8:] - red.view(3, 1, 1)).abs().max() < 0.05)
        True
    """
    check_image(image, "image")
    if image.shape[1] not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels, got {image.shape[1]}; select 1 or 3")
    check_image(mask, "mask", channels=1, batch=len(image))
    check_same_size(mask, (image.shape[2], image.shape[3]), "mask", "image")
    check_unit_range(mask, "mask")
    return _cutout(image, mask)


@full_precision
def _cutout(image: Tensor, mask: Tensor) -> Tensor:
    source = InMemory(image.to(working_dtype(image)))
    planes = source.all(Fitted(Cutout.of(source, part_of(mask.to(source.image).expand(len(image), -1, -1, -1)))))
    colours, opacity = planes.tensor_split([-1], dim=1)
    return torch.cat([colours.expand(-1, 3, -1, -1), opacity], dim=1).to(image.dtype)


@dataclass(frozen=True, eq=False)
class Cutout:
    """The colours of the object of a mask at any pixels of a picture.

    Attributes:
        masks: (B, 1, h, w) at given pixels.
        colours: of object and background, (B, 2 C, h, w), at the viewing size.
        steps: height and width of one of its pixels, in pixels of the picture.
        working: the range in which ``masks`` and ``colours`` see the picture; None is as it is.
    """

    masks: Planes
    colours: Tensor
    steps: tuple[float, float]
    working: WorkingRange | None = None

    @staticmethod
    def of(source: Source[M], masks: Planes, working: WorkingRange | None = None) -> "Cutout":
        """Estimate the colours at the viewing size, of a picture as it is seen in a range."""
        size = viewed_size(source.size, VIEWING)
        planes = shrunk(source, _WithMask(masks), size)
        colours = torch.cat(estimated(planes[:, :-1], planes[:, -1:].clamp(0.0, 1.0)), dim=1)
        return Cutout(masks, colours, (source.size[0] / size[0], source.size[1] / size[1]), working)

    def __call__(self, pixels: Pixels) -> Tensor:
        """The colours (B, C, h, w) of the object, in units of the picture, and the mask."""
        height, width = pixels.image.shape[-2:]
        image, mask = pixels.image, self.masks(pixels)
        front, back = enlarged(self.colours, self.steps, corner(pixels), (height, width)).chunk(2, dim=1)
        front, _ = explained(image, mask, front, back)
        front = torch.minimum(torch.maximum(front, image.clamp(max=0.0)), image.clamp(min=1.0))
        if self.working is not None:
            front = self.working.black + front * self.working.span
        return torch.cat([front, mask], dim=1)


@dataclass(frozen=True, eq=False)
class _WithMask:
    masks: Planes

    def __call__(self, pixels: Pixels) -> Tensor:
        return torch.cat([pixels.image, self.masks(pixels)], dim=1)


def explained(
    image: Tensor, mask: Tensor, front: Tensor, back: Tensor, weight: Tensor | float = 0.0
) -> tuple[Tensor, Tensor]:
    """The colours nearest to given ones whose mixture by a mask explains an image, (B, C, H, W) each.

    They minimise ``|a F + (1 - a) B - I|^2 + w |F - F0|^2 + w |B - B0|^2`` at each pixel: a system of two equations of
    rank one beside the diagonal, so that both move along (a, 1 - a) by a share of what is left unexplained.
    """
    left = image - mask * front - (1 - mask) * back
    share = left / (mask.square() + (1 - mask).square() + weight)
    return front + mask * share, back + (1 - mask) * share


def estimated(image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """The colours of object and background of an image (B, C, H, W), from coarse to fine.

    Each level begins with the colours of one of half its size, where those of a wide area are soon found; there, rounds
    in which every pixel goes between its neighbours suffice, since what is left are differences of nearby pixels.
    """
    size = image.shape[-2:]
    if max(size) == 1:
        return image, image
    half = math.ceil(size[0] / 2), math.ceil(size[1] / 2)
    coarse = estimated(F.adaptive_avg_pool2d(image, half), F.adaptive_avg_pool2d(mask, half))
    front, back = (F.interpolate(colours, size=size, mode="nearest-exact") for colours in coarse)
    weights = [LEAST_WEIGHT + BORDER_WEIGHT * (beside - mask).abs() for beside in _neighbours(mask)]
    total = sum(weights[1:], weights[0])
    for _ in range(COARSE_ROUNDS if max(size) <= COARSE else ROUNDS):
        neighbours = zip(weights, _neighbours(torch.cat([front, back], dim=1)), strict=True)
        sums = [weight * colours for weight, colours in neighbours]
        front, back = (sum(sums[1:], sums[0]) / total).chunk(2, dim=1)
        front, back = explained(image, mask, front, back, total)
    return front, back


def _neighbours(planes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The pixels above, below, left and right of each, (B, C, H, W); beyond the border, the pixel itself."""
    padded = F.pad(planes, (1, 1, 1, 1), mode="replicate")
    return padded[..., :-2, 1:-1], padded[..., 2:, 1:-1], padded[..., 1:-1, :-2], padded[..., 1:-1, 2:]
