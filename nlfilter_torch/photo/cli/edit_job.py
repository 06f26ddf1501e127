"""One edit of one photograph, in memory or in tiles, with what the command prints about it."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.workers import single_threaded
from nlfilter_torch.photo.cli import editing, options
from nlfilter_torch.photo.cli.editing import MAP_DEPTH, Job, pixels_of, rows_in_memory
from nlfilter_torch.photo.cli.scribbles import MarkedPhotograph, Opener, ScribbleOptions
from nlfilter_torch.photo.cli.showing import Scribbled
from nlfilter_torch.photo.declared.development import AS_IT_IS, Development
from nlfilter_torch.photo.declared.rows import WHITE, is_hidden
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import edit_of
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image, fit_edit
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.pictures import Picture, stored_as
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.source import Source, seeded
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiles import Tiling

ROWS, AROUND = 256, 2  # rows of the photograph that are read at once, and additional rows on both sides


@dataclass(frozen=True)
class EditJob:
    """A step that is applied to a photograph in a file.

    Attributes:
        step: the step, without strokes.
        source: the file to read.
        target: the file to write.
        scribbles: options that mark parts of the photograph.
        show: file for the picture of scribbles and mask.
        map: file for the map of what the edit estimates.
        files: how it is read and written.
        seed: of the random numbers.
        full: whether statistics of tiles are of all pixels.
        notes: what is to be said about the options, once the photograph has been read.
    """

    step: Step
    source: str
    target: str
    scribbles: ScribbleOptions
    show: Path | None
    map: Path | None
    files: options.PhotographOptions
    seed: int
    full: bool
    notes: Sequence[str] = ()

    @property
    def bytes_per_pixel(self) -> int:
        """Memory that the edit needs per pixel of an image."""
        regional = self.step.declared.regional is not None
        return self.step.bytes_per_pixel(masked=regional and self.scribbles.marks_objects(self.step.declared))

    @property
    def coloured(self) -> bool:
        """Whether the edit adds colours to a grey photograph."""
        return self.step.declared.coloured

    @property
    def develop(self) -> Development:
        """Nothing comes before the edit."""
        return AS_IT_IS

    def at_size(self, size: tuple[int, int]) -> "EditJob":
        """The same edit."""
        return self

    def cropped_away(self, size: tuple[int, int]) -> list[tuple[int, Step]]:
        """No step, as nothing is cropped."""
        return []

    def on_developed(self, size: tuple[int, int]) -> "EditJob":
        """The same edit."""
        return self

    def edited(self, photograph: Photograph) -> Tensor:
        """The edited pixels of a photograph in memory, (1, C, H, W)."""
        rows = rows_in_memory(photograph, self.source)
        with ExitStack() as opened:
            marked = self._marked(rows, PictureOpener(opened, editing.allowed_memory(self.files.memory)))
            self._tell(rows, marked)
            weights = photograph.weights
            edit = self._measured(InMemory(photograph.pixels, weights=weights), rows)
            pixels = edit_image(edit, photograph.pixels, marked.tensors(), weights=weights)
        if edit.reports_change:
            kind = options.DTYPES[self.files.depth] if self.files.depth else photograph.depth  # the files are compared
            planes = [photograph.pixels] if weights is None else [photograph.pixels, weights]
            before = stored_as(torch.cat(planes, dim=1), photograph.depth)
            after = stored_as(pixels, kind)
            meter = ChangeMeter()
            meter.add(squared_difference(before, after))
            typer.echo(edit.summary(meter.change))
        return pixels

    @contextmanager
    def tiling(self, job: Job) -> Iterator[Tiling]:
        """The edited rows of a photograph that does not fit in memory, which are computed within the block."""
        passes = job.passes(self.full, Path(self.target).parent)
        tiled = Tiled(Picture(job.picture.marked, self.source), passes, self.scribbles.called)
        rows = Rows(self.source, job.size, tiled.channels, partial(pixels_of, tiled.picture))
        marked = self._marked(rows, job.open)
        self._tell(rows, marked)
        edit = self._measured(tiled, rows)
        with single_threaded(tiled.passes.workers(1)):
            fitted = fit_edit(edit, tiled, marked.rows())
        with tiled.tiling(fitted) as whole:
            meter, tiling = ChangeMeter(), replace(whole, nodata=job.picture.nodata)
            yield meter.watched(tiling) if edit.reports_change else tiling
        if edit.reports_change:
            typer.echo(edit.summary(meter.change))

    def _edit_at(self, size: tuple[int, int], stride: float = 1) -> PhotoEdit:
        """The edit with the settings for a picture (H, W), sampled at every so many pixels of the photograph."""
        return edit_of(self.step, size, stride=stride, generator=seeded(self.seed))

    def _marked(self, rows: Rows, opener: Opener) -> MarkedPhotograph:
        """The marks, from the options."""
        edit = self.step.declared
        return self.scribbles.on(edit, rows.size, opener, () if edit.regional is None else self.step["alpha"])

    def _tell(self, rows: Rows, marked: MarkedPhotograph) -> None:
        """Print what marks cover and what the edit leaves out, and write the picture of ``--show``."""
        edit, scribbled = self._edit_at(rows.size), Scribbled(marked, rows)
        edit.check_channels(rows.channels)
        if self.show is not None:
            scribbled.check()
        scribbled.tell_colours()
        if self.show is not None:
            scribbled.show(self.show, self._edit_at)
        for note in (*self.notes, *edit.notes(rows)):
            options.note(note)

    def _measured(self, picture: Source[M], rows: Rows) -> PhotoEdit:
        """The edit with what it estimates from the picture if the command reports it, and its map, if wanted."""
        edit = self._edit_at(rows.size)
        edit = edit.measured(picture) if edit.reports_change else edit
        if self.map is not None:
            write_map(edit.map_of, rows, self.map)
        return edit


@dataclass(frozen=True)
class PictureOpener:
    """Opens pictures of scribbles, which are closed with ``files``."""

    files: ExitStack
    memory: int

    def __call__(self, path: Path) -> StoredPicture:
        """Open a picture."""
        return self.files.enter_context(open_picture(path, self.memory))


class ChangeMeter:
    """Measures how much an edit changes the pixels of a photograph, in grey levels (RMS)."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0

    def add(self, difference: tuple[float, int]) -> None:
        """Add the difference of some pixels, from :func:`squared_difference`."""
        self._squares += difference[0]
        self._count += difference[1]

    def watched(self, tiling: Tiling) -> Tiling:
        """Edited rows whose differences are added as they are computed."""
        return replace(tiling, compare=squared_difference, compared=self.add)

    @property
    def change(self) -> float:
        """The change of the pixels that were added."""
        return options.LEVELS_OF_WHITE * (self._squares / max(self._count, 1)) ** 0.5


