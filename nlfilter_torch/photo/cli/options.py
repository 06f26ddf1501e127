"""Options shared by several commands, in units familiar to photographers.

Modules of commands import torch only inside the functions that run, so that help, lists and errors in options appear
at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from nlfilter_torch.photo.declared.declaration import (
    FILTER_PANEL,
    GAINS,
    MAX_SLIDERS,
    UNIT_NAMES,
    Parameter,
    ScribbleKind,
)
from nlfilter_torch.photo.declared.development import Crop
from nlfilter_torch.photo.declared.strokes import Shape

if TYPE_CHECKING:
    from nlfilter_torch.photo.files.formats import Depth

FILES_PANEL = "Files and memory"  # section in the help
LEVELS_OF_WHITE = 255.0  # grey levels between black and white, whatever the depth of the file


FileDepth = Literal["8", "16", "float"]  # what a channel of the output file holds
DTYPES: dict[FileDepth, "Depth"] = {"8": "uint8", "16": "uint16", "float": "float32"}


ASPECT_SIDES = (0.01, 100_000.0)  # range of the two numbers in the proportions of a crop
NOTE = "nlfilter-torch: note: "  # begins every note on standard error


def note(sentence: str) -> None:
    """Print a note on standard error."""
    typer.echo(f"{NOTE}{sentence}", err=True)


def parse_aspect(text: str) -> float:
    """Parse the proportions of a crop: width by height.

    >>> parse_aspect("3:2")
    1.5
    """
    try:
        wide, high = (float(part) for part in text.split(":"))
    except ValueError:
        wide = high = 0.0
    if not (ASPECT_SIDES[0] <= wide <= ASPECT_SIDES[1] and ASPECT_SIDES[0] <= high <= ASPECT_SIDES[1]):
        raise ValueError(
            f"--aspect must be a width and a height from {ASPECT_SIDES[0]:g} to {ASPECT_SIDES[1]:g}, such as 3:2, got "
            f"{text!r}; correct it"
        )
    return wide / high


def parse_sliders(text: str, option: str) -> tuple[float, ...]:
    """Parse sliders separated by commas.

    >>> parse_sliders("3, 3,4,1.05", "--alpha")
    (3.0, 3.0, 4.0, 1.05)
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers separated by commas, such as 3,3,4,1.05, got {text!r}") from None
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


def split_region(text: str) -> tuple[Shape, str, str | None]:
    """Split the text of a region into its shape, its numbers, and the note after its colon.

    >>> split_region("1,2,3,4"), split_region("ellipse:1,2,3,4:red")
    (('rectangle', '1,2,3,4', None), ('ellipse', '1,2,3,4', 'red'))
    """
    rest = text.removeprefix("ellipse:")
    numbers, colon, note = rest.partition(":")
    return "rectangle" if rest == text else "ellipse", numbers, note if colon else None


def parse_lengths(parts: Sequence[str], sides: tuple[int, int]) -> list[float]:
    """Parse places in a photograph of these sides (W, H): columns and rows in turn, in pixels or in percent.

    >>> parse_lengths(["10", "25%", "50%", "40"], (100, 80))
    [10, 20.0, 50.0, 40]

    Raises:
        ValueError: if one is neither a whole number nor a percentage.
    """
    lengths = list[float]()
    for place, side in zip(parts, cycle(sides), strict=False):
        number = place.strip().removesuffix("%")
        # In this order, whole numbers of pixels are exact.
        lengths.append(int(number) if number == place.strip() else float(number) * side / 100)
    if not all(map(math.isfinite, lengths)):
        raise ValueError(f"places must be finite numbers, got {', '.join(parts)}")
    return lengths


def parse_crop(text: str, size: tuple[int, int]) -> Crop:
    """Parse a crop X,Y,W,H of a photograph (H, W), in pixels or percent, into shares of its sides.

    >>> parse_crop("10%,0,75,100%", (80, 100))
    (0.1, 0.0, 0.85, 1.0)
    """
    height, width = size
    try:
        left, top, across, down = parse_lengths(text.split(","), (width, height))
    except ValueError:
        raise ValueError(
            "--crop must be column and row of the upper left corner, width and height, X,Y,W,H, in whole pixels or in "
            f"%, such as 10%,0%,80%,100%, got {text!r}; correct it"
        ) from None
    if not (0 <= left < left + across <= width and 0 <= top < top + down <= height):
        raise ValueError(
            f"--crop must lie within the photograph, which is {width} pixels wide and {height} high, got {text!r} "
            "as X,Y,W,H; move or shrink it"
        )
    return left / width, top / height, (left + across) / width, (top + down) / height


