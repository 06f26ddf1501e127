"""Whether what is claimed of masks and edits holds: ``python -m benchmarks.edits [--out FILE]``.

Prints one line per claim, with its limit and the measured value, on photographs that ship with scikit-image. Larger
comparisons have their own modules: ``benchmarks.colorize``, ``benchmarks.sharpening``, ``docs.figures``.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import skimage.data
import torch
import torch.nn.functional as F
from skimage.color import rgb2hsv
from torch import Tensor

from benchmarks.harness import Figure, options, report, save_json
from benchmarks.photographs import luminance, scene, spots, strokes
from nlfilter_torch import Spectrum, diffusion_mask, nonlocal_operator
from nlfilter_torch.photo import abstract, adjust_tone, defocus, filter_frames, recolor

SUIT = (60, 300, 20, 20)  # column, row, width, height on the astronaut's suit
TIMES = (0.5, 1.0, 2.0, 5.0)
STEP = 7  # pixels that the camera moves from frame to frame


def _astronaut(side: int) -> tuple[Tensor, Tensor, Spectrum]:
    """Photograph, scribble on the suit, and spectrum of an operator that compares colours."""
    image, scale = scene("astronaut", side)
    operator = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all")
    return image, spots(image, scale, SUIT), operator.spectrum()


def masks() -> Iterator[Figure]:
    """Masks of a scribble on the astronaut's suit, with RGB guide and h = 25/255."""
    _, spot, whole = _astronaut(512)
    _, small_spot, preview = _astronaut(256)
    mask = diffusion_mask(whole, spot)
    hue, saturation, value = rgb2hsv(skimage.data.astronaut()).transpose(2, 0, 1)
    below_collar = np.arange(512)[:, None] > 200
    suit = torch.from_numpy((hue > 0.01) & (hue < 0.08) & (saturation > 0.6) & (value > 0.35) & below_collar)
    ratio = float(mask[0, 0][suit].mean() / mask[0, 0][~suit].mean())
    yield Figure("mask at t = 1: mean on the suit / mean elsewhere", ratio, 3.0, at_most=False)
    levels = torch.linspace(0, 1, 21)
    quantiles = torch.stack([diffusion_mask(preview, small_spot, time=t).flatten().quantile(levels) for t in TIMES])
    yield Figure(
        f"smallest growth of its 5 to 95 % quantiles, t = {TIMES}",
        float(quantiles.diff(dim=0)[:, 1:-1].min()),
        0.0,
        at_most=False,
    )
    yield Figure("smallest value of the mask", float(mask.min()), 1e-30, at_most=False)
    yield Figure("largest value of the mask", float(mask.max()), 1.0)
    apart = F.avg_pool2d(mask, 2) - diffusion_mask(preview, small_spot)
    yield Figure("mean difference between masks at 256 and 512 pixels", float(apart.abs().mean()), 0.05)


def recolouring() -> Iterator[Figure]:
    """Recolouring from one blue stroke on the suit."""
    image, scale = scene("astronaut", 256)
    colours, painted = strokes(image, scale, (SUIT, (0.1, 0.3, 0.9)))
    edited = recolor(image, colours, painted, brightness=0.0)
    change = float(255 * (luminance(edited) - luminance(image)).abs().max())
    yield Figure("recolor: largest change of luminance, grey levels", change, 1.0)
    outside = spots(image, scale, (300, 20, 100, 120)).expand_as(image) > 0  # backdrop
    yield Figure("recolor: largest change of the backdrop, grey levels", _levels(edited - image, outside), 2.0)
    kept = spots(image, scale, (200, 90, 50, 60))  # face
    edited = recolor(image, colours, painted, brightness=0.0, keep=kept)
    yield Figure(
        "recolor: largest change of the area to keep, grey levels",
        _levels(edited - image, kept.expand_as(image) > 0),
        2.0,
    )


def focusing() -> Iterator[Figure]:
    """Defocus that keeps the astronaut sharp, but not the shuttle behind her."""
    image, scale = scene("astronaut", 256)
    region = spots(image, scale, (188, 60, 60, 60), (40, 260, 32, 160))
    face, shuttle = spots(image, scale, (180, 88, 72, 80)), spots(image, scale, (380, 0, 132, 240))
    for aperture in ("disc", "gaussian"):
        blurred = defocus(image, region, radius=4.0, aperture=aperture)
        kept = _energy(blurred, face) / _energy(image, face)
        yield Figure(f"defocus, {aperture}: remaining gradient energy of the face", kept, 0.95, at_most=False)
        left = _energy(blurred, shuttle) / _energy(image, shuttle)
        yield Figure(f"defocus, {aperture}: remaining gradient energy behind it", left, 0.3)


def abstraction() -> Iterator[Figure]:
    """Abstraction for k near 0, and the change of the mean under contrast."""
    image = scene("chelsea", 256)[0]
    for power, limit in ((0.0, 0.01), (1e-5, 0.1)):
        change = float(255 * (abstract(image, power=power) - image).square().mean().sqrt())
        yield Figure(f"abstract, k = {power:g}: RMS change, grey levels", change, limit)
    drift = adjust_tone(image, contrast=1.4, clarity=3.0, limits="none").mean((2, 3)) - image.mean((2, 3))
    yield Figure("tone, contrast 1.4: drift of the mean, grey levels", float(255 * drift.abs().max()), 0.1)


def pan() -> Iterator[Figure]:
    """Flicker in ten frames of a pan over the astronaut, edited together and each alone."""
    whole = scene("astronaut", 512)[0]
    film = [whole[..., 60 + STEP * i : 160 + STEP * i, 130 + STEP * i : 250 + STEP * i] for i in range(10)]
    alpha = torch.tensor([3.0, 3.0, 4.0, 1.05])
    together = list(filter_frames(film, alpha, references=[film[0], film[5], film[9]]))
    singles = [next(filter_frames([frame], alpha, references=[frame])) for frame in film]
    yield Figure(
        "flicker of a ten-frame pan / flicker of frames edited alone", _flicker(together) / _flicker(singles), 0.25
    )


def _levels(difference: Tensor, where: Tensor) -> float:
    return float(255 * difference[where].abs().max())


def _energy(image: Tensor, where: Tensor) -> float:
    rows, columns = image.diff(dim=2)[..., :-1], image.diff(dim=3)[..., :-1, :]
    return float(((rows.square() + columns.square()) * where[..., :-1, :-1]).sum())


def _flicker(edited: list[Tensor]) -> float:
    pairs = [(a[..., STEP:, STEP:] - b[..., :-STEP, :-STEP]).abs().mean() for a, b in pairwise(edited)]
    return float(torch.stack(pairs).mean())


TOPICS: tuple[Callable[[], Iterator[Figure]], ...] = (masks, recolouring, focusing, abstraction, pan)


def main(arguments: list[str] | None = None) -> int:
    """Print a line per claim; return 1 if one does not hold."""
    parser = options("edits", __doc__)
    parser.add_argument("--out", type=Path, help="also write the results to this JSON file")
    chosen = parser.parse_args(arguments)
    figures = [figure for topic in TOPICS for figure in topic()]
    save_json(chosen.out, [asdict(figure) | {"holds": figure.holds} for figure in figures])
    return report(figures)


if __name__ == "__main__":
    sys.exit(main())
