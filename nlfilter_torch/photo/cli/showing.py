"""What scribbles cover: their colours as text, a note where one covers very different colours, and a picture.

Also other notes on what an edit does to a photograph.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
import typer
from torch import Tensor

from nlfilter_torch.photo.cli.options import note
from nlfilter_torch.photo.cli.scribbles import Overlay, Strokes
from nlfilter_torch.photo.declared.parameters import MASK
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.defocus import REACH
from nlfilter_torch.photo.io.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.colour import hundredths_of_lab
from nlfilter_torch.photo.picture.source import seeded
from nlfilter_torch.photo.selections.mask import region_mask
from nlfilter_torch.photo.selections.scribbled_colours import frame_places

Read = Callable[[slice], Tensor]  # rows of the photograph as (1, C, h, W) in [0, 1]
MAX_PIXELS = 500_000  # largest size of the picture that shows scribbles
LARGE_DISTANCE = 0.2  # Lab distance, divided by 100, beyond which two colours are very different
TINT = 1 / 255  # difference of channels of a grey pixel under a look
BORDER_SHARE = 0.9  # selected share of the picture's borders above which a note is printed
NOTE_SHARE = 0.15  # share of such pixels above which a note is printed
CHUNK_ROWS = 64
COLOUR_ROWS = 16  # rows of a photograph that are read to see whether it is in colour
COLOURED, COLOURED_SHARE = 0.04, 0.01  # difference of channels in a coloured pixel, and share of such pixels
OUTSIDE_BRIGHTNESS = 0.4  # brightness outside the mask, where the picture is shown in grey


def overlays(drawn: tuple[tuple[Any, ...], dict[str, Any]]) -> Iterator[tuple[str, Overlay]]:
    """Yield the scribbles of an edit, with the option that they come from."""
    scribbles, named = drawn
    spared = ((f"--{name}", named.get(name)) for name in ("keep", "background"))
    for option, found in (*(("--region", each) for each in scribbles), *spared):
        if isinstance(found, Overlay):
            yield option, found


def tell_colours(drawn: Iterator[tuple[str, Overlay]], read: Read) -> None:
    """Print the colour under each rectangle, and a note on standard error if it covers very different colours."""
    for option, overlay in drawn:
        for rectangle, _, _ in overlay.rectangles:
            pixels = read(rectangle.rows)[..., rectangle.columns].float().clamp(0, 1).flatten(2)
            middle = pixels.median(2).values
            red, green, blue = (middle[0].expand(3) * 255).round().int().tolist()
            place = f"{option} {rectangle}"
            typer.echo(f"{place}: {pixels.shape[2]} pixels, median colour #{red:02x}{green:02x}{blue:02x}")
            share = unlike(pixels, middle)
            if share > NOTE_SHARE:
                note(
                    f"{place} covers very different colours: {100 * share:.0f} % of its pixels differ strongly from "
                    f"the median; mark each part separately, with a smaller {option} on each, and check them with "
                    "--show FILE"
                )


def tell_selected(mask: Tensor, background: list[str] | None) -> None:
    """Print the share of a picture that a mask (1, 1, H, W) selects, and a note if its borders belong to it too."""
    typer.echo(f"selected: {100 * float(mask.mean()):.0f} % of the picture")
    borders = mask.flatten(2)[..., frame_places((mask.shape[-2], mask.shape[-1]))]
    if float(borders.mean()) > BORDER_SHARE and not background:
        note("nearly all of the picture's borders are selected; mark what is not part of the object with --background")


def note_colours(name: str, size: tuple[int, int], read: Read) -> None:
    """Print a note if a photograph to which ``colorize`` is applied is in colour."""
    step = max(1, size[0] // COLOUR_ROWS)
    rows = torch.cat([read(slice(y, y + 1)).float() for y in range(step // 2, size[0], step)], dim=2)
    if bool(((rows.amax(1) - rows.amin(1)) > COLOURED).float().mean() > COLOURED_SHARE):
        note(
            f"{name} is in colour: colorize replaces its colours everywhere by those of the scribbles; "
            "to change the colour of one object, use recolor"
        )


def note_idle(recipe: Recipe, name: str) -> None:
    """Print a note if an edit changes nothing."""
    if not recipe.acting:
        note(f"{name} holds no step that changes anything: the photograph is written as it is")


def note_grey(steps: Iterable[Step], name: str) -> None:
    """Print a note if one of the steps of an edit of a grey photograph gives colours to greys."""
    ramp = torch.linspace(0, 1, 64).view(1, 1, 8, 8).expand(-1, 3, -1, -1)
    for step in steps:
        if step.edit == "look":
            found = apply_step(step, ramp)
            if bool((found.amax(1) - found.amin(1)).amax() > TINT):
                note(f"{name} is grey and stays grey, without the colours of the look; convert it to RGB first")


def unlike(pixels: Tensor, middle: Tensor) -> float:
    """The share of pixels (1, C, n) whose colour is very different from a colour (1, C)."""
    lab = hundredths_of_lab(pixels.expand(-1, 3, -1).unsqueeze(2)) - hundredths_of_lab(
        middle.expand(-1, 3)[..., None, None]
    )
    return float((lab.norm(dim=1) > LARGE_DISTANCE).float().mean())


def show(
    target: Path,
    edit: str,
    arguments: Callable[[tuple[int, int], float], dict[str, Any]],
    size: tuple[int, int],
    read: Read,
    drawn: tuple[tuple[Any, ...], dict[str, Any]],
) -> None:
    """Write the photograph, reduced, with scribbles and mask over it.

    Args:
        target: an image file.
        edit: the name of the edit that the scribbles are for, or ``mask``.
        arguments: computes the arguments of its function for a reduced size and its sampling step in pixels.
        size: (H, W) of the photograph.
        read: reads its rows.
        drawn: the scribbles, as of :func:`~nlfilter_torch.photo.cli.scribbles.of_edit`.
    """
    stride = math.ceil(math.sqrt(max(1.0, size[0] * size[1] / MAX_PIXELS)))
    image = _reduced(read, size, stride, F.avg_pool2d).float().clamp(0, 1).expand(-1, 3, -1, -1)
    laid = {option: _planes(overlay, size, stride) for option, overlay in overlays(drawn)}
    region, kept = laid["--region"], laid.get("--keep", laid.get("--background"))
    is_strokes = any(isinstance(overlay, Strokes) for _, overlay in overlays(drawn))
    painted = region[:, 3:].ceil() if is_strokes else region.amax(1, keepdim=True).ceil()
    if kept is not None:
        kept = kept * (1 - painted)  # the scribbles on the object take precedence
        kept = kept if bool(kept.any()) else None
    options = arguments((image.shape[-2], image.shape[-1]), stride)
    if edit == "colorize":
        mask = torch.ones_like(painted)  # all pixels are coloured
    else:
        names = {parameter.keyword for parameter in MASK}
        if edit == "detail":  # other bandwidths are those of the detail filter
            options = {"reach": options["reach"], "photometric_bandwidth": options["mask_bandwidth"]}
        taken = {name: value for name, value in options.items() if name in names}
        if edit == "defocus":
            taken["reach"] = REACH
        mask = region_mask(image, painted, kept, **taken, generator=seeded())
    outside = OUTSIDE_BRIGHTNESS * image.mean(1, keepdim=True)  # grey, since any tint may occur in the picture
    shown = torch.lerp(outside.expand_as(image), image, mask)
    colours = region[:, :3] if is_strokes else shown.new_tensor((0.1, 0.8, 0.3)).view(1, 3, 1, 1).expand_as(shown)
    shown = torch.lerp(shown, colours, 0.75 * painted)
    if kept is not None:
        shown = torch.lerp(shown, torch.full_like(shown, 0.6), 0.75 * kept.ceil())
        painted = painted.maximum(kept.ceil())
    rim = F.max_pool2d(painted, 3, stride=1, padding=1) - painted
    write_photograph(Photograph(torch.where(rim > 0, torch.ones_like(shown), shown)), target)


def _planes(overlay: Overlay, size: tuple[int, int], stride: int) -> Tensor:
    """Reduce scribbles; one that covers less than a pixel remains visible."""

    def rows(part: slice) -> Tensor:
        return torch.from_numpy(overlay[part]).permute(2, 0, 1)[None]

    return _reduced(rows, size, stride, F.max_pool2d)


def _reduced(read: Read, size: tuple[int, int], stride: int, pool: Callable[..., Tensor]) -> Tensor:
    """Pool blocks of ``stride`` pixels along each axis, with only some rows in memory at once; the last are smaller."""
    starts = range(0, size[0], CHUNK_ROWS * stride)
    parts = (read(slice(start, min(start + CHUNK_ROWS * stride, size[0]))) for start in starts)
    return torch.cat([pool(part, stride, ceil_mode=True) for part in parts], dim=2)
