"""``nlfilter-torch fit``: find the sliders that turn one photograph into another, and keep them for the next one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.edits.presets import Preset

if TYPE_CHECKING:
    from torch import Tensor

    from nlfilter_torch.io.photographs import Photograph

Before = Annotated[str, typer.Argument(metavar="BEFORE", help="The photograph before the edit.")]
After = Annotated[str, typer.Argument(metavar="AFTER", help="The same photograph after it, of the same size.")]
Result = Annotated[Path, typer.Argument(metavar="PRESET", help="The file for what is found, a small JSON text.")]
Order = Annotated[
    int,
    typer.Option("--layers", min=2, max=10, metavar="N", help="Number of sliders, from the finest to the coarsest."),
]


def fit(
    before: Before,
    after: After,
    preset: Result = Path("preset.json"),
    layers: Order = 4,
    bandwidth: options.Bandwidth = "auto",
    spatial_bandwidth: options.SpatialBandwidth = None,
    patch_size: options.PatchSize = 5,
    landmarks: options.Landmarks = 100,
    sampling: options.LandmarkSampling = options.Sampling.kmeans,
) -> None:
    """Find the sliders that turn one photograph into another, whatever program made the edit.

    Prints them, says how much of the edit they explain, and keeps them in a file for other photographs:

    `nlfilter-torch fit before.jpg after.jpg look.json`

    `nlfilter-torch detail other.jpg out.jpg --preset look.json`
    """
    grey_levels = options.parse_bandwidth(bandwidth)

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli.progress import steps
    from nlfilter_torch.edits.colour import edit_luminance
    from nlfilter_torch.filtering.filters import polynomial_filter
    from nlfilter_torch.filtering.fit import fit_alpha
    from nlfilter_torch.io.photographs import check_file, open_beside, read_photograph
    from nlfilter_torch.operator.features import reduce_channels

    check_file(preset)
    with steps(3) as begin:
        begin("Reading")
        memory = working_bytes(landmarks, patch_size)
        source, target = (read_photograph(path, bytes_per_pixel=memory) for path in (before, after))
        image, edited = (reduce_channels(photograph.pixels, "luminance") for photograph in (source, target))
        if image.shape != edited.shape:
            height, width = image.shape[2:]
            raise ValueError(
                f"{after} must have the size of {before}, {width}x{height}, got {edited.shape[3]}x{edited.shape[2]}; "
                "an edit that crops or scales cannot be fitted"
            )
        if bool((image == edited).all()):
            raise ValueError(
                f"{after} must differ from {before}, but is as bright everywhere; give an edited photograph"
            )

        begin("Comparing patches")
        operator = editing.build_operator(
            image,
            bandwidth=grey_levels,
            spatial_bandwidth=spatial_bandwidth,
            patch_size=patch_size,
            landmarks=landmarks,
            sampling=sampling,
            seed=0,
        )

        begin("Fitting")
        alpha = fit_alpha(
            operator, image, edited, order=layers - 1, mask=unclipped(target, after), rounding=0.5 * step_of(target)
        )[0]
        filtered = edit_luminance(source.pixels, lambda planes: polynomial_filter(operator, planes, alpha))
        fitted = reduce_channels(stored(filtered, target), "luminance")
        found = Preset(
            alpha=tuple(round(a, 6) for a in alpha.tolist()),
            bandwidth="auto" if grey_levels == "auto" else float(bandwidth),
            spatial_bandwidth=spatial_bandwidth,
            patch_size=patch_size,
            landmarks=landmarks,
            sampling=sampling.value,
        )
        with open_beside(preset) as stream:
            stream.write(found.to_json().encode())
    typer.echo("alpha: " + ", ".join(f"{a:.3f}" for a in found.alpha))
    typer.echo(f"explained: {100 * explained(image, edited, fitted):.1f} % of the change in brightness")
    typer.echo(f"preset: {preset}")


def step_of(photograph: "Photograph") -> float:
    """Distance of two values that the file can tell apart."""
    from nlfilter_torch.io.photographs import WHITE

    return 1 / WHITE[photograph.depth] if photograph.depth in WHITE else 0.0


def unclipped(photograph: "Photograph", name: str) -> "Tensor":
    """Mask (1, 1, H, W) of the pixels of an edited file that tell how bright they were to be, those it could hold."""
    import torch

    if step_of(photograph) == 0.0:
        return torch.ones_like(photograph.pixels[:, :1])
    inside = ((photograph.pixels > 0) & (photograph.pixels < 1)).all(1, keepdim=True)
    if not bool(inside.any()):
        raise ValueError(
            f"{name} must have pixels that are not clipped to black or white, got none; edit less strongly"
        )
    return inside.float()


def stored(pixels: "Tensor", photograph: "Photograph") -> "Tensor":
    """What is left of pixels after they were written to a file like ``photograph``."""
    step = step_of(photograph)
    return pixels if step == 0.0 else (pixels.clamp(0, 1) / step).round() * step


def explained(before: "Tensor", after: "Tensor", fitted: "Tensor") -> float:
    """Share of the squared change that is not left over: R squared, 1 at best."""
    left, change = ((after.double() - x.double()).square().sum() for x in (fitted, before))
    return 1.0 - float(left / change)
