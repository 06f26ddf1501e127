"""Fig. 17: fake depth of field."""

import torch
from matplotlib.figure import Figure

from benchmarks.figures.scenes import SIDE, SIZE, Box, Numbers, painted_over, rounded, scene, spots
from nlfilter_torch import defocus
from nlfilter_torch.pictures import show_images

YELLOW = (1.0, 0.85, 0.1)
FACE: tuple[Box, ...] = (
    (190, 70, 70, 90),
    (170, 30, 60, 20),
    (200, 200, 60, 40),
    (60, 280, 60, 120),
    (280, 290, 50, 80),
)


def figure_17(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Sharp where the yellow spots are, and all that looks like them and is near; blurred elsewhere."""
    image, scale = scene("astronaut", size)
    region = spots(image, scale, *FACE)
    colour = torch.tensor(YELLOW).view(1, 3, 1, 1).expand_as(image)
    disc = defocus(image, region)
    gaussian = defocus(image, region, aperture="gaussian")
    panels = {
        "(a) photograph": image,
        "(b) in focus": painted_over(image, colour, region),
        "(c) disc": disc,
        "(d) Gaussian": gaussian,
    }
    return show_images(panels, columns=2, side=SIDE), {"painted, %": rounded(100 * region.mean(), 1)}
