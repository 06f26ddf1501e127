"""``nlfilter-torch inspect``: pictures and diagnostics of the filter of a photograph."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import step_of, with_options
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS

if TYPE_CHECKING:
    from torch import Tensor

    from nlfilter_torch.operator.operator import NonlocalOperator
    from nlfilter_torch.operator.spectrum import Spectrum
    from nlfilter_torch.photo.declared.steps import Step

Folder = Annotated[
    Path, typer.Argument(metavar="OUTDIR", help="The folder for the pictures; created if it does not exist.")
]
MEASURED = 32  # eigenvectors, of the 300: all of them would take five times as long as the rest
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
    "eigenvector_residual": f"largest error of an eigenvector, of {MEASURED} that are measured",
    "orthogonality": "largest deviation of the eigenvectors from orthonormality",
    "diagonal_share": "average weight of a pixel in its own filtered value",
    "badly_covered": "share of the pixels that have similar ones which the landmarks miss; lower with more landmarks",
    "captured_energy": "share of the picture's energy that the patterns capture (beta in the paper)",
}


@with_options("alpha", "bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling", "viewing_size")
def inspect(source: options.Source, folder: Folder, seed: options.Seed = 0, **values: Value) -> None:
    """Show the filter of a photograph: the patterns it finds, how strong they are, and how sliders change them.

    Writes eigenvectors.png, eigenvalues.png, response.png and diagnostics.json into a folder and prints a table. A
    photograph larger than the viewing size is reduced to it, as for `detail`.

    Example: `nlfilter-torch inspect in.jpg looks --alpha 3,3,4,1.05`
    """
    step = step_of(EDITS["detail"], values)

    import torch

    from nlfilter_torch.operator.features import reduce_channels
    from nlfilter_torch.photo.cli.editing import viewed_within_memory
    from nlfilter_torch.photo.cli.progress import steps
    from nlfilter_torch.photo.files.writing import check_folder, open_beside
    from nlfilter_torch.photo.picture.photographs import read_photograph
    from nlfilter_torch.photo.picture.resizing import resize
    from nlfilter_torch.photo.plotting import plot_eigenvalues, plot_response, save_figure, show_eigenvectors

    check_folder(folder)
    with steps(4) as begin:
        begin("Reading")
        photograph = read_photograph(source, bytes_per_pixel=READ_BYTES)
        size = viewed_within_memory(source, photograph.size, step, factors=5)
        guide = reduce_channels(resize(photograph.pixels, size), "luminance")
        begin("Comparing patches")
        operator = build_operator(guide, step, seed)
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


def build_operator(guide: "Tensor", step: "Step", seed: int = 0) -> "NonlocalOperator":
    """The operator of a guide (1, 1, H, W), with the filter parameters of a step."""
    from nlfilter_torch.operator.build import operator_from_guide
    from nlfilter_torch.operator.options import FilterOptions
    from nlfilter_torch.photo.picture.source import seeded

    parameters = step.filter_options((guide.shape[-2], guide.shape[-1]))
    return operator_from_guide(guide, FilterOptions(**parameters, generator=seeded(seed)))


def summarize(operator: "NonlocalOperator", spectrum: "Spectrum", guide: "Tensor") -> dict[str, float]:
    """The diagnostics of an operator of a single image as plain numbers, with the bandwidth in grey levels."""
    from nlfilter_torch.filtering.spectral import captured_energy

    figures = {
        name: value[0] if isinstance(value, list) else value
        for name, value in asdict(operator.diagnostics(MEASURED, spectrum)).items()
    }
    del figures["pixels"]
    height, width = guide.shape[-2:]
    return {
        "height": height,
        "width": width,
        "landmarks": figures.pop("num_landmarks"),
        "rank": figures.pop("rank"),
        "bandwidth": options.LEVELS * figures.pop("photometric_bandwidth"),
        **figures,
        "captured_energy": float(captured_energy(spectrum, guide)),
    }


def print_table(figures: dict[str, float], title: str) -> None:
    """Print diagnostics with the meaning of each."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    table.add_column("meaning")
    for name, value in figures.items():
        table.add_row(name.replace("_", " "), f"{value:.4g}", MEANINGS.get(name, ""))
    Console().print(table)
