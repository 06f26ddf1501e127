"""Figs. 14 to 16: coloured scribbles that change all similar pixels."""

import torch
from kornia.color import rgb_to_lab
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.colorize import levin
from benchmarks.denoising.cases import psnr
from benchmarks.photographs import SIZE, Box, luminance, scene, spots, strokes
from docs.scenes import SIDE, Numbers, painted_over, rounded
from nlfilter_torch import diffusion_mask, nonlocal_operator
from nlfilter_torch.photo import colorize, recolor
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance
from nlfilter_torch.photo.plotting import show_images

BLUE, GREEN, VIOLET = (0.1, 0.3, 0.85), (0.1, 0.55, 0.3), (0.5, 0.2, 0.75)
TRUE: tuple[Box, ...] = (
    (120, 170, 30, 30),
    (480, 120, 40, 30),
    (280, 60, 20, 20),
    (260, 140, 30, 16),
    (30, 30, 30, 30),
    (400, 240, 30, 20),
    (60, 300, 40, 30),
    (520, 310, 40, 30),
)
TOLERANCE = 20.0  # of the colour-range replacement, in Lab units


def figure_14(size: int = SIZE) -> tuple[Figure, Numbers]:
    """One stroke on a motorcycle's tank recolours all of its red, compared with replacing a range of colours.

    (c) shows where colours change. (e) gives the stroke's chroma to all colours within 20 Lab units, fading out; (f) is
    the paper's mask, for comparison.
    """
    image, scale = scene("motorcycle", size)
    colours, mask = strokes(image, scale, ((350, 205, 40, 20), BLUE))
    edited = recolor(image, colours, mask)
    by_colour = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all")
    replaced = colour_range(image, colours, mask)
    panels = {
        "(a) photograph": image,
        "(b) a stroke": painted_over(image, colours, mask),
        "(c) where it goes": reached(image, edited),
        "(d) recolor": edited,
        "(e) a range of colours replaced": replaced,
        "(f) the mask of eq. (17), t = 3": diffusion_mask(by_colour.spectrum(), mask, time=3.0),
    }
    numbers = {"recolor": _told(image, edited), "range replaced": _told(image, replaced)}
    return show_images(panels, columns=3, side=SIDE), numbers


def figure_15(size: int = SIZE) -> tuple[Figure, Numbers]:
    """Strokes of two colours on objects of the same red: the spatial term limits each colour to its own side."""
    image, scale = scene("motorcycle", size)
    colours, mask = strokes(
        image, scale, ((350, 205, 40, 20), BLUE), ((565, 272, 30, 14), BLUE), ((565, 190, 40, 40), GREEN)
    )
    edited = recolor(image, colours, mask, spatial_bandwidth=0.3 * min(image.shape[-2:]), num_landmarks=200)
    panels = {
        "(a) photograph": image,
        "(b) two colours of strokes": painted_over(image, colours, mask),
        "(c) where they go": reached(image, edited),
        "(d) recolor": edited,
    }
    return show_images(panels, columns=2, side=SIDE), {"recolor": _told(image, edited)}


def figure_16(size: int = SIZE) -> tuple[Figure, Numbers]:
    """A grey photograph colorized from a few strokes of its original colours; PSNR is against the original.

    (d) is regression, the default; (e) is the paper's k-means, whose segments (c) shows; (f) is Levin's optimisation.
    """
    image, scale = scene("coffee", size)
    grey = luminance(image)
    mask = spots(image, scale, *TRUE)
    cut = colorize(grey, image * mask, mask, method="kmeans")
    methods = {
        "(d) colorize": colorize(grey, image * mask, mask),
        "(e) k-means, the paper's way": cut,
        "(f) Levin's optimisation": levin(grey, image * mask, mask),
    }
    pieces = merge_luminance(torch.full_like(grey, 0.45), split_luminance(cut)[1])
    panels = {"(a) grey": grey, "(b) strokes": painted_over(grey, image, mask), "(c) pieces of k-means": pieces}
    numbers: Numbers = {title: {"PSNR in dB": rounded(psnr(result, image), 1)} for title, result in methods.items()}
    return show_images(panels | methods, columns=3, side=SIDE), numbers


def reached(before: Tensor, after: Tensor) -> Tensor:
    """Change in chroma relative to its 99th percentile, clamped to [0, 1], (1, 1, H, W)."""
    change = (split_luminance(after)[1] - split_luminance(before)[1]).norm(dim=1, keepdim=True)
    return (change / change.flatten().quantile(0.99).clamp(min=1e-6)).clamp(0, 1)


def colour_range(image: Tensor, colours: Tensor, mask: Tensor) -> Tensor:
    """Colour-range replacement: give the stroke's chroma to all colours similar to those under the stroke."""
    lab = rgb_to_lab(image)
    under = (lab * mask).sum((2, 3), keepdim=True) / mask.sum()
    distance = (lab - under)[:, 1:].norm(dim=1, keepdim=True)
    share = (1 - distance / TOLERANCE).clamp(0, 1)
    brightness, chroma = split_luminance(image)
    wanted = (split_luminance(colours)[1] * mask).sum((2, 3), keepdim=True) / mask.sum()
    return merge_luminance(brightness, torch.lerp(chroma, wanted.expand_as(chroma), share))


def _told(before: Tensor, after: Tensor) -> Numbers:
    change = (after - before).abs().amax(1)
    return {
        "pixels that changed by over 2 levels, %": rounded(100 * (change > 2 / 255).float().mean(), 1),
        "luminance, largest change in levels": rounded(255 * (luminance(after) - luminance(before)).abs().max(), 3),
    }
