"""A whole edit, as the editor saves it, on a picture larger than memory: its steps in turn, in tiles of rows."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import torch
from numpy.typing import NDArray

from nlfilter_torch.edits.applying import seeded
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.scribbles import Stroke, mask_of, paint
from nlfilter_torch.edits.steps import Step
from nlfilter_torch.tiled.colorize import colorize_rows
from nlfilter_torch.tiled.detail import detail_rows
from nlfilter_torch.tiled.recolor import recolor_rows
from nlfilter_torch.tiled.sources import Picture, Rows, RowSource
from nlfilter_torch.tiled.tiles import TILE_PIXELS, Passes

Floats = NDArray[np.float32]
LOOKED_AT = 64  # rows read at once


@dataclass(frozen=True)
class CoveredRows:
    """The mask of strokes over a picture: rows (h, W, 1) of zeros and ones.

    Attributes:
        strokes: of any paint.
        size: (H, W).
    """

    strokes: tuple[Stroke, ...]
    size: tuple[int, int]
    dtype = np.dtype(np.float32)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 1)."""
        return (*self.size, 1)

    def any(self) -> bool:
        """Whether they cover a pixel."""
        starts = range(0, self.size[0], LOOKED_AT)
        return any(self[start : min(start + LOOKED_AT, self.size[0])].any() for start in starts)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        found: Floats = mask_of(self.strokes, self.size, rows)[0].permute(1, 2, 0).numpy()
        return found


@dataclass(frozen=True)
class ColouredRows(CoveredRows):
    """Coloured strokes over a picture: rows (h, W, 4) in RGB and their mask."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 4)."""
        return (*self.size, 4)

    def __getitem__(self, rows: slice) -> Floats:
        """The rows from ``rows.start`` to ``rows.stop``."""
        found: Floats = torch.cat(paint(self.strokes, self.size, rows), dim=1)[0].permute(1, 2, 0).numpy()
        return found


def edit_rows(passes: Passes, source: RowSource, recipe: Recipe, name: str, folder: Path) -> Rows:
    """The rows (h, W, S) of the picture under :meth:`Recipe.apply`, in order.

    Args:
        passes: over the rows, of every step.
        source: as of :func:`stream_detail`.
        recipe: of steps that support tiles.
        name: of the source, for error messages.
        folder: with room for the intermediate picture between two steps.

    Raises:
        ValueError: if a step needs the whole picture at once, or does not suit the picture.
        OSError: if the folder has no room.
    """
    picture = Picture(source, name)
    steps = recipe.acting
    for step in steps:
        if step.edit not in ROWS:
            raise ValueError(
                f"{step.edit} takes the whole photograph at once, and {name} is too large for that; "
                "allow more memory, or leave that step out"
            )
    with ExitStack() as stack:
        for step in steps[:-1]:
            rows = rows_of(step, replace(passes, kind="float32"), source, name)
            source = stack.enter_context(_kept(rows, picture.size, folder))
        if steps:
            yield from rows_of(steps[-1], passes, source, name)
        else:
            yield from passes.work_out(picture, lambda tile: tile.inner, 0, max(1, TILE_PIXELS // picture.size[1]))


@contextmanager
def _kept(rows: Rows, size: tuple[int, int], folder: Path) -> Iterator[RowSource]:
    """Rows as a source of rows, in a temporary file in a folder."""
    with TemporaryFile(dir=folder) as file:
        samples = 0
        for _, values in rows:
            samples = values.shape[2]
            try:
                file.write(values.clip(0, 1).astype(np.float32).tobytes())
            except OSError as error:
                reason = f"{error.strerror}, where one step of the edit leaves {4e-9 * np.prod(size) * samples:.1f} GB"
                raise OSError(error.errno, f"{reason} to the next", str(folder)) from error
        file.flush()
        yield np.memmap(file, np.float32, "r", shape=(*size, samples))


def rows_of(step: Step, passes: Passes, source: RowSource, name: str) -> Rows:
    """The rows that a step makes of a picture."""
    size = Picture(source).size
    arguments = step.arguments(size) | {"generator": seeded()}
    if step.edit != "detail":
        arguments |= {"strokes": ColouredRows(step.painted("colour"), size), "names": (name, "strokes")}
        keep = CoveredRows(step.painted("keep"), size)
        arguments |= {"keep": keep} if keep.any() else {}
        return ROWS[step.edit](passes, source, **arguments)
    arguments |= {"alpha": torch.tensor(step["alpha"]), "name": name}
    if step.has_region():
        outer = CoveredRows(step.painted("out"), size)
        arguments |= {
            "alpha": torch.tensor(step.sliders_inside),
            "outside": torch.tensor(step["alpha"]),
            "regions": CoveredRows(step.painted("in"), size),
            "negative": outer if outer.any() else None,
        }
    return ROWS[step.edit](passes, source, **arguments)


#: The edits that can be done by rows; the others take the whole picture at once.
ROWS: dict[str, Callable[..., Rows]] = {"detail": detail_rows, "colorize": colorize_rows, "recolor": recolor_rows}
