"""What scribbles cover: their colours as text, a note where one covers very different colours, and a picture.

Also other notes on what an edit does to a photograph.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import torch
import torch.nn.functional as F
import typer
from torch import Tensor

from nlfilter_torch.photo.cli.options import note
from nlfilter_torch.photo.cli.scribbles import MarkedPhotograph
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.picture.boxes import held, scaled
from nlfilter_torch.photo.picture.colour import hundredths_of_lab
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import MARKS, PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image
from nlfilter_torch.photo.picture.painting import cover, plane_rows
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.selections.scribbled_colours import frame_places
from nlfilter_torch.photo.selections.stray import stray_parts

Read = Callable[[slice], Tensor]  # rows of the photograph as (1, C, h, W) in [0, 1]
MAX_PIXELS = 500_000  # largest size of the picture that shows scribbles
LARGE_DISTANCE = 0.2  # Lab distance, divided by 100, beyond which two colours are very different
BORDER_SHARE = 0.9  # selected share of the picture's borders above which a note is printed
NOTE_SHARE = 0.15  # share of such pixels above which a note is printed
SHOWN_ROWS = 64
HATCH_STEP = 4  # pixels from one line to the next
OUTSIDE_BRIGHTNESS = 0.4  # brightness outside the mask, where the picture is shown in grey


@dataclass(frozen=True)
class Scribbled:
    """A photograph with marks of an edit.

    Attributes:
        marked: the marks.
        rows: the photograph.
    """

    marked: MarkedPhotograph
    rows: Rows

    def check(self) -> None:
        """Raise ValueError if there are no marks to show."""
        if not self.marked.marks:
            raise ValueError("--show needs scribbles; give --region X,Y,W,H, or omit --show")

    def tell_colours(self) -> None:
        """Print the colour under each region, and a note on standard error if some cover very different colours."""
        height, width = self.rows.size
        for option, regions in groupby(self.marked.drawn_regions(), key=itemgetter(0)):
            shares = dict[str, float]()
            for _, region in regions:
                heights = [y * height for _, y in region.outline]
                rows = slice(max(0, math.floor(min(heights))), min(height, math.ceil(max(heights)) + 1))
                pixels = self.rows.read(rows)[..., cover(region, (height, width), rows)].float().clamp(0, 1)
                place = f"{option} {region.text((height, width))}"
                if pixels.shape[2]:
                    middle = pixels.median(2).values
                    red, green, blue = (middle[0].expand(3) * 255).round().int().tolist()
                    typer.echo(f"{place}: {pixels.shape[2]} pixels, median colour #{red:02x}{green:02x}{blue:02x}")
                    shares[place] = unlike(pixels, middle)
            note_mixed(shares, option)

    def show(self, target: Path, edit_at: Callable[[tuple[int, int], float], PhotoEdit]) -> None:
        """Write the photograph, reduced, with scribbles and mask over it.

        Args:
            target: an image file.
            edit_at: the edit with settings for a reduced size and its sampling step in pixels.
        """
        size = self.rows.size
        stride = math.ceil(math.sqrt(max(1.0, size[0] * size[1] / MAX_PIXELS)))
        image = _reduced(self.rows.read, size, stride, F.avg_pool2d).float().clamp(0, 1).expand(-1, 3, -1, -1)
        drawn = self.marked.rows()
        marks, colours = self._marks(drawn, stride)
        small = (image.shape[-2], image.shape[-1])
        boxes = None
        if drawn.box is not None:  # one around all
            boxes = scaled(torch.as_tensor(drawn.box), size, small)
            boxes = torch.cat([boxes[..., :2].amin(1, True), boxes[..., 2:].amax(1, True)], dim=2)
        painted, kept = marks.get("scribbles", torch.zeros_like(image[:, :1])), marks.get("background")
        selection = edit_at(small, stride).selection()
        mask = torch.ones_like(image[:, :1])  # all pixels are changed
        if selection is not None:
            mask = edit_image(selection, image, Drawn(marks, box=boxes))
        shown = drawn_over(image, mask, colours, painted, kept)
        for plane in (marks.get("scribbles"), kept):
            shown = shown if plane is None else hatched(shown, stray_parts(InMemory(image), plane))
        if boxes is not None:
            inside = held(boxes, small).any(1, keepdim=True).float()
            shown = torch.where(F.max_pool2d(inside, 3, 1, 1) > inside, torch.ones_like(shown), shown)
        write_photograph(Photograph(shown), target)

    def _marks(self, drawn: Drawn[RowSource], stride: int) -> tuple[dict[str, Tensor], Tensor | None]:
        """The scribbles at a reduced size, under the names that the edit of their mask takes, and their colours."""
        marks, colours = dict[str, Tensor](), None
        for scribble in self.marked.edit.scribbles:
            coloured, is_object = scribble.kind == "colours", scribble.role == "object"
            source = drawn.colours if coloured and is_object else drawn.masks.get(scribble.argument)
            if source is None:
                continue
            # Even marks of less than a reduced pixel remain visible.
            planes = _reduced(partial(_planes, source), self.rows.size, stride, F.max_pool2d)
            if coloured:
                colours = planes[:, :3] if is_object else colours
                planes = planes[:, 3:]
            marks[MARKS[scribble.role]] = planes.amax(1, keepdim=True)
        if "scribbles" in marks:
            marks["scribbles"] = marks["scribbles"].ceil()
            if "background" in marks:  # the scribbles on the object take precedence
                marks["background"] = marks["background"] * (1 - marks["scribbles"])
        if "background" in marks and not bool(marks["background"].any()):
            del marks["background"]
        return marks, colours


def note_mixed(shares: Mapping[str, float], option: str) -> None:
    """Print one note on all rectangles of an option that cover very different colours, by the shares of these."""
    mixed = {place: share for place, share in shares.items() if share > NOTE_SHARE}
    if not mixed:
        return
    place, share = max(mixed.items(), key=itemgetter(1))
    others = f", and {len(mixed) - 1} more of {len(shares)}," if len(mixed) > 1 else ""
    cover, whose = ("cover", "the first one's") if others else ("covers", "its")
    note(
        f"{place}{others} {cover} very different colours: {100 * share:.0f} % of {whose} pixels differ "
        f"strongly from the median; mark each part separately, with a smaller {option} on each, and check "
        "them with --show FILE"
    )


def drawn_over(image: Tensor, mask: Tensor, colours: Tensor | None, painted: Tensor, kept: Tensor | None) -> Tensor:
    """An image (1, 3, H, W), grey and dark outside the mask, with scribbles over it.

    Args:
        image: the photograph, reduced.
        mask: of the selected area, (1, 1, H, W).
        colours: of the scribbles on the object; None is green.
        painted: pixels under the scribbles on the object, (1, 1, H, W).
        kept: those under the scribbles on the background, or None.
    """
    outside = OUTSIDE_BRIGHTNESS * image.mean(1, keepdim=True)  # grey, since any tint may occur in the picture
    shown = torch.lerp(outside.expand_as(image), image, mask)
    if colours is None:
        colours = shown.new_tensor((0.1, 0.8, 0.3)).view(1, 3, 1, 1).expand_as(shown)
    shown = torch.lerp(shown, colours, 0.75 * painted)
    if kept is not None:
        shown = torch.lerp(shown, torch.full_like(shown, 0.6), 0.75 * kept.ceil())
        painted = painted.maximum(kept.ceil())
    rim = F.max_pool2d(painted, 3, stride=1, padding=1) - painted
    return torch.where(rim > 0, torch.ones_like(shown), shown)


def hatched(shown: Tensor, places: Tensor) -> Tensor:
    """A picture (1, 3, H, W) with black lines on some pixels, (1, 1, H, W)."""
    height, width = shown.shape[-2:]
    lines = (torch.arange(height).unsqueeze(1) + torch.arange(width)) % HATCH_STEP < HATCH_STEP // 2
    return torch.where((places > 0) & lines, torch.zeros_like(shown), shown)


def tell_selected(mask: Tensor, *, opposed: bool) -> None:
    """Print the share of a picture that a mask (1, 1, H, W) selects, and a note if its borders belong to it too.

    There is no note if it is ``opposed`` by scribbles on the background.
    """
    typer.echo(f"selected: {100 * float(mask.mean()):.0f} % of the picture")
    borders = mask.flatten(2)[..., frame_places((mask.shape[-2], mask.shape[-1]))]
    if float(borders.mean()) > BORDER_SHARE and not opposed:
        note("nearly all of the picture's borders are selected; mark what is not part of the object with --background")


def notes_if_idle(recipe: Recipe, name: str, what: str = "the photograph is written") -> list[str]:
    """A note if an edit changes nothing; ``what`` says what is done all the same."""
    return [] if recipe.changes else [f"{name} holds no step that changes anything: {what} without an edit"]


def unlike(pixels: Tensor, middle: Tensor) -> float:
    """The share of pixels (1, C, n) whose colour is very different from a colour (1, C)."""
    lab = hundredths_of_lab(pixels.expand(-1, 3, -1).unsqueeze(2)) - hundredths_of_lab(
        middle.expand(-1, 3)[..., None, None]
    )
    return float((lab.norm(dim=1) > LARGE_DISTANCE).float().mean())


def _planes(source: RowSource, rows: slice) -> Tensor:
    """Some rows of masks or colours, as planes (1, K, h, W)."""
    return torch.from_numpy(plane_rows(source, rows)).permute(2, 0, 1)[None]


def _reduced(read: Read, size: tuple[int, int], stride: int, pool: Callable[..., Tensor]) -> Tensor:
    """Pool blocks of ``stride`` pixels along each axis, with only some rows in memory at once; the last are smaller."""
    starts = range(0, size[0], SHOWN_ROWS * stride)
    parts = (read(slice(start, min(start + SHOWN_ROWS * stride, size[0]))) for start in starts)
    return torch.cat([pool(part, stride, ceil_mode=True) for part in parts], dim=2)
