"""Recipes that are applied to one photograph, each in a region of its own, in memory or in tiles."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from torch import Tensor

from nlfilter_torch.photo.cli import editing, options
from nlfilter_torch.photo.cli.editing import Job, pixels_of, rows_in_memory
from nlfilter_torch.photo.cli.showing import notes_if_idle
from nlfilter_torch.photo.declared.development import Development
from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_recipe, edit_of, left_by_crop
from nlfilter_torch.photo.edits.recipe import edit_regions, edit_tiling
from nlfilter_torch.photo.files.rows import StoredPicture
from nlfilter_torch.photo.picture.changes import blend_edited
from nlfilter_torch.photo.picture.drawn import Painter
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.photographs import Photograph
from nlfilter_torch.photo.picture.pictures import Picture
from nlfilter_torch.photo.picture.pixels import M
from nlfilter_torch.photo.picture.source import Source
from nlfilter_torch.photo.picture.tiled import Tiled
from nlfilter_torch.photo.picture.tiled_developed import developed_rows
from nlfilter_torch.photo.picture.tiled_scribbles import RowPainter
from nlfilter_torch.photo.picture.tiles import Tiling


@dataclass(frozen=True)
class RecipeJob:
    """Recipes that are applied to a photograph in a file.

    Attributes:
        recipes: a recipe for the whole photograph, or a recipe for each mask.
        masks: grey pictures of the regions of the recipes.
        source: the file to read.
        target: the file to write.
        full: whether statistics of tiles are of all pixels.
        aspect: width by height of the crop, which is trimmed to it, or None.
        cropped: how the photograph has been straightened and cropped already, if it has been.
        notes: what is to be said about the options, once the photograph has been read; with an aspect, only if
            nothing is trimmed or developed.
    """

    recipes: Sequence[Recipe]
    masks: Sequence[Path]
    source: str
    target: str
    full: bool
    notes: Sequence[str] = ()
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
        if self.aspect is None:
            return self
        crop = self.develop.frame(size).trimmed(self.aspect).edges
        recipes = [replace(recipe, develop=replace(recipe.develop, crop=crop)) for recipe in self.recipes]
        return replace(self, recipes=recipes, aspect=None, notes=self.notes if recipes[0].develop.is_idle else ())

    def cropped_away(self, size: tuple[int, int]) -> list[tuple[int, Step]]:
        """The steps, with their numbers, whose objects in a photograph (H, W) are all outside the crop."""
        return self.recipes[0].cropped_away(size)

    def on_developed(self, size: tuple[int, int]) -> "RecipeJob":
        """The recipes for a photograph, once (H, W), that is developed already."""
        cropped = None if self.develop.frame(size).is_whole else self.develop
        return replace(self, recipes=[recipe.on_developed(size) for recipe in self.recipes], cropped=cropped)

    def edited(self, photograph: Photograph) -> Tensor:
        """The edited pixels of a developed photograph in memory, (1, C, H, W)."""
        masks = editing.read_masks(self.masks, self.source, photograph.size) if self.masks else None
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
            read = Picture(source, self.source)
            self._tell(Rows(self.source, read.size, read.colours, partial(pixels_of, read)))
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
        editing.note_cropped(
            self.cropped, [(n, step) for n, (step, left) in pairs if left is not step and step.changes()]
        )
        return [Recipe(steps)]

    def _tell(self, rows: Rows) -> None:
        """Print the notes on the options and those of all steps, without repeating any."""
        steps = [step for recipe in self.recipes for step in recipe.acting]
        of_steps = (note for step in steps for note in edit_of(step, rows.size).notes(rows))
        for note in dict.fromkeys(chain(self.notes, of_steps)):
            options.note(note)


def develop_file(
    recipe: Recipe, aspect: float | None, source: str, target: str, files: options.PhotographOptions
) -> None:
    """Develop a photograph by a recipe without steps, whose crop is trimmed to width by height, or not for None."""
    notes = [f"no option changes anything: {target} is written without an edit"] if recipe.develop.is_idle else []
    editing.edit_file(RecipeJob([recipe], [], source, target, False, notes, aspect=aspect), source, target, files)


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
    editing.check_apart("OUT", target, mask=masks, preset=presets)
    notes = [note for recipe, name in zip(recipes, presets, strict=True) for note in notes_if_idle(recipe, name)]
    editing.edit_file(RecipeJob(recipes, masks, source, target, full, notes), source, target, files)
