"""``nlfilter-torch fit``: find the sliders that turn one photograph into another, and save them as a preset."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlfilter_torch.cli.edits import step_of, with_options
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.edits.parameters import EDITS
from nlfilter_torch.edits.presets import Preset

if TYPE_CHECKING:
    from torch import Tensor

    from nlfilter_torch.io.photographs import Photograph

Before = Annotated[str, typer.Argument(metavar="BEFORE", help="The photograph before the edit.")]
After = Annotated[str, typer.Argument(metavar="AFTER", help="The same photograph after the edit, of the same size.")]
Result = Annotated[Path, typer.Argument(metavar="PRESET", help="The JSON file in which the result is saved.")]
Order = Annotated[
    int,
    typer.Option("--layers", min=2, max=10, metavar="N", help="Number of sliders, from the finest to the coarsest."),
]


@with_options("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling")
def fit(before: Before, after: After, preset: Result = Path("preset.json"), layers: Order = 4, **given: Any) -> None:
    """Find the sliders that turn one photograph into another, whatever program made the edit.

    Prints them and how much of the edit they explain, and saves them in a file for other photographs:

    `nlfilter-torch fit before.jpg after.jpg look.json`

    `nlfilter-torch detail other.jpg out.jpg --preset look.json`
    """
    step = step_of(EDITS["detail"], given)

    from nlfilter_torch.cli.inspect import build_operator
    from nlfilter_torch.cli.progress import steps
    from nlfilter_torch.edits.colour import edit_luminance
    from nlfilter_torch.edits.resizing import resize
    from nlfilter_torch.edits.viewing import viewed_size
    from nlfilter_torch.filtering.filters import polynomial_filter
    from nlfilter_torch.filtering.fit import fit_alpha
    from nlfilter_torch.io.photographs import check_file, open_beside, read_photograph
    from nlfilter_torch.operator.features import reduce_channels

    check_file(preset)
    with steps(3) as begin:
        begin("Reading")
        memory = working_bytes(step["landmarks"], step["patch_size"])
        source, target = (read_photograph(path, bytes_per_pixel=memory) for path in (before, after))
        image, edited = (reduce_channels(photograph.pixels, "luminance") for photograph in (source, target))
        free = unclipped(target, after)
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
        size = (image.shape[-2], image.shape[-1])
        viewed = viewed_size(size, step["viewing_size"])  # at which detail applies the preset
        before_edit = source.pixels
        if viewed != size:
            image, edited, free, before_edit = (resize(planes, viewed) for planes in (image, edited, free, before_edit))
            free = (free > 0.99).to(image)
        rounding = 0.5 * spacing(target) if viewed == size else 0.0
        operator = build_operator(image, step)

        begin("Fitting")
        alpha = fit_alpha(operator, image, edited, order=layers - 1, mask=free, rounding=rounding)[0]
        filtered = edit_luminance(before_edit, lambda planes: polynomial_filter(operator, planes, alpha))
        fitted = reduce_channels(stored(filtered, target) if viewed == size else filtered.clamp(0, 1), "luminance")
        sliders = tuple(round(a, 6) for a in alpha.tolist())
        # What was fitted is linear: no limits, and all detail alike.
        found = Preset(**{**dict(step.values), "alpha": sliders, "threshold": 0.0, "limits": "none"})
        with open_beside(preset) as stream:
            stream.write(found.to_json().encode())
    typer.echo("alpha: " + ", ".join(f"{a:.3f}" for a in found.alpha))
    typer.echo(f"explained: {100 * explained(image, edited, fitted):.1f} % of the change in brightness")
    typer.echo(f"preset: {preset}")


def spacing(photograph: "Photograph") -> float:
    """Difference of neighbouring values in the file; 0 for floats."""
    from nlfilter_torch.tiled.sources import WHITE

    return 1 / WHITE[photograph.depth] if photograph.depth in WHITE else 0.0


def unclipped(photograph: "Photograph", name: str) -> "Tensor":
    """Mask (1, 1, H, W) of the pixels of an edited file that are not clipped to black or white."""
    values = photograph.pixels
    inside = ((values > 0) & (values < 1)) | (spacing(photograph) == 0)  # floats are not clipped
    if not bool(inside.all(1).any()):
        raise ValueError(
            f"{name} must have pixels that are not clipped to black or white, got none; edit less strongly"
        )
    return inside.all(1, keepdim=True).float()


def stored(pixels: "Tensor", photograph: "Photograph") -> "Tensor":
    """Pixels clipped and rounded as a file like ``photograph`` stores them."""
    step = spacing(photograph)
    return (pixels.clamp(0, 1) / step).round() * step if step else pixels


def explained(before: "Tensor", after: "Tensor", fitted: "Tensor") -> float:
    """Coefficient of determination (R squared) of the fitted change, 1 at best."""
    left, change = ((after.double() - x.double()).square().sum() for x in (fitted, before))
    return 1.0 - float(left / change)