def write_map(map_of: Callable[[Tensor], Tensor], rows: Rows, path: Path) -> None:
    """Write what a function computes from a photograph as a picture, at :data:`MAP_DEPTH`.

    The function depends on :data:`AROUND` pixels around each.
    """
    parts = []
    for start in range(0, rows.size[0], ROWS):
        stop = min(start + ROWS, rows.size[0])
        first, last = max(start - AROUND, 0), min(stop + AROUND, rows.size[0])
        planes = map_of(rows.read(slice(first, last)).float())
        parts.append(planes[..., start - first : stop - first, :])
    write_photograph(Photograph(torch.cat(parts, dim=2), MAP_DEPTH), path)


def squared_difference(before: NDArray[np.generic], after: NDArray[np.generic]) -> tuple[float, int]:
    """Sum of the squared differences of the colours of stored rows (h, W, S), and the number of values.

    Pixels that are hidden by the transparency before do not count.
    """
    colours = 3 if after.shape[2] >= 3 else 1
    if before.shape[2] in (2, 4):
        visible = ~is_hidden(before)
        before, after = before[visible], after[visible]
    difference = _scaled(after[..., :colours]) - _scaled(before[..., :colours])
    return float(np.square(difference, dtype=np.float64).sum()), difference.size


def _scaled(rows: NDArray[np.generic]) -> NDArray[np.float32]:
    scaled: NDArray[np.float32] = rows.astype(np.float32) / np.float32(WHITE.get(rows.dtype.name, 1))
    return scaled
