"""``nlfilter-torch fit``: find the look that turns photographs into edited ones, and save it for others."""

from pathlib import Path
from typing import Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import step_of, with_options
from nlfilter_torch.photo.declared.colour_tables import CUBE_NODES
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.shared_parameters import LOOK

Before = Annotated[str, typer.Argument(metavar="BEFORE", help="The photograph before the edit, or a folder of them.")]
After = Annotated[
    str, typer.Argument(metavar="AFTER", help="The same after the edit; in a folder, under the same names.")
]
Result = Annotated[Path, typer.Argument(metavar="PRESET", help="The JSON file in which the look is saved.")]
Order = Annotated[
    int,
    typer.Option("--layers", min=2, max=10, metavar="N", help="Number of sliders, from the finest to the coarsest."),
]
Preview = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A picture of the first pair at the viewing size: before, after, the look, and the remaining difference, "
        "amplified, around grey.",
    ),
]
Map = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="A grey picture of the part of the first pair's edit that the look does not explain.",
    ),
]
Cube = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=f"A colour table of {CUBE_NODES}^3 for other programs, a .cube file: the part of the look that depends on "
        "the colour alone.",
    ),
]
Hald = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="The same as a picture, a Hald of level 8, in 16 bits: a PNG or TIFF file."),
]


@with_options("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling")
def fit(
    before: Before,
    after: After,
    preset: Result = Path("preset.json"),
    layers: Order = 4,
    mask: options.MasksOfPairs = None,
    preview: Preview = None,
    left: Map = None,
    cube: Cube = None,
    hald: Hald = None,
    **values: Value,
) -> None:
    """Find the look that turns a photograph into an edited one, or a folder of them, whatever program made the edit.

    A look has sliders, tone curves, colours and sharpness, but only those that also explain photographs left out of
    the fit. Prints how much of the change it explains, and saves it in a file for other photographs:

    `nlfilter-torch fit before.jpg after.jpg look.json --preview seen.png`

    `nlfilter-torch apply other.jpg out.jpg --preset look.json`

    For other programs: `nlfilter-torch fit before.jpg after.jpg look.json --cube look.cube`

    Each --mask is a region that has a look of its own, in numbered files:

    `nlfilter-torch fit before.jpg after.jpg look.json --mask sky.png --mask ground.png`
    """
    from nlfilter_torch.photo.cli.fit_job import FitJob, Tables

    step = step_of(LOOK, values)
    job = FitJob(step, Path(before), Path(after), preset, mask or [], preview, left, Tables(cube, hald))
    job.run(layers - 1)
