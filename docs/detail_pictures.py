"""Pictures for the documentation: sharpening, and an unsharp mask: ``python -m docs.detail_pictures [FOLDER]``.

Both edit the luminance of the same photograph and keep its colour. The unsharp mask is scikit-image's, of radius 2,
with the amount that gives the same detail gain: the ratio, after to before, of the RMS difference between luminance and
its Gaussian blur of 2 pixels. Three measurements of each are printed, including lost comparisons:

* noise gain: the same ratio over the tenth of 8x8 blocks where that difference is smallest before;
* halo: mean distance, over the steepest twentieth of pixels, by which the result leaves the range of the photograph
  within 4 pixels, in grey levels;
* clipped: pixels that leave [0, 255] by more than a level, in percent.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import skimage.data
import torch
from kornia.color import rgb_to_grayscale
from kornia.filters import gaussian_blur2d, spatial_gradient
from kornia.morphology import dilation, erosion
from rich.console import Console
from rich.table import Table
from skimage.filters import unsharp_mask
from torch import Tensor

from docs.scenes import LETTERS
from nlfilter_torch.photo import PRESETS, apply_recipe
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.plotting import save_figure, show_images

RADIUS = 2.0
# Upper left corner of the part of each photograph that is shown at full size; measurements are of the whole.
CROPS = {"coffee": (130, 180), "chelsea": (15, 90), "astronaut": (20, 90)}
SIDE = 270


def fine_part(luminance: Tensor) -> Tensor:
    """The part that a Gaussian blur of 2 pixels removes."""
    return luminance - gaussian_blur2d(luminance, (13, 13), (RADIUS, RADIUS))


def detail_gain(before: Tensor, after: Tensor) -> float:
    """Ratio of the RMS of the fine part, after to before."""
    return float(fine_part(after).square().mean().sqrt() / fine_part(before).square().mean().sqrt())


def noise_gain(before: Tensor, after: Tensor) -> float:
    """Ratio of the RMS of the fine part over the flattest tenth of blocks, after to before."""
    energies = [torch.nn.functional.avg_pool2d(fine_part(y).square(), 8).flatten() for y in (before, after)]
    flat = energies[0] <= energies[0].quantile(0.1)
    return float((energies[1][flat].mean() / energies[0][flat].mean()).sqrt())


def halo(before: Tensor, after: Tensor) -> float:
    """Mean excess over the local range at steep edges, in grey levels."""
    window = torch.ones(9, 9)
    beyond = (after - dilation(before, window)).clamp(min=0) + (erosion(before, window) - after).clamp(min=0)
    slope = spatial_gradient(before).square().sum(2).sqrt()
    return 255 * float(beyond[slope >= np.quantile(slope.numpy(), 0.95)].mean())


def clipped(after: Tensor) -> float:
    """Percentage of pixels outside the range by more than a grey level."""
    return 100 * float(((after < -1 / 255) | (after > 256 / 255)).float().mean())


def unsharp(amount: float) -> Callable[[Tensor], Tensor]:
    """scikit-image's unsharp mask of a luminance, not clipped."""

    def edit(luminance: Tensor) -> Tensor:
        plane = luminance[0, 0].numpy().astype(np.float64)
        crisp = unsharp_mask(plane, radius=RADIUS, amount=amount, preserve_range=True)
        return torch.from_numpy(crisp).to(luminance)[None, None]

    return edit


def matching_amount(luminance: Tensor, gain: float) -> float:
    """Find the amount of the unsharp mask with a detail gain of ``gain``, by bisection."""
    low, high = 0.0, 20.0
    for _ in range(30):
        middle = (low + high) / 2
        if detail_gain(luminance, unsharp(middle)(luminance).clamp(0, 1)) < gain:
            low = middle
        else:
            high = middle
    return high


def main() -> None:
    """Write one picture for each photograph and print the measurements."""
    parser = argparse.ArgumentParser(description="Sharpening against an unsharp mask of equal detail gain.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs"), help="folder for the pictures")
    folder = parser.parse_args().folder
    folder.mkdir(exist_ok=True)
    table = Table(title="The preset crisp")
    for column in ("photograph", "method", "detail gain", "noise gain", "halo", "clipped %"):
        table.add_column(column, justify="left" if column in ("photograph", "method") else "right")
    for name, (top, left) in CROPS.items():
        image = torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1)[None].float() / 255
        luminance = rgb_to_grayscale(image)
        crisp = apply_recipe(PRESETS["crisp"], image)
        gain = detail_gain(luminance, rgb_to_grayscale(crisp.clamp(0, 1)))
        amount = matching_amount(luminance, gain)
        masked = edit_luminance(image, unsharp(amount))
        results = {f"unsharp mask, amount {amount:.2f}": masked, "nlfilter-torch": crisp}
        for method, result in results.items():
            shown = rgb_to_grayscale(result.clamp(0, 1))
            figures = (
                detail_gain(luminance, shown),
                noise_gain(luminance, shown),
                halo(luminance, shown),
                clipped(rgb_to_grayscale(result)),
            )
            table.add_row(name, method, *(f"{figure:.2f}" for figure in figures))
        window = (..., slice(top, top + SIDE), slice(left, left + SIDE))
        panels = {"before": image} | results
        figure = show_images({title: panel[window] for title, panel in panels.items()}, side=SIDE, letters=LETTERS)
        save_figure(figure, folder / f"detail-{name}.png")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
