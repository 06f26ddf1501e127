"""Figs. 12 and 13: detail enhanced within a mask, compared with editing the whole image and with unsharp masks."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.enhancers import adaptive, gaussian
from benchmarks.photographs import SIZE, Box, luminance, scene, spots
from docs.detail_pictures import fine_part, halo, noise_gain
from docs.scenes import SIDE, Numbers, marked, rounded
from nlfilter_torch import diffusion_mask, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.plotting import show_images

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.0])
BANDWIDTH = 25 / 255
Window = tuple[int, int, int]  # column, row and side of the part shown, in pixels of the full-size photograph
STEPS = 24  # of the bisection
STRONGEST = 40.0
SLACK = 0.1  # of the constrained method: overshoot as a share of the local range


def figure_12(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Detail of the suit only, from one region. (b) to (e) have equal detail gain where the mask (f) selects.

    The propagated edit leaves skin and background unchanged, including their noise.
    """
    return _compare("astronaut", size, ((60, 300, 20, 20),), time=2.0, width=4.0, window=(10, 40, 330))


def figure_13(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Detail of the lawn only, from one region. (b) to (e) have equal detail gain where the mask (f) selects.

    The propagated edit leaves the sky unchanged, including its noise.
    """
    return _compare("camera", size, ((300, 380, 40, 60),), time=1.0, width=2.0, window=(60, 130, 330))


def _compare(
    name: str, size: int, boxes: tuple[Box, ...], *, time: float, width: float, window: Window
) -> tuple[Figure, Numbers]:
    image, scale = scene(name, size)
    before, region = luminance(image), spots(image, scale, *boxes)
    by_colour = nonlocal_operator(image, photometric_bandwidth=BANDWIDTH, guide_channels="all")
    mask = diffusion_mask(by_colour.spectrum(), region, time=time, width=width)
    selected = mask > 0.5
    whole = polynomial_filter(nonlocal_operator(before), before, ALPHA) - before
    gain = _gain(before, before + mask * whole, selected)
    methods: dict[str, Callable[[float], Tensor]] = {
        "(b) adaptive unsharp mask": _adding(before, adaptive(before)),
        "(c) constrained unsharp mask": lambda amount: constrained(before, amount),
        "(d) edited everywhere": _adding(before, whole),
        "(e) propagated": _adding(before, mask * whole),
    }
    panels = {"(a) photograph, spots": marked(image, region)}
    numbers: Numbers = {"selected, %": rounded(100 * selected.float().mean(), 1)}
    for title, method in methods.items():
        result = _reach(method, before, gain, selected)
        panels[title] = edit_luminance(image, lambda _, crisp=result: crisp)
        numbers[title] = {
            "detail gain where selected": rounded(_gain(before, result, selected), 2),
            "elsewhere": rounded(_gain(before, result, ~selected), 2),
            "noise gain in the flattest tenth": rounded(noise_gain(before, result), 2),
            "halo, grey levels": rounded(halo(before, result), 1),
        }
    panels["(f) the mask"] = mask
    left, top, side = (round(scale * length) for length in window)
    shown = (..., slice(top, top + side), slice(left, left + side))
    return show_images({title: panel[shown] for title, panel in panels.items()}, columns=3, side=SIDE), numbers


def _gain(before: Tensor, after: Tensor, where: Tensor) -> float:
    return float(fine_part(after)[where].square().mean().sqrt() / fine_part(before)[where].square().mean().sqrt())


def _adding(image: Tensor, detail: Tensor) -> Callable[[float], Tensor]:
    return lambda amount: image + amount * detail


def _reach(method: Callable[[float], Tensor], before: Tensor, gain: float, where: Tensor) -> Tensor:
    """The result with the given detail gain, or the strongest result if the method cannot attain that gain."""
    low, high = 0.0, STRONGEST
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if _gain(before, method(middle), where) < gain else (low, middle)
    return method(high)


def constrained(image: Tensor, amount: float, radius: int = 2) -> Tensor:
    """Unsharp masking with overshoot limited to a tenth of the local range, as in the paper's [28]."""
    size = 2 * radius + 1
    highest, lowest = F.max_pool2d(image, size, 1, radius), -F.max_pool2d(-image, size, 1, radius)
    slack = SLACK * (highest - lowest)
    sharp = image + amount * (image - gaussian(image, 1.5))
    return torch.minimum(torch.maximum(sharp, lowest - slack), highest + slack)
