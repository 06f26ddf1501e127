"""Options that several verbs share, in a photographer's units, and the operator that they describe."""

import math
from enum import StrEnum
from typing import Annotated, Literal

import torch
import typer
from torch import Tensor

from nlfilter_torch.operator import NonlocalOperator, nonlocal_operator

INTERRUPTED = 130  # exit status, as shells have it for Ctrl-C
LEVELS = 255.0  # grey levels between black and white, whatever the depth of the file


class Sampling(StrEnum):
    """How the landmarks are chosen."""

    kmeans = "kmeans"
    uniform = "uniform"
    random = "random"


class Channels(StrEnum):
    """What of the picture is edited."""

    luminance = "luminance"
    all = "all"


def parse_alpha(text: str) -> Tensor:
    """The sliders of ``--alpha``.

    >>> parse_alpha("3, 3,4,1.05")
    tensor([3.0000, 3.0000, 4.0000, 1.0500])
    """
    return parse_sliders(text, "--alpha")


def parse_sliders(text: str, option: str) -> Tensor:
    """Sliders with commas between, as an option gives them."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers with commas between, such as 3,3,4,1.05, got {text!r}") from None
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{option} must be finite numbers, such as 3,3,4,1.05, got {text!r}")
    if len(numbers) < 2:
        raise ValueError(f"{option} must have at least two numbers, such as 3,3,4,1.05, got {text!r}")
    return torch.tensor(numbers)


def parse_bandwidth(text: str) -> float | Literal["auto"]:
    """``--bandwidth`` in units of the picture.

    >>> parse_bandwidth("51"), parse_bandwidth("auto")
    (0.2, 'auto')
    """
    if text == "auto":
        return "auto"
    try:
        levels = float(text)
    except ValueError:
        levels = math.nan
    if not 0 < levels < math.inf:
        raise ValueError(f"--bandwidth must be a positive number of grey levels, such as 20, or auto, got {text!r}")
    return levels / LEVELS


Source = Annotated[str, typer.Argument(metavar="IN", help="The photograph: a PNG, JPEG, TIFF or WebP file.")]
Alpha = Annotated[
    str,
    typer.Option(
        "--alpha",
        metavar="A,B,...,Z",
        help="One slider for each layer, from the finest detail to the smooth shading, with commas between. 1 leaves a "
        "layer as it is, 3 makes it three times as strong, 0 takes it away.",
    ),
]
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
        metavar="PIXELS",
        help="How far apart two spots may be and still count as alike. Left out: as far as the picture goes.",
    ),
]
PatchSize = Annotated[
    int,
    typer.Option(
        metavar="PIXELS",
        help="Width of the patch around each spot that is compared; an odd number. 1 compares single pixels.",
    ),
]
Landmarks = Annotated[
    int,
    typer.Option(
        "--landmarks",
        min=1,
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
    int, typer.Option(min=0, metavar="N", help="The same number gives the same picture again, another one a variation.")
]


def build_operator(
    guide: Tensor,
    *,
    bandwidth: str,
    spatial_bandwidth: float | None,
    patch_size: int,
    landmarks: int,
    sampling: Sampling,
    seed: int,
) -> NonlocalOperator:
    """The operator of a guide, from the values of the options above; three channels are compared in colour."""
    return nonlocal_operator(
        guide,
        patch_size=patch_size,
        photometric_bandwidth=parse_bandwidth(bandwidth),
        spatial_bandwidth=spatial_bandwidth,
        num_landmarks=landmarks,
        landmarks=sampling.value,
        guide_channels="all",
        generator=torch.Generator().manual_seed(seed),
    )


def working_bytes(landmarks: int, patch_size: int, *, factors: int = 1) -> int:
    """Memory in bytes that one pixel needs, a little more than was measured on two megapixels.

    Args:
        landmarks: m; the factor has as many floats for each pixel.
        patch_size: p; the patches of a pixel are there twice while they are weighted.
        factors: arrays of the factor's size that are held at once: 1 to filter, 5 for the diagnostics.
    """
    return 4 * (factors * landmarks + 2 * patch_size**2 + 40)
