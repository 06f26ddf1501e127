"""Fig. 11: masks that reach everything like a region, for several diffusion times."""

import torch
from matplotlib.figure import Figure

from benchmarks.figures.scenes import SIDE, SIZE, Box, Numbers, painted_over, rounded, scene, spots
from nlfilter_torch import diffusion_mask, nonlocal_operator
from nlfilter_torch.pictures import show_images

TIMES = (0.5, 1.0, 2.0, 5.0)
BANDWIDTH = 25 / 255
PLACES: dict[str, tuple[Box, ...]] = {"coffee": ((215, 270, 20, 20),), "motorcycle": ((360, 200, 40, 16),)}
YELLOW = (1.0, 0.85, 0.1)


def figure_11(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Masks of a spot (yellow) on the saucer and on the tank: all that looks like it, further with larger time t."""
    panels, numbers = {}, {}
    for name, boxes in PLACES.items():
        image, scale = scene(name, size)
        region = spots(image, scale, *boxes)
        operator = nonlocal_operator(image, photometric_bandwidth=BANDWIDTH, guide_channels="all")
        spectrum = operator.spectrum()
        colour = torch.tensor(YELLOW).view(1, 3, 1, 1).expand_as(image)
        panels[f"{name}: a spot of {int(region.sum())} pixels"] = painted_over(image, colour, region)
        rows = {}
        for time in TIMES:
            mask = diffusion_mask(spectrum, region, time=time)
            panels[f"{name}, t = {time:g}"] = mask
            quantiles = torch.quantile(mask.flatten(), torch.tensor([0.25, 0.5, 0.75]))
            rows[f"t = {time:g}"] = {
                "quartiles": [rounded(value, 3) for value in quantiles],
                "above a half, %": rounded(100 * (mask > 0.5).float().mean(), 1),
            }
        numbers[name] = rows
    return show_images(panels, columns=5, side=round(0.8 * SIDE)), numbers
