"""Edits of one photograph, in memory or in tiles: a step with what its command prints about it, or recipes.

Each recipe may be for a region of its own.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from nlfilter_torch.core.workers import single_threaded
from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.editing import (
    ERROR_DEPTH,
    MAP_DEPTH,
    FileEdit,
    Job,
    allowed_memory,
    check_apart,
    note_cropped,
    read_masks,
    rows_by_tiles,
    rows_in_memory,
)
from nlfilter_torch.photo.cli.scribbles import MarkedPhotograph, Opener, ScribbleOptions
from nlfilter_torch.photo.cli.showing import Scribbled, notes_if_idle
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.rows import WHITE, is_hidden
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import edit_of, left_by_crop
from nlfilter_torch.photo.edits.recipe import apply_recipe, edit_regions, edit_tiling
from nlfilter_torch.photo.files.rows import StoredPicture, open_picture
from nlfilter_torch.photo.picture.changes import blend_edited
from nlfilter_torch.photo.picture.drawn import Painter
from nlfilter_torch.photo.picture.edit import PhotoEdit, Rows
from nlfilter_torch.photo.picture.in_memory import InMemory, edit_image, fit_edit
from nlfilter_torch.photo.picture.painting import RowPainter, TensorPainter
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from nlfilter_torch.photo.picture.pictures import Picture, stored_as
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.source import Source, seeded
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiled_developed import developed_rows
from nlfilter_torch.photo.picture.tiles import Tiling

ERROR_BYTES = 250  # per pixel: averages of errors, of which standard errors are computed
ROWS, AROUND = 256, 2  # rows of the photograph that are read at once, and additional rows on both sides


@dataclass(frozen=True)
class EditJob(FileEdit):
    """A step that is applied to a photograph in a file.

    Attributes:
        step: the step, without strokes.
        scribbles: options that mark parts of the photograph.
        show: file for the picture of scribbles and mask.
        map: file for the map of what the edit estimates.
        error_map: file for the standard errors of the edited pixels.
        seed: of the random numbers.
        notes: what is to be said about the options, once the photograph has been read.
    """

    step: Step
    scribbles: ScribbleOptions
    show: Path | None = None
    map: Path | None = None
    error_map: Path | None = None
    seed: int = 0
    notes: Sequence[str] = ()

    @property
    def bytes_per_pixel(self) -> int:
        """Memory that the edit needs per pixel of an image."""
        regional = self.step.declared.regional is not None
        needed = self.step.bytes_per_pixel(masked=regional and self.scribbles.marks_objects(self.step.declared))
        return needed + (0 if self.error_map is None else ERROR_BYTES)

    @property
    def coloured(self) -> bool:
        """Whether the edit adds colours to a grey photograph."""
        return self.step.declared.coloured

    @property
    def writes_aside(self) -> bool:
        """Whether it writes more pictures than the output."""
        return not (self.show is self.map is self.error_map is None)

    def edited(self, photograph: Photograph) -> Tensor:
        """The edited pixels of a photograph in memory, (1, C, H, W)."""
        rows = rows_in_memory(photograph, self.source)
        with ExitStack() as opened:
            marked = self._marked(rows, PictureOpener(opened, allowed_memory(self.files.memory)))
            self._tell(rows, marked)
            weights = photograph.weights
            edit = self._measured(InMemory(photograph.pixels, weights=weights), rows)
            pixels = edit_image(edit, photograph.pixels, marked.tensors(), weights=weights)
        if self.error_map is not None:
            errors = edit.standard_error(photograph.pixels, weights)
            write_photograph(Photograph(errors, ERROR_DEPTH), self.error_map)
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
        if self.error_map is not None:
            raise ValueError(
                f"--error-map must be used with a photograph that fits in memory, got {self.source}, which is edited "
                "in tiles; crop it, or allow more by --memory"
            )
        passes = job.passes(self.full, Path(self.target).parent)
        tiled = Tiled(Picture(job.picture.marked, self.source), passes, self.scribbles.called)
        rows = rows_by_tiles(tiled.picture)
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
        return self.scribbles.on(edit, rows, opener, () if edit.regional is None else self.step["alpha"])

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


@dataclass(frozen=True)
class RecipeJob(FileEdit):
    """Recipes that are applied to a photograph in a file.

    Attributes:
        recipes: a recipe for the whole photograph, or a recipe for each mask.
        masks: grey pictures of the regions of the recipes.
        crop: a crop as an option states it, or None for that of the recipe.
        aspect: width by height of the crop, which is trimmed to it, or None.
        cropped: how the photograph has been straightened and cropped already, if it has been.
        notes: what is to be said about the options, once the photograph has been read; with a crop or an
            aspect, only if nothing is trimmed or developed.
    """

    recipes: Sequence[Recipe]
    masks: Sequence[Path] = ()
    notes: Sequence[str] = ()
    crop: str | None = None
    aspect: float | None = None
    cropped: Development | None = None

    @property
    def bytes_per_pixel(self) -> int:
        """Memory that the recipes need per pixel of an image."""
        return max(recipe.bytes_per_pixel for recipe in self.recipes) + 16 * len(self.masks)

    @property
    def coloured(self) -> bool:
        """Whether a recipe adds colours to a grey photograph."""
        return any(recipe.gives_colour for recipe in self.recipes)

    @property
    def develop(self) -> Development:
        """How the photograph is developed, which no recipe for a region does."""
        return self.recipes[0].develop

    def at_size(self, size: tuple[int, int]) -> "RecipeJob":
        """The same for a photograph (H, W), with the edges of its crop."""
        if self.crop is None and self.aspect is None:
            return self
        develop = self.develop
        if self.crop is not None:
            turned = size[::-1] if develop.rotate % 180 else size
            develop = replace(develop, crop=options.parse_crop(self.crop, turned))
        if self.aspect is not None:
            develop = replace(develop, crop=develop.frame(size).trimmed(self.aspect).edges)
        recipes = [replace(recipe, develop=develop) for recipe in self.recipes]
        return replace(self, recipes=recipes, crop=None, aspect=None, notes=self.notes if develop.is_idle else ())

    def cropped_away(self, size: tuple[int, int]) -> list[tuple[int, Step]]:
        """The steps, with their numbers, whose objects in a photograph (H, W) are all outside the crop."""
        return self.recipes[0].cropped_away(size)

    def on_developed(self, size: tuple[int, int]) -> "RecipeJob":
        """The recipes for a photograph, once (H, W), that is developed already."""
        cropped = None if self.develop.frame(size).is_whole else self.develop
        return replace(self, recipes=[recipe.on_developed(size) for recipe in self.recipes], cropped=cropped)

    def edited(self, photograph: Photograph) -> Tensor:
        """The edited pixels of a developed photograph in memory, (1, C, H, W)."""
        masks = read_masks(self.masks, self.source, photograph.size) if self.masks else None
        self._tell(rows_in_memory(photograph, self.source))
        weights, recipes = photograph.weights, self.recipes
        if weights is not None:
            recipes = self._seen(InMemory(photograph.pixels, weights=weights), TensorPainter())
        pixels = [apply_recipe(recipe, photograph.pixels, weights=weights) for recipe in recipes]
        return pixels[0] if masks is None else blend_edited(photograph.pixels, pixels, masks)

    @contextmanager
    def tiling(self, job: Job) -> Iterator[Tiling]:
        """The edited rows of a photograph that does not fit in memory."""
        passes, picture = job.passes(self.full, Path(self.target).parent), job.picture
        masks = self._masks(job)
        with developed_rows(self.develop, passes, picture.marked, self.source, picture.nodata) as source:
            self._tell(rows_by_tiles(Picture(source, self.source)))
            if masks:
                edits = [recipe.steps for recipe in self.recipes]
                whole = edit_regions(passes, source, edits, [mask.rows for mask in masks], self.source)
            else:
                developed, tiled = self.on_developed(job.size), Tiled(Picture(source, self.source), passes)
                recipes = developed.recipes if tiled.counted is None else developed._seen(tiled, RowPainter())
                whole = edit_tiling(passes, source, recipes[0].steps, self.source)
            with whole as tiling:
                yield replace(tiling, nodata=picture.nodata)

    def _masks(self, job: Job) -> list[StoredPicture]:
        """The masks, which are read by rows; raises ValueError if one has another size than the photograph."""
        masks = [job.open(path) for path in self.masks]
        for path, mask in zip(self.masks, masks, strict=True):
            if tuple(mask.shape[:2]) != job.size:
                raise ValueError(
                    f"{path} must have the size of {self.source}, {job.size[1]}x{job.size[0]}, got "
                    f"{mask.shape[1]}x{mask.shape[0]}; resize it"
                )
        return masks

    def _seen(self, source: Source[M], painter: Painter[M]) -> Sequence[Recipe]:
        """The recipes for a developed photograph, without strokes of which the crop leaves hidden pixels alone."""
        if self.cropped is None:
            return self.recipes
        (recipe,) = self.recipes  # as a photograph with regions is not developed
        steps = tuple(left_by_crop(step, source, painter) for step in recipe.steps)
        pairs = enumerate(zip(recipe.steps, steps, strict=True), 1)
        note_cropped(self.cropped, [(n, step) for n, (step, left) in pairs if left is not step and step.changes()])
        return [Recipe(steps)]

    def _tell(self, rows: Rows) -> None:
        """Print the notes on the options and those of all steps, without repeating any."""
        steps = [step for recipe in self.recipes for step in recipe.acting]
        of_steps = (note for step in steps for note in edit_of(step, rows.size).notes(rows))
        for note in dict.fromkeys(chain(self.notes, of_steps)):
            options.note(note)


def develop_file(
    recipe: Recipe,
    crop: str | None,
    aspect: float | None,
    source: str,
    target: str,
    files: options.PhotographOptions,
) -> None:
    """Develop a photograph by a recipe without steps, and a crop that is trimmed to width by height, if not None."""
    notes = [f"no option changes anything: {target} is written without an edit"] if recipe.develop.is_idle else []
    RecipeJob(source, target, files, False, [recipe], notes=notes, crop=crop, aspect=aspect).run()


def apply_files(
    presets: Sequence[str],
    masks: Sequence[Path],
    source: str,
    target: str,
    files: options.PhotographOptions,
    *,
    full: bool = False,
) -> None:
    """Apply saved edits, by name or file, to a photograph: one to all of it, or one to the region of each mask."""
    recipes = [find_recipe(name) for name in presets]
    if len(masks) != len(recipes) and (masks or len(recipes) > 1):
        raise ValueError(
            f"--mask must come once for each --preset, got {len(masks)} for {len(recipes)}; "
            "say where each of them holds, or give one preset alone"
        )
    developed = next((name for recipe, name in zip(recipes, presets, strict=True) if not recipe.develop.is_idle), None)
    if masks and developed is not None:
        raise ValueError(
            f"--mask must come with edits that do not develop the photograph, got {developed}; develop it first, by "
            "nlfilter-torch develop"
        )
    check_apart("OUT", target, mask=masks, preset=presets)
    notes = [note for recipe, name in zip(recipes, presets, strict=True) for note in notes_if_idle(recipe, name)]
    RecipeJob(source, target, files, full, recipes, masks, notes).run()
