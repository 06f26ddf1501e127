"""Scribbles, masks and rectangles on a photograph, from the options of a command."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from PIL import ImageColor
from torch import Tensor

from nlfilter_torch.cli.options import parse_sliders
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.io.photographs import Photograph, read_photograph

Size = tuple[int, int]  # (height, width) of the photograph


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in a photograph, and the text after its colon."""

    rows: slice
    columns: slice
    note: str | None

    @staticmethod
    def parse(text: str, option: str, size: tuple[int, int]) -> "Rectangle":
        """Read ``X,Y,W,H`` or ``X,Y,W,H:NOTE`` for a photograph of ``size`` (height, width).

        >>> Rectangle.parse("2,3,4,5:red", "--region", (20, 30))
        Rectangle(rows=slice(3, 8, None), columns=slice(2, 6, None), note='red')
        """
        numbers, colon, note = text.partition(":")
        try:
            x, y, width, height = (int(part) for part in numbers.split(","))
        except ValueError:
            raise ValueError(
                f"{option} must be four whole numbers X,Y,W,H, such as 40,60,20,20, got {text!r}"
            ) from None
        if width < 1 or height < 1:
            raise ValueError(f"{option} must be at least 1 pixel wide and high, got {width}x{height} in {text!r}")
        if x < 0 or y < 0 or x + width > size[1] or y + height > size[0]:
            raise ValueError(
                f"{option} must lie within the photograph, which is {size[1]} pixels wide and {size[0]} high, got "
                f"columns {x} to {x + width - 1} and rows {y} to {y + height - 1} in {text!r}; move or shrink it"
            )
        return Rectangle(slice(y, y + height), slice(x, x + width), note if colon else None)


def of_edit(
    step: Step, photograph: Photograph, given: Mapping[str, Any]
) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
    """Scribbles and masks from the options of an edit, in the form of :func:`scribbles_of`."""
    size, mask, regions = photograph.size, given.get("mask"), given.get("region")
    if step.edit in ("recolor", "colorize"):
        keep = selection(size, None, given.get("keep"), "--keep")
        strokes = colour_strokes(size, given.get("strokes"), regions)
        return strokes, {} if keep is None else {"keep": keep}
    if step.edit == "defocus":
        focus = selection(size, mask, regions, "--region")
        if focus is None:
            raise unfocused()
        return (focus,), {}
    if step.edit != "detail" or (mask is None and not regions):
        return (), {}
    masks, sliders = slider_regions(size, mask, regions, torch.tensor(step["alpha"]))
    return (masks,), {"alpha": sliders}


def unfocused() -> ValueError:
    """What to raise where nothing is to stay sharp."""
    return ValueError("give --region X,Y,W,H or --mask FILE: what is to stay sharp, such as --region 190,60,60,60")


def colour_strokes(size: Size, path: Path | None, regions: list[str] | None) -> tuple[Tensor, Tensor]:
    """Scribbles (1, 3, H, W) and their mask (1, 1, H, W) from ``--strokes`` and ``--region``."""
    check_strokes(path, regions)
    strokes, painted = torch.zeros(1, 3, *size), torch.zeros(1, 1, *size)
    if path is not None:
        painting = _read(path, size)
        if painting.alpha is None:
            raise opaque(path)
        if not bool((painting.alpha > 0).any()):
            raise ValueError(f"{path} is transparent everywhere; paint at least one stroke")
        strokes, painted = painting.pixels.float().expand(-1, 3, -1, -1).clone(), painting.alpha.float().clone()
    for rectangle, colour in coloured_rectangles(size, regions):
        strokes[0, :, rectangle.rows, rectangle.columns] = colour[:, None, None]
        painted[..., rectangle.rows, rectangle.columns] = 1
    return strokes, painted


def check_strokes(path: Path | None, regions: list[str] | None) -> None:
    """Raise unless there is ``--strokes`` or ``--region``."""
    if path is None and not regions:
        raise ValueError("give --strokes FILE or --region X,Y,W,H:COLOUR, such as --region 40,60,20,20:red")


