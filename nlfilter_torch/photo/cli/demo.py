"""``nlfilter-torch demo``: pictures of each step of the filter on one photograph."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.inspect import Folder, print_table, summarize

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

ALPHA = (3.0, 3.0, 4.0, 1.05)  # of the response that is drawn
BLUE = (0.1, 0.3, 0.9)  # of the stroke on the suit
SELECTION = (slice(300, 320), slice(60, 80))  # rows and columns of a patch of the astronaut's suit
# Chosen by eye: half the default width keeps the mask on the suit, three times the default time fills its folds.
SELECTION_WIDTH = 2.0
SELECTION_TIME = 3.0
SELECTION_BANDWIDTH = 25 / options.LEVELS


def demo(folder: Folder = Path("out")) -> None:
    """Show what this program does, on an example photograph.

    Writes pictures of the photograph before and after, of its layers, of the patterns that the filter finds, of the
    response of the sliders and of a region extended to everything that looks like it, and prints a table.
    """
    import skimage.data
    import torch

    from nlfilter_torch.filtering.filters import detail_layers
    from nlfilter_torch.filtering.masks import diffusion_mask
    from nlfilter_torch.operator.build import nonlocal_operator
    from nlfilter_torch.operator.features import reduce_channels
    from nlfilter_torch.photo.cli.progress import steps
    from nlfilter_torch.photo.declared.presets import find_recipe
    from nlfilter_torch.photo.edits.applying import apply_recipe
    from nlfilter_torch.photo.edits.recolor import recolor
    from nlfilter_torch.photo.files.writing import check_folder
    from nlfilter_torch.photo.plotting import (
        plot_response,
        show_eigenvectors,
        show_images,
        show_layers,
        show_mask,
    )

    check_folder(folder)
    image = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1)[None].float() / options.LEVELS
    with steps(4) as begin:
        begin("Comparing patches")
        luminance = reduce_channels(image, "luminance")
        operator = nonlocal_operator(luminance)
        spectrum = operator.spectrum()

        begin("Editing")
        stroke = select(luminance)
        paint = torch.tensor(BLUE).view(1, 3, 1, 1) * stroke
        blue = recolor(image, paint, stroke)
        crisp = apply_recipe(find_recipe("crisp"), image)
        figures = summarize(operator, spectrum, luminance)

        begin("Selecting a region")
        by_colour = nonlocal_operator(image, photometric_bandwidth=SELECTION_BANDWIDTH, guide_channels="all")
        mask = diffusion_mask(by_colour.spectrum(), select(luminance), time=SELECTION_TIME, width=SELECTION_WIDTH)

        begin("Drawing")
        folder.mkdir(exist_ok=True)
        paths = save_figures(
            folder,
            {
                "1-before-after": show_images(
                    {
                        "Before, with one blue stroke": torch.lerp(image, paint, stroke),
                        "After: recolor": blue,
                        "After: detail, preset crisp": crisp,
                    }
                ),
                "2-layers": show_layers(detail_layers(operator, luminance)),
                "3-eigenvectors": show_eigenvectors(spectrum),
                "4-sliders": plot_response(torch.tensor(ALPHA), spectrum),
                "5-selection": show_mask(image, select(luminance), mask),
            },
        )
    print_table(figures, "The filter of the astronaut")
    typer.echo("Pictures: " + ", ".join(map(str, paths)))


def select(luminance: "Tensor") -> "Tensor":
    """The mask of a patch of the astronaut's suit."""
    import torch

    region = torch.zeros_like(luminance)
    region[..., SELECTION[0], SELECTION[1]] = 1
    return region


def save_figures(folder: Path, figures: "Mapping[str, Figure]") -> list[Path]:
    """Save figures in a folder, under their names, and return their paths."""
    from nlfilter_torch.photo.plotting import save_figure

    paths = [folder / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        save_figure(figure, path)
    return paths
