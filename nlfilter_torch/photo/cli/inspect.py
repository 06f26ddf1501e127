"""Pictures and diagnostics of the filter of a photograph, and of each of its steps on an example."""

import json
from dataclasses import asdict
from pathlib import Path

import skimage.data
import torch
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from torch import Tensor

from nlfilter_torch.filtering.filters import detail_layers
from nlfilter_torch.filtering.masks import diffusion_mask
from nlfilter_torch.filtering.spectral import captured_energy
from nlfilter_torch.operator.build import nonlocal_operator, operator_from_guide
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.operator.spectrum import Spectrum
from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.editing import viewed_within_memory
from nlfilter_torch.photo.cli.progress import steps
from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.edits.recolor import recolor
from nlfilter_torch.photo.files.writing import check_folder, open_beside
from nlfilter_torch.photo.picture.photographs import read_photograph
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.source import seeded
from nlfilter_torch.photo.plotting import (
    plot_eigenvalues,
    plot_response,
    save_figure,
    show_eigenvectors,
    show_images,
    show_layers,
    show_mask,
)

MEASURED_VECTORS = 32  # eigenvectors, of the 300: all of them would take five times as long as the rest
READ_BYTES = 40  # per pixel, of a photograph that is read and reduced
# Meaning of each diagnostic, for readers who do not know the paper.
MEANINGS = {
    "height": "pixels from top to bottom",
    "width": "pixels from left to right",
    "landmarks": "typical patches that represent all others",
    "rank": "number of independent patterns",
    "bandwidth": "difference up to which pixels count as similar, in grey levels of 255",
    "balancing_steps": "iterations until every pixel had the same total weight",
    "row_sum_residual": "largest deviation of a pixel's total weight from 1",
    "smallest_row_sum": "smallest total weight before balancing; 1: a pixel that resembles no other",
    "largest_eigenvalue": "1 for a correct filter",
    "eigenvector_residual": f"largest error of an eigenvector, of {MEASURED_VECTORS} that are measured",
    "orthogonality": "largest deviation of the eigenvectors from orthonormality",
    "diagonal_share": "average weight of a pixel in its own filtered value",
    "badly_covered": "share of the pixels that have similar ones which the landmarks miss; lower with more landmarks",
    "captured_energy": "share of the picture's energy that the patterns capture (beta in the paper)",
}


def write_diagnostics(source: str, folder: Path, step: Step, seed: int) -> None:
    """Write pictures of the filter of a step for a photograph, with its figures, and print these."""
    check_folder(folder)
    with steps(4) as begin:
        begin("Reading")
        photograph = read_photograph(source, bytes_per_pixel=READ_BYTES)
        size = viewed_within_memory(source, photograph.size, step, factors=5)
        guide = reduce_channels(resize(photograph.pixels, size), "luminance")
        begin("Comparing patches")
        parameters = step.filter_options(size)
        operator = operator_from_guide(guide, FilterOptions(**parameters, generator=seeded(seed)))
        begin("Finding patterns")
        spectrum = operator.spectrum()
        figures = summarize(operator, spectrum, guide)
        begin("Drawing")
        folder.mkdir(exist_ok=True)
        save_figure(show_eigenvectors(spectrum), folder / "eigenvectors.png")
        save_figure(plot_eigenvalues(spectrum), folder / "eigenvalues.png")
        save_figure(plot_response(torch.tensor(step["alpha"]), spectrum), folder / "response.png")
        report = {**figures, "eigenvalues": spectrum.eigenvalues[0].tolist()}
        with open_beside(folder / "diagnostics.json") as stream:
            stream.write(json.dumps(report, indent=2).encode() + b"\n")
    print_table(figures, f"The filter of {source}")


def summarize(operator: NonlocalOperator, spectrum: Spectrum, guide: Tensor) -> dict[str, float]:
    """The diagnostics of an operator of a single image as plain numbers, with the bandwidth in grey levels."""
    figures = {
        name: value[0] if isinstance(value, list) else value
        for name, value in asdict(operator.diagnostics(MEASURED_VECTORS, spectrum)).items()
    }
    del figures["pixels"]
    height, width = guide.shape[-2:]
    return {
        "height": height,
        "width": width,
        "landmarks": figures.pop("num_landmarks"),
        "rank": figures.pop("rank"),
        "bandwidth": options.LEVELS_OF_WHITE * figures.pop("photometric_bandwidth"),
        **figures,
        "captured_energy": float(captured_energy(spectrum, guide)),
    }


def print_table(figures: dict[str, float], title: str) -> None:
    """Print diagnostics with the meaning of each."""
    table = Table(title=Text(title), title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    table.add_column("meaning")
    for name, value in figures.items():
        table.add_row(name.replace("_", " "), f"{value:.4g}", MEANINGS.get(name, ""))
    Console().print(table)


EXAMPLE_SLIDERS = (3.0, 3.0, 4.0, 1.05)  # of the response that is drawn
BLUE = (0.1, 0.3, 0.9)  # of the stroke on the suit
SELECTION = (slice(300, 320), slice(60, 80))  # rows and columns of a patch of the astronaut's suit
# Chosen by eye: half the default width keeps the mask on the suit, three times the default time fills its folds.
SELECTION_WIDTH = 2.0
SELECTION_TIME = 3.0
SELECTION_BANDWIDTH = 25 / options.LEVELS_OF_WHITE


def write_examples(folder: Path) -> None:
    """Write pictures of each step of the filter on an example photograph, and print the figures of its filter."""
    check_folder(folder)
    image = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1)[None].float() / options.LEVELS_OF_WHITE
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
        drawn = {
            "1-before-after": show_images(
                {
                    "Before, with one blue stroke": torch.lerp(image, paint, stroke),
                    "After: recolor": blue,
                    "After: detail, preset crisp": crisp,
                }
            ),
            "2-layers": show_layers(detail_layers(operator, luminance)),
            "3-eigenvectors": show_eigenvectors(spectrum),
            "4-sliders": plot_response(torch.tensor(EXAMPLE_SLIDERS), spectrum),
            "5-selection": show_mask(image, select(luminance), mask),
        }
        paths = {folder / f"{name}.png": figure for name, figure in drawn.items()}
        for path, figure in paths.items():
            save_figure(figure, path)
    print_table(figures, "The filter of the astronaut")
    typer.echo("Pictures: " + ", ".join(map(str, paths)))


def select(luminance: Tensor) -> Tensor:
    """The mask of a patch of the astronaut's suit."""
    region = torch.zeros_like(luminance)
    region[..., SELECTION[0], SELECTION[1]] = 1
    return region