def parse_number(text: str, parameter: Parameter) -> float | str:
    """Parse the value of an option that takes a positive number, or one of the parameter's words.

    >>> from nlfilter_torch.photo.declared.parameters import DETAIL
    >>> [parse_number(text, DETAIL["bandwidth"]) for text in ("51", "auto")]
    [51.0, 'auto']
    """
    if text in parameter.words:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    name, unit = f"--{parameter.name.replace('_', '-')}", UNIT_NAMES[parameter.unit][0]
    of_unit, usual = f" of {unit}" if unit else "", "20" if unit else "5500"
    words = "".join(f", or {word}" for word in parameter.words)
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be a positive number{of_unit}, such as {usual}{words}, got {text!r}")
    if not parameter.low <= value <= parameter.high:
        raise ValueError(
            f"{name} must be from {parameter.low:g} to {parameter.high:.0f}{unit and ' '}{unit}{words}, got {text!r}; "
            f"{usual} suits most photographs"
        )
    return value


def check_odd(value: int, parameter: Parameter) -> None:
    """Raise ValueError unless the value of an option is odd and positive; its upper limit is checked by typer."""
    if value < 1 or value % 2 == 0:
        nearest = min(abs(value) // 2 * 2 + 1, int(parameter.high))
        raise ValueError(f"--{parameter.name.replace('_', '-')} must be odd and at least 1, got {value}; try {nearest}")


Source = Annotated[str, typer.Argument(metavar="IN", help="The photograph: a PNG, JPEG, TIFF, WebP or AVIF file.")]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        max=2**63 - 1,
        metavar="N",
        help="Random seed: the same seed gives the same picture again, another seed a variation of it.",
        rich_help_panel=FILTER_PANEL,
    ),
]
Target = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The edited photograph; its extension (.png, .jpg, .tif, .webp, .avif) selects the file type.",
    ),
]
OutputDepth = Annotated[
    FileDepth | None,
    typer.Option(
        help="Bits per channel of the output, or floats (TIFF only). Default: as in the input.",
        rich_help_panel=FILES_PANEL,
    ),
]
Memory = Annotated[
    float | None,
    typer.Option(
        metavar="GB",
        help="Memory limit in gigabytes, in addition to 0.3 for the program itself. A photograph that needs more is "
        "processed in tiles, without seams. Default: a fifth of the machine's memory, but at most 2, or 1 in tiles.",
        rich_help_panel=FILES_PANEL,
    ),
]
Full = Annotated[
    bool,
    typer.Option(
        "--full",
        help="In tiles: compute statistics from every pixel instead of a sample. Takes two or three times as long.",
        rich_help_panel=FILES_PANEL,
    ),
]


Pages = Annotated[
    bool,
    typer.Option(
        "--pages",
        help="Edit all pages of a TIFF file, one after the other in memory, and write them to another TIFF file.",
        rich_help_panel=FILES_PANEL,
    ),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Write over the photograph itself if OUT is IN, and accept values beyond the usual ranges.",
        rich_help_panel=FILES_PANEL,
    ),
]
Insist = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Accept values beyond the usual ranges.",
        rich_help_panel=FILES_PANEL,
    ),
]


def quality(help: str) -> object:
    """The option ``--quality``."""
    default = "Default: 95 for JPEG, 90 for AVIF; WebP is lossless without it."
    return typer.Option(min=1, max=100, metavar="1-100", help=f"{help} {default}", rich_help_panel=FILES_PANEL)


Quality = Annotated[int | None, quality("Quality of a JPEG, WebP or AVIF file.")]
QualityOfFolder = Annotated[int | None, quality("Quality of JPEG, WebP and AVIF files; others are not affected.")]


def workers(help: str) -> object:
    """The option ``--workers``."""
    return typer.Option(min=1, metavar="N", help=help)


