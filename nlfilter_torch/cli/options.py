"""Options that several verbs share, in a photographer's units.

Modules of verbs, and this one, import neither torch nor what imports it until a verb runs, so that help, lists and
wrong options take no seconds.
"""

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from nlfilter_torch.edits.declaration import BANDWIDTHS, DISTANCES, GAINS, MAX_LANDMARKS, MAX_PATCH, MAX_SLIDERS

if TYPE_CHECKING:
    from nlfilter_torch.io.photographs import Depth

LEVELS = 255.0  # grey levels between black and white, whatever the depth of the file


class Sampling(StrEnum):
    """How the landmarks are chosen."""

    kmeans = "kmeans"
    uniform = "uniform"
    random = "random"


class FileDepth(StrEnum):
    """What a channel of the output file holds."""

    eight = "8"
    sixteen = "16"
    floats = "float"


DEPTHS: dict[FileDepth, "Depth"] = {
    FileDepth.eight: "uint8",
    FileDepth.sixteen: "uint16",
    FileDepth.floats: "float32",
}


def parse_alpha(text: str) -> tuple[float, ...]:
    """The sliders of ``--alpha``.

    >>> parse_alpha("3, 3,4,1.05")
    (3.0, 3.0, 4.0, 1.05)
    """
    return parse_sliders(text, "--alpha")


def parse_sliders(text: str, option: str) -> tuple[float, ...]:
    """Sliders with commas between, as an option gives them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers with commas between, such as 3,3,4,1.05, got {text!r}") from None
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{option} must be finite numbers, such as 3,3,4,1.05, got {text!r}")
    if len(numbers) < 2:
        raise ValueError(f"{option} must have at least two numbers, such as 3,3,4,1.05, got {text!r}")
    if len(numbers) > MAX_SLIDERS:
        raise ValueError(f"{option} must have at most {MAX_SLIDERS} numbers, got {len(numbers)}; drop some")
    if max(map(abs, numbers)) > GAINS[1]:
        raise ValueError(
            f"{option} must be numbers from {GAINS[0]:.0f} to {GAINS[1]:.0f}, such as 3,3,4,1.05, got {text!r}"
        )
    return tuple(numbers)


def parse_levels(text: str) -> float | Literal["auto"]:
    """``--bandwidth`` in grey levels.

    >>> parse_levels("51"), parse_levels("auto")
    (51.0, 'auto')
    """
    if text == "auto":
        return "auto"
    try:
        levels = float(text)
    except ValueError:
        levels = math.nan
    if not 0 < levels < math.inf:
        raise ValueError(f"--bandwidth must be a positive number of grey levels, such as 20, or auto, got {text!r}")
    if not BANDWIDTHS[0] <= levels <= BANDWIDTHS[1]:
        raise ValueError(
            f"--bandwidth must be from {BANDWIDTHS[0]:g} to {BANDWIDTHS[1]:.0f} grey levels, or auto, got {text!r}; "
            "20 suits most photographs"
        )
    return levels


def parse_bandwidth(text: str) -> float | Literal["auto"]:
    """``--bandwidth`` in units of the picture.

    >>> parse_bandwidth("51"), parse_bandwidth("auto")
    (0.2, 'auto')
    """
    levels = parse_levels(text)
    return levels if levels == "auto" else levels / LEVELS


Source = Annotated[str, typer.Argument(metavar="IN", help="The photograph: a PNG, JPEG, TIFF or WebP file.")]
Bandwidth = Annotated[
    str,
    typer.Option(
        metavar="LEVELS",
        help="How different two spots may be and still count as alike, in grey levels from 0 to 255. Small values (5) "
        "touch fine texture only, large ones (40) treat much as detail. `auto` looks at the picture.",
    ),
]
SpatialBandwidth = Annotated[
    float | None,
    typer.Option(
        min=DISTANCES[0],
        max=DISTANCES[1],
        metavar="PIXELS",
        help="How far apart two spots may be and still count as alike. Left out: as far as the picture goes.",
    ),
]
PatchSize = Annotated[
    int,
    typer.Option(
        max=MAX_PATCH,
        metavar="PIXELS",
        help="Width of the patch around each spot that is compared; an odd number. 1 compares single pixels.",
    ),
]
Landmarks = Annotated[
    int,
    typer.Option(
        "--landmarks",
        min=1,
        max=MAX_LANDMARKS,
        metavar="N",
        help="Number of typical patches that stand for the whole picture. More are truer, slower and take more memory.",
    ),
]
LandmarkSampling = Annotated[
    Sampling,
    typer.Option(
        "--sampling",
        help="How the typical patches are found: by grouping similar ones, on a regular grid, or at random.",
    ),
]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        max=2**63 - 1,
        metavar="N",
        help="The same number gives the same picture again, another one a variation.",
    ),
]
Target = Annotated[
    str,
    typer.Argument(
        metavar="OUT", help="The edited photograph; the ending of its name (.png, .jpg, .tif, .webp) gives the type."
    ),
]
OutputDepth = Annotated[
    FileDepth | None,
    typer.Option(help="Bits a channel of the output, or floats (TIFF only). Left out: as many as the input has."),
]
Memory = Annotated[
    float | None,
    typer.Option(
        metavar="GB",
        help="Gigabytes of memory that may be used, beside the 0.3 of the program itself. "
        "A larger photograph is worked out in tiles of rows, which takes "
        "longer and shows no seams. Left out: four fifths of what is free.",
    ),
]
Full = Annotated[
    bool,
    typer.Option(
        "--full",
        help="In tiles: work from every pixel, not from a million of them. Takes two or three times as long.",
    ),
]
StrokesFile = Annotated[
    Path | None,
    typer.Option(
        "--strokes",
        metavar="FILE",
        help="Strokes painted over the photograph: a picture of its size, in PNG, TIFF or WebP, transparent where "
        "nothing is painted.",
    ),
]
ColourRegions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        metavar="X,Y,W,H:COLOUR",
        help="A rectangle of colour in place of a stroke, or on top of them: column and row of its upper left corner, "
        "width and height in pixels, and a colour such as red or #c04020. May be given several times; later ones cover "
        "earlier ones.",
    ),
]
Keeps = Annotated[
    list[str] | None,
    typer.Option(
        "--keep", metavar="X,Y,W,H", help="A rectangle whose likes stay as they are. May be given several times."
    ),
]
Regions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        metavar="X,Y,W,H",
        help="A rectangle: column and row of its upper left corner, width and height in pixels. May be given several "
        "times.",
    ),
]
SliderRegions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        metavar="X,Y,W,H[:SLIDERS]",
        help="Edit only what looks like a rectangle: column and row of its upper left corner, its width and height, "
        "and sliders of its own if they are not those of --alpha, such as 60,300,20,20:3,3,4,1. May be given several "
        "times.",
    ),
]
MaskFile = Annotated[
    Path | None,
    typer.Option(
        "--mask",
        metavar="FILE",
        help="A picture of the photograph's size, white where it is selected, black elsewhere.",
    ),
]
