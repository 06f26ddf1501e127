"""Fig. 11: masks of all pixels similar to a region, for several diffusion times."""

import torch
from matplotlib.figure import Figure

from benchmarks.photographs import SIZE, Box, scene, spots
from docs.scenes import SIDE, Numbers, marked, rounded
from nlfilter_torch import diffusion_mask, nonlocal_operator
from nlfilter_torch.photo.plotting import show_images

TIMES = (0.5, 1.0, 2.0, 4.0)
BANDWIDTH = 25 / 255
PLACES: dict[str, Box] = {"astronaut": (60, 300, 20, 20), "rocket": (300, 90, 40, 40)}


def figure_11(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Masks of a region (yellow) on the suit and in the sky; white is similar. Masks extend further with larger t."""
    panels, numbers = {}, {}
    for name, box in PLACES.items():
        image, scale = scene(name, size)
        region = spots(image, scale, box)
        margin = (image.shape[-1] - image.shape[-2]) // 2  # crop to a square, like the other
        image, region = (plane[..., margin : margin + plane.shape[-2]] for plane in (image, region))
        operator = nonlocal_operator(image, photometric_bandwidth=BANDWIDTH, guide_channels="all")
        spectrum = operator.spectrum()
        panels[f"{name}, a spot"] = marked(image, region)
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
    return show_images(panels, columns=5, side=round(0.75 * SIDE)), numbers