def cluster(beginning: str, work: str) -> object:
    """The option ``--cluster``, whose workers do some work."""
    help = (
        f"{beginning} address of a Dask cluster, such as tcp://host:8786, whose workers {work}. They have one thread "
        "each and see the folders under the same names. Needs the extra cluster."
    )
    return typer.Option(metavar="ADDRESS", help=help)


Workers = Annotated[
    int | None,
    workers("With zarr arrays as IN and OUT: filter and write their parts by this many processes instead of threads."),
]
Cluster = Annotated[str | None, cluster("With zarr arrays as IN and OUT: the", "filter and write their parts")]
WorkersOfFolder = Annotated[
    int | None,
    workers("How many photographs are edited at a time; each takes memory of its own. Default: one per core."),
]
ClusterOfFolder = Annotated[str | None, cluster("The", "edit the photographs in place of this machine")]


@dataclass(frozen=True)
class PhotographOptions:
    """The options of a command that reads one photograph and writes another, in the order of its help."""

    depth: OutputDepth = None
    quality: Quality = None
    pages: Pages = False
    force: Force = False
    memory: Memory = None
    workers: Workers = None
    cluster: Cluster = None


@dataclass(frozen=True)
class FolderOptions:
    """The options of a command that edits the photographs of a folder, in the order of its help."""

    workers: WorkersOfFolder = None
    cluster: ClusterOfFolder = None
    memory: Memory = None
    quality: QualityOfFolder = None
    force: Insist = False


def file(name: str, help: str) -> object:
    """An option for a file."""
    return Annotated[Path | None, typer.Option(name, metavar="FILE", help=help)]


def rectangles(name: str, metavar: str, help: str) -> object:
    """An option for rectangles, which may be given several times."""
    return Annotated[list[str] | None, typer.Option(name, metavar=metavar, help=help)]


StrokesFile = file(
    "--strokes",
    "Scribbles on the photograph: a PNG, TIFF or WebP picture of its size, transparent where nothing is drawn, or an "
    "edit file (.json), whose strokes are taken, whatever edit they were drawn for.",
)
Colour = Annotated[
    str | None,
    typer.Option(
        "--colour", "--to", metavar="COLOUR", help="Colour of --mask, and of regions and strokes without one."
    ),
]
ColourRange = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="COLOUR",
        help="Mark all pixels that look like a colour, such as red or #c04020, in place of a region; with --to.",
    ),
]
_SHAPES = "`ellipse:X,Y,W,H` is the ellipse in a rectangle, and X,Y,X,Y,X,Y and so on are the corners of a polygon. "
#: The placeholder of a rectangle and the help of ``--region``, for each kind of scribbles.
REGIONS: dict[ScribbleKind, tuple[str, str]] = {
    "colours": (
        "X,Y,W,H:COLOUR",
        "A rectangle of colour, instead of scribbles or on top of them: column and row of its upper left corner, width "
        "and height, in pixels or in % of the photograph, and a colour such as red or #c04020; X,Y alone is a small "
        f"square around that point. {_SHAPES}May be repeated; later ones cover earlier ones.",
    ),
    "mask": (
        "X,Y,W,H",
        "A rectangle: column and row of its upper left corner, width and height, in pixels or in % of the photograph; "
        f"X,Y alone is a small square around that point. {_SHAPES}May be repeated.",
    ),
    "sliders": (
        "X,Y,W,H[:SLIDERS]",
        "Edit only what resembles a rectangle: column and row of its upper left corner, its width and height, and its "
        f"own sliders if they differ from --alpha, such as 60,300,20,20:3,3,4,1. {_SHAPES}May be repeated.",
    ),
}
MaskFile = file(
    "--mask",
    "A picture of the same size as the photograph, white where selected and black elsewhere. Pixels darker than middle "
    "grey are not selected.",
)
_LOOK_MASK = "A grey picture of the size of the photograph, white in the region of one look. May be repeated."
Masks = Annotated[list[Path] | None, typer.Option("--mask", metavar="FILE", help=_LOOK_MASK)]
MasksOfPairs = Annotated[
    list[Path] | None,
    typer.Option(
        "--mask",
        metavar="FILE",
        help=f"{_LOOK_MASK} For folders of photographs, a folder of such pictures under the same names.",
    ),
]
Show = file(
    "--show",
    "Picture to write before the edit: the photograph, reduced, with the scribbles and the selected area marked on it.",
)
