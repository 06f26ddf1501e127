"""Fig. 17: fake depth of field, compared with blur from the true depth."""

import numpy as np
import skimage.data
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.photographs import SIZE, Box, scene, spots
from docs.scenes import SIDE, Numbers, marked, rounded
from nlfilter_torch.photo import defocus, region_mask
from nlfilter_torch.photo.declared.parameters import DEFOCUS
from nlfilter_torch.photo.edits.defocus import Lens, focus_of
from nlfilter_torch.photo.plotting import show_images

PORTRAIT: tuple[Box, ...] = (
    (190, 70, 70, 90),
    (185, 30, 50, 20),
    (270, 60, 20, 40),
    (120, 215, 16, 30),
    (298, 215, 12, 30),
    (200, 200, 60, 40),
    (60, 270, 60, 60),
    (270, 290, 40, 40),
)
MOTORCYCLE: tuple[Box, ...] = (
    (345, 200, 50, 30),
    (170, 190, 120, 10),
    (340, 310, 60, 40),
    (140, 300, 20, 60),
    (560, 290, 50, 10),
    (540, 330, 60, 60),
    (180, 310, 130, 20),
)
WIDE = 741 / 500  # aspect ratio of the motorcycle photograph
NEAR, FAR = 5.0, 14.0  # limits of subject and background, in pixels of disparity from the region's


def figure_17(size: int = SIZE) -> tuple[Figure, Numbers]:
    """In focus are the yellow spots and similar pixels nearby; the depth of the second scene is known.

    (h) is blurred according to the depth measured by a stereo camera. Gradient energy is that of the result divided by
    that of the photograph.
    """
    portrait, scale = scene("astronaut", size)
    portrait = portrait[..., : round(portrait.shape[-1] / WIDE), :]
    region = spots(portrait, scale, *PORTRAIT)
    panels = {
        "(a) photograph and spots": marked(portrait, region),
        "(b) focus map": default_map(portrait, region),
        "(c) Gaussian blur": defocus(portrait, region, aperture="gaussian"),
        "(d) blur of a lens": defocus(portrait, region),
    }
    image, scale = scene("motorcycle", size)
    region = spots(image, scale, *MOTORCYCLE)
    disparity = _disparity(image)
    distance = (disparity - disparity[region > 0].median()).abs()
    lens = defocus(image, region)
    blur = ((distance - NEAR) / (FAR - NEAR)).clamp(0, 1)
    true = Lens(DEFOCUS["radius"].pixels(None, image.shape[-2:]), "disc").blur_behind(image, 1 - blur)
    panels |= {
        "(e) photograph and spots": marked(image, region),
        "(f) focus map": default_map(image, region),
        "(g) blur of a lens": lens,
        "(h) by the true depth": true,
    }
    numbers: Numbers = {
        name: {
            "gradient energy of the subject": rounded(
                _energy(result, distance < NEAR) / _energy(image, distance < NEAR), 3
            ),
            "behind it": rounded(_energy(result, distance > FAR) / _energy(image, distance > FAR), 3),
        }
        for name, result in (("(g) from the spots", lens), ("(h) from the true depth", true))
    }
    return show_images(panels, columns=4, side=round(0.9 * SIDE)), numbers


def default_map(image: Tensor, region: Tensor) -> Tensor:
    """Focus map computed with the defaults of :func:`defocus`."""
    share = DEFOCUS["spatial_bandwidth"].share * min(image.shape[-2:])
    return focus_of(region_mask(image, region, spatial_bandwidth=share))


def _disparity(image: Tensor) -> Tensor:
    """Disparity of the motorcycle scene, (1, 1, H, W), with gaps filled from their farther side."""
    known = torch.from_numpy(np.array(skimage.data.stereo_motorcycle()[2], dtype=np.float32))
    known = torch.where(torch.isfinite(known), known, torch.inf)
    while bool(torch.isinf(known).any()):
        grown = -torch.nn.functional.max_pool2d(-known[None, None], 3, 1, 1)[0, 0]
        known = torch.where(torch.isinf(known), grown, known)
    return torch.nn.functional.interpolate(known[None, None], size=image.shape[-2:], mode="nearest")


def _energy(image: Tensor, where: Tensor) -> float:
    rows, columns = image.diff(dim=2)[..., :-1], image.diff(dim=3)[..., :-1, :]
    return float(((rows.square() + columns.square()) * where[..., :-1, :-1]).sum())