def coloured_rectangles(size: Size, regions: list[str] | None) -> list[tuple[Rectangle, Tensor]]:
    """Rectangles of ``--region`` and their RGB colours (3,)."""
    found = []
    for text in regions or []:
        rectangle = Rectangle.parse(text, "--region", size)
        if rectangle.note is None:
            raise ValueError(f"--region must end in a colour, such as {text}:red, got {text!r}")
        try:
            colour = ImageColor.getrgb(rectangle.note)[:3]
        except ValueError:
            raise ValueError(
                "--region must end in a colour, such as red, #c04020 or rgb(192,64,32), "
                f"got {rectangle.note!r} in {text!r}"
            ) from None
        found.append((rectangle, torch.tensor(colour) / 255))
    return found


def selection(size: Size, path: Path | None, regions: list[str] | None, option: str) -> Tensor | None:
    """A mask (1, 1, H, W) from a mask file and the rectangles of an option, or None if neither is given."""
    if path is None and not regions:
        return None
    mask = torch.zeros(1, 1, *size) if path is None else _read_mask(path, size)
    for rectangle in plain_rectangles(size, regions, option):
        mask[..., rectangle.rows, rectangle.columns] = 1
    return mask


def plain_rectangles(size: Size, regions: list[str] | None, option: str) -> list[Rectangle]:
    """Rectangles of an option that takes nothing after them."""
    found = []
    for text in regions or []:
        found.append(Rectangle.parse(text, option, size))
        if found[-1].note is not None:
            raise ValueError(f"{option} must be X,Y,W,H alone here, got {text!r}; leave out what follows the colon")
    return found


def slider_regions(size: Size, path: Path | None, regions: list[str] | None, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Regions (1, K, H, W) and their sliders (K, k+1) from ``--mask`` and ``--region``, at least one of them given.

    A mask, and a rectangle without its own sliders, has the sliders ``alpha`` (k+1,).
    """
    masks, sliders = ([], []) if path is None else ([_read_mask(path, size)], [alpha])
    for text in regions or []:
        rectangle, own = with_sliders(text, size, alpha)
        masks.append(torch.zeros(1, 1, *size))
        masks[-1][..., rectangle.rows, rectangle.columns] = 1
        sliders.append(own)
    return torch.cat(masks, dim=1), torch.stack(sliders)


def with_sliders(text: str, size: Size, alpha: Tensor) -> tuple[Rectangle, Tensor]:
    """A rectangle of ``--region`` and its sliders (k+1,)."""
    rectangle = Rectangle.parse(text, "--region", size)
    own = alpha if rectangle.note is None else torch.tensor(parse_sliders(rectangle.note, "--region"))
    if len(own) != len(alpha):
        raise ValueError(
            f"--region must have as many sliders as --alpha, {len(alpha)}, got {len(own)} in {text!r}; "
            "repeat or drop some"
        )
    return rectangle, own


def _read_mask(path: Path, size: Size) -> Tensor:
    mask = _read(path, size).pixels.float().mean(1, keepdim=True).clamp(0, 1)
    if not bool((mask > 0).any()):
        raise ValueError(f"{path} is black everywhere; paint white what is to be selected")
    return mask


def _read(path: Path, size: Size) -> Photograph:
    picture = read_photograph(path)
    check_size(path, picture.size, size)
    return picture


def check_size(path: Path, found: Size, size: Size) -> None:
    """Raise unless a picture over a photograph of ``size`` has its height and width."""
    if found != size:
        raise ValueError(
            f"{path} must be as large as the photograph, {size[1]}x{size[0]}, but is {found[1]}x{found[0]}; resize one"
        )


def opaque(path: Path) -> ValueError:
    """The error for a picture of scribbles without transparency."""
    return ValueError(
        f"{path} has no transparency, so that every pixel of it would be a stroke; "
        "paint on a transparent layer and save that"
    )
