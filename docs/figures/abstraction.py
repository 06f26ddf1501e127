"""Fig. 18: abstraction."""

from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.photographs import SIZE, luminance, scene
from docs.scenes import SIDE, Numbers, rounded
from nlfilter_torch.photo import abstract
from nlfilter_torch.photo.edits.abstract import Drawing
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance
from nlfilter_torch.photo.plotting import show_images

TONES, LINES = 8, 0.8
PART = (95, 10, 170)  # left, top, side
ROUNDS, RANGE, SPREAD = 4, 0.08, 3.0  # of the bilateral filter: iterations, range sigma and spatial sigma


def figure_18(size: int = SIZE) -> tuple[Figure, Numbers]:
    """W^k y with k = 0.3 (b), with edge lines and quantised tones (c), and a bilateral filter with both (d).

    (d) is the method of the paper's [30]. The lower row shows a part of each, magnified three times.
    """
    image, scale = scene("astronaut", size)
    panels = {
        "(a) photograph": image,
        "(b) k = 0.3": abstract(image),
        "(c) with lines and tones": abstract(image, edges=LINES, tones=TONES),
        "(d) bilateral, lines and tones": winnemoeller(image),
    }
    numbers: Numbers = {}
    for title, picture in panels.items():
        planes = luminance(picture)
        strength = (planes.diff(dim=2)[..., :-1].square() + planes.diff(dim=3)[..., :-1, :].square()).sqrt()
        numbers[title] = {
            "gradient, levels per pixel: median": rounded(255 * strength.median(), 2),
            "steepest hundredth": rounded(255 * strength.flatten().quantile(0.99), 1),
        }
    left, top, side = (round(scale * length) for length in PART)
    window = (..., slice(top, top + side), slice(left, left + side))
    parts = {f"{title[:3]} magnified": picture[window] for title, picture in panels.items()}
    return show_images(panels | parts, columns=4, side=round(0.8 * SIDE)), numbers


def winnemoeller(image: Tensor) -> Tensor:
    """Method of the paper's [30]: a bilateral filter applied four times, then edge lines and quantised tones."""
    from kornia.filters import bilateral_blur

    flat = image
    for _ in range(ROUNDS):
        flat = bilateral_blur(flat, (13, 13), RANGE, (SPREAD, SPREAD))
    bright, chroma = split_luminance(flat)
    drawing = Drawing(LINES, 1.0, TONES)
    toned = drawing.quantized(bright, TONES) * (1 - LINES * (1 - drawing.lines(bright)))
    return merge_luminance(toned, chroma)
