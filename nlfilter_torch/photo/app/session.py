"""A session: an open photograph, its edit, and the history of undo. It does not depend on the page."""

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.photo.app.developed import DEVELOPING, Developed
from nlfilter_torch.photo.app.preview import PIXELS, Preview, selected
from nlfilter_torch.photo.app.sidecar import Sidecar
from nlfilter_torch.photo.declared.development import DEVELOP, Crop, Development
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import Recipe, on_frame
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Mark, Point, Region, Shape, thin
from nlfilter_torch.photo.edits.parts import Parts, Rectangle
from nlfilter_torch.photo.edits.recipe import apply_recipe, edit_rows
from nlfilter_torch.photo.files.exif import read_upright
from nlfilter_torch.photo.files.formats import BITS, DEPTHS, SUFFIXES, check_memory, count_pages, type_of
from nlfilter_torch.photo.files.rows import TILED_MEMORY, WHOLE_MEMORY, usual_memory
from nlfilter_torch.photo.files.writing import open_beside
from nlfilter_torch.photo.picture.developing import limits_of, turned_canvas
from nlfilter_torch.photo.picture.light import balance_of, in_light
from nlfilter_torch.photo.picture.photographs import (
    Photograph,
    check_output,
    read_photograph,
    transparent,
    write_photograph,
)
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.sampling import Report, in_silence
from nlfilter_torch.photo.picture.tiles import Passes, Statistics
from nlfilter_torch.photo.selections.cutouts import cutout

POINTED = 2  # pixels of the preview on all sides of a point that are averaged
SPACING = 0.2  # distance of the points of a stroke, as a share of its radius
UNDOS = 100
FULL_STATISTICS = 1 << 18  # pixels, up to which statistics are those of all; a sample is nearly as exact, and fast
COLOURED, RARE = 0.03, 0.002  # difference of channels of a colour, and the share of pixels that need not have one
OPEN_BYTES = 40  # per pixel, for a photograph before and after the edit and the files of both; edits work in tiles


@dataclass
class History:
    """Edits before the current one, and those that were undone; the last are the nearest."""

    past: list[Recipe] = field(default_factory=list)
    future: list[Recipe] = field(default_factory=list)

    def add(self, before: Recipe) -> None:
        """Take the edit before a change."""
        self.past, self.future = [*self.past[-UNDOS + 1 :], before], []


class Session:
    """The editing of a photograph, shared by all pages that show it.

    Args:
        folder: where files are saved.
        path: file of the photograph, which may be a copy.
        name: name of the file for the user, also in errors; None is that of ``path``.
        pixels: the largest number of pixels in the preview.

    Raises:
        ValueError, OSError, MemoryError: see :func:`read_photograph`.

    Attributes:
        recipe: the edit.
        original: the photograph as it is.
        developed: the photograph as it was shown last.
        pages: number of pages of the file.
        address: the address by which a page finds the session again.
        saved: the edit as of the last file that was written.
        history: the edits to undo and redo.
    """

    def __init__(self, folder: Path, path: Path, name: str | None = None, pixels: int = PIXELS) -> None:
        try:
            photograph = read_photograph(path, bytes_per_pixel=OPEN_BYTES)
        except (ValueError, OSError, MemoryError) as error:
            raise type(error)(str(error).replace(str(path), name or str(path))) from error
        self.folder, self.path, self.name = folder, path.resolve(), name or path.name
        self.pages = count_pages(path)
        self.original = self.developed = Developed.of(photograph, self.name, pixels)
        self.address = ""
        self.recipe = self.saved = self._shown = Recipe()  # the last one is the last committed edit
        self._sidecar: Sidecar | None = None
        self._outdated: list[Developed] = []  # of other developments
        self._drawing = threading.Lock()  # previews cache what they compute, so they draw one picture at a time
        self._drafting = threading.Lock()
        self._rendered: tuple[object, Tensor] | None = None  # the edit and the picture that were drawn last
        self._fitting = threading.Lock()  # the same holds for parts at full size
        self._at_rest: tuple[object, Tensor] | None = None  # the last result, for other tabs
        self._pixels = pixels
        self.history = History()

    def keep_in(self, sidecar: Sidecar) -> None:
        """Load the edit that is kept in a file, and keep the edit there from now on."""
        self._sidecar = sidecar
        self.recipe = self._shown = self.saved = sidecar.read(self.whole_size)

    def restore(self) -> None:
        """Load the edit from its file again if another program has changed the file."""
        if self._sidecar is not None:
            kept = self._sidecar.kept
            if (recipe := self._sidecar.read(self.whole_size)) != kept:
                self.load(recipe)

    @property
    def trouble(self) -> str | None:
        """Why the edit is not kept, or None."""
        return None if self._sidecar is None else self._sidecar.trouble

    @property
    def unsaved(self) -> bool:
        """Whether the edit has changed since it was opened or written."""
        return self.recipe != self.saved

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return bool(self.history.past)

    @property
    def can_redo(self) -> bool:
        """Whether there is a change that was undone."""
        return bool(self.history.future)

    @property
    def preview(self) -> Preview:
        """The preview of the photograph as it was shown last."""
        return self.developed.preview

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the developed photograph."""
        return self.developed.frame.size

    def _develop(self, development: Development) -> Developed:
        """The photograph under a development; takes a second per ten megapixels unless it is the one shown.

        Raises:
            ValueError, MemoryError: if the photograph cannot be developed.
        """
        if self.developed.development == development:
            return self.developed
        return self.developed.changed(self._pixels, development)

    def step_in_view(self, edit: str) -> Step:
        """The chosen step of an edit, with its strokes in coordinates of the developed photograph."""
        step = self.recipe.current(edit)
        return on_frame(step, self.developed.frame, self.preview.size) if step.strokes else step

    @property
    def whole_size(self) -> tuple[int, int]:
        """(height, width) of the photograph before it is developed."""
        return self.original.photograph.size

    @property
    def turned_size(self) -> tuple[int, int]:
        """(height, width) of it turned by quarters of a circle."""
        return self.recipe.develop.frame(self.whole_size).turned

    @property
    def crop(self) -> Crop:
        """The edges of what is kept of :attr:`uncropped`."""
        return self.recipe.develop.frame(self.whole_size).edges

    @property
    def uncropped(self) -> Tensor:
        """The photograph as it is turned and lit, not cropped, with black corners, (1, C, h, w) in [0, 1], reduced."""
        pixels, development = self.original.preview.pixels, self.recipe.develop
        return turned_canvas(in_light(pixels, development, limits_of(pixels)).clamp(0, 1), development)

    @property
    def has_colours(self) -> bool:
        """Whether the photograph has colours."""
        pixels = self.preview.pixels
        return bool((pixels.amax(1) - pixels.amin(1) > COLOURED).float().mean() > RARE)

    @property
    def is_reduced(self) -> bool:
        """Whether the preview has fewer pixels than the photograph."""
        return self.preview.stride > 1

    def set(self, edit: str, *, strokes: tuple[Mark, ...] | None = None, **values: Value) -> None:
        """Change the chosen step with that edit, or add such a step, and let it be seen.

        :meth:`commit` completes the change.
        """
        self.recipe = self.recipe.with_current(
            self.recipe.current(edit).changed(strokes=strokes, **values).switched_on()
        )

    def developing(self, values: Mapping[str, Value], aspect: float | None = None) -> Recipe:
        """The edit with other values of how the photograph is developed.

        Edges of a crop are those of whole pixels that the straightened photograph has. They are moved inwards until the
        width of the crop is ``aspect`` times its height, unless that is None.

        Raises:
            ValueError: if the middle of the crop is outside.
        """
        size = self.whole_size
        develop = Development(**{**vars(self.recipe.develop), **values})
        if "crop" in values:  # its size stays if only its place changes
            develop = replace(develop, crop=self.recipe.develop.frame(size).placed(develop.crop))
        frame = develop.frame(size)
        if "crop" in values:
            frame = frame if aspect is None else frame.trimmed(aspect)
            develop = replace(develop, crop=frame.edges)
        return replace(self.recipe, develop=develop)

    def balance(self, x: float, y: float) -> dict[str, Value]:
        """The white balance that makes the photograph grey at a point (x, y) in pixels of the preview.

        Raises:
            ValueError: if it is grey anyway, or too dark there.
        """
        before, reach = self.developed.before, POINTED
        column, row = (min(max(math.floor(at), 0), n - 1) for at, n in zip((x, y), before.shape[:1:-1], strict=True))
        part = before[..., max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        warmth, tint = balance_of(part)
        return {"temperature": None, "warmth": warmth, "tint": tint}

    def commit(self) -> None:
        """Complete a change, so that it can be undone."""
        before, self._shown = self._shown, self.recipe  # also if only another step was chosen
        if self.recipe != before:
            self.history.add(before)
            self._keep()

    def _keep(self) -> None:
        if self._sidecar is not None:
            self._sidecar.write(self._shown)

    def load(self, recipe: Recipe) -> None:
        """Replace the edit, as one change."""
        self.recipe = recipe
        self.commit()

    def undo(self) -> bool:
        """Undo the last change; False if there is none."""
        return self._go(self.history.past, self.history.future)

    def redo(self) -> bool:
        """Redo the last change that was undone; False if there is none."""
        return self._go(self.history.future, self.history.past)

    def _go(self, there: list[Recipe], back: list[Recipe]) -> bool:
        if not there:
            return False
        back.append(self._shown)
        self.recipe = self._shown = there.pop()
        self._keep()
        return True

    def add_stroke(self, step: str, points: list[tuple[float, float]], radius: float, paint: str) -> None:
        """Add a stroke to a step: points (x, y) in pixels of the preview, and a radius as a share of its short side.

        Raises:
            ValueError: if the step does not take strokes of that meaning or colour.
        """
        height, width = self.preview.size
        shares = thin(((x / width, y / height) for x, y in points), SPACING * radius)
        entries = {"points": [list(point) for point in shares], "radius": round(radius, 4), "paint": paint}
        self._add(step, entries)

    def add_box(self, step: str, start: Point, end: Point, paint: str, shape: Shape = "rectangle") -> None:
        """Add a rectangle around an object of a step, in place of an earlier one around the same object, or a gradient.

        Its ends (x, y) are in pixels of the preview; of a rectangle, what lies outside it is left out.

        Raises:
            ValueError: if the step does not take such marks of that meaning.
        """
        low, high = (0.0, 1.0) if shape == "rectangle" else (-1.0, 2.0)
        width, height = self.preview.size[::-1]
        (x0, y0), (x1, y1) = (
            [round(min(max(at, low), high), 4) for at in (x / width, y / height)] for x, y in (start, end)
        )
        self._add(step, Region.dragged((x0, y0), (x1, y1), shape, paint).entries())

    def _add(self, step: str, entries: dict[str, object]) -> None:
        """Add a mark, where it is in the preview, to a step."""
        if not EDITS[step].scribbles:
            raise ValueError(f"{step} takes no strokes: it holds for the whole photograph")
        mark = self.developed.frame.mark_outward(EDITS[step].mark_of(entries, step))
        current = self.recipe.current(step)
        others = current.strokes
        if mark.role == "box":
            same = mark.meaning.sliders
            others = tuple(m for m in others if m.role != "box" or m.meaning.sliders != same)
        painted = current.changed(strokes=(*others, mark)).switched_on()
        if painted.has_region() and not current.has_region():  # it begins with the sliders of the rest
            painted = painted.changed(inside=current["alpha"])
        self.recipe = self.recipe.with_current(painted)
        self.commit()

    def render(self, moving: int | None = None) -> Tensor:
        """The preview under the edit, (1, C, h, w) in [0, 1]; see :meth:`Preview.render`.

        ``moving`` may be :data:`DEVELOPING`, too.
        """
        recipe = self.recipe
        with self._drawing:
            if moving == DEVELOPING:
                developed, original = self.developed, self.original.preview
                start = developed.approximate(recipe.develop, original)
                if developed.development.geometry != recipe.develop.geometry:  # no step can be computed so fast
                    return (start.clamp(0, 1) + developed.change_in(recipe.develop, original)).clamp(0, 1)
            else:
                developed, start = self._develop(recipe.develop), None
                if developed is not self.developed:
                    self._outdated.append(self.developed)
                    self.developed = developed
            steps = self._on(developed, recipe, developed.preview.size)
            return self._took(recipe, developed.preview.render(steps, moving, start))

    def _took(self, recipe: Recipe, picture: Tensor) -> Tensor:
        self._rendered = recipe.effect, picture
        return picture

    def draft(self, moving: int | None = None) -> Tensor | None:
        """:meth:`render` at once, approximately: the preview with the change that the steps make to a smaller one.

        None if that is no faster, as objects are found in a small picture anyway, or not possible since the photograph
        is not developed yet. It does not wait for :meth:`render`.
        """
        recipe, developed = self.recipe, self.developed
        if moving == DEVELOPING or developed.development != recipe.develop or not recipe.acting:
            return None
        if any(step.declared.requires_strokes for step in recipe.acting):
            return None
        if len(recipe.acting) == 1 and developed.preview.has_layers(recipe.acting[0]):
            return None
        with self._drafting:
            draft = developed.draft
            if draft is None:
                return None
            change = draft.render(self._on(developed, recipe, draft.size), moving) - draft.pixels
        preview = developed.preview
        change = F.interpolate(change, preview.size, mode="bilinear")
        return self._took(recipe, (preview.pixels + change).clamp(0, 1))

    def prepare(self, edit: str) -> None:
        """Compute what the first move of a slider of an edit, or of the development, needs, before it is moved."""
        recipe, developed = self.recipe, self.developed
        if edit == DEVELOP.name:
            developed.approximate(replace(developed.development, highlights=1.0), self.original.preview)
            return
        with self._drafting:
            draft = developed.draft
            if draft is not None and developed.development == recipe.develop:
                draft.prepare(self._on(developed, recipe, draft.size), recipe.current(edit))

    def has_drawn(self, recipe: Recipe) -> bool:
        """Whether the picture that was drawn last is that of an edit."""
        is_current = self._rendered is not None and self._rendered[0] == recipe.effect
        return is_current and self.developed.development == recipe.develop

    def nearly(self, place: Rectangle, recipe: Recipe) -> Tensor | None:
        """:meth:`part` at once, approximately: its pixels with the change that was drawn last.

        None if that is the change of another edit. It may be computed while :meth:`part` is.
        """
        developed, rendered = self.developed, self._rendered
        if rendered is None or not self.has_drawn(recipe):
            return None
        (rows, columns), (height, width) = (place.rows, place.columns), self.size
        change = rendered[1] - developed.preview.pixels.clamp(0, 1)
        right, down = (a.start + a.stop for a in (columns, rows))
        where = change.new_tensor(
            [[len(columns) / width, 0, right / width - 1], [0, len(rows) / height, down / height - 1]]
        )
        grid = F.affine_grid(where[None], [1, 1, *place.size], align_corners=False)
        seen = F.grid_sample(change, grid, mode="bilinear", padding_mode="border", align_corners=False)
        return (developed.lit(place) + seen).clamp(0, 1)

    def _on(self, developed: Developed, recipe: Recipe, seen: tuple[int, int] | None = None) -> Recipe:
        """The steps of a recipe for the developed photograph, or for that reduced to a size."""
        return Recipe(tuple(developed.counted(on_frame(step, developed.frame, seen)) for step in recipe.steps))

    def eigenvalues(self, detail: Step) -> Tensor:
        """Eigenvalues (R,) of the filter of a step of detail, which its layers belong to."""
        preview = self.developed.draft or self.preview
        return preview.layers(detail).eigenvalues

    def mask(self, edit: str) -> Tensor | None:
        """The mask (1, 1, h, w) of what the scribbles of the chosen step of an edit select, or None."""
        step = self.developed.counted(self.step_in_view(edit))
        with self._drawing:
            return self.preview.mask(step)

    def ignored(self, edit: str) -> Tensor | None:
        """Which pixels (1, 1, h, w) under these scribbles do not count, or None."""
        step = self.developed.counted(self.step_in_view(edit))
        with self._drawing:
            return self.preview.ignored(step)

    def part(self, place: Rectangle, recipe: Recipe, report: Report = in_silence) -> Tensor:
        """A part of the photograph under an edit as :meth:`save` makes it, (1, C, h, w) in [0, 1].

        The first part of an edit takes nearly as long as saving, since its statistics are those of the whole
        photograph. ``report`` may raise an error to interrupt.

        Raises:
            ValueError, OSError, MemoryError: if the photograph cannot be edited.
        """
        with self._fitting:
            developed = self._develop(recipe.develop)
            if not self._on(developed, recipe).acting:
                return developed.lit(place)
            return self._fitted(developed, recipe, report).edited(place)

    def at_rest(self, recipe: Recipe, report: Report = in_silence) -> Tensor:
        """The photograph under an edit as :meth:`save` makes it, reduced to the size of the preview.

        This takes as long as saving; :meth:`render` is fast, but approximate for edits that depend on single pixels.
        ``report`` may raise an error to interrupt.

        Raises:
            ValueError, OSError, MemoryError: as :meth:`part`.
        """
        with self._fitting:
            if self._at_rest is None or self._at_rest[0] != recipe.effect:
                developed = self._develop(recipe.develop)
                pixels, size = self._edited_at_once(developed, recipe, report), developed.preview.size
                if pixels is None:
                    reduced = self._fitted(developed, recipe, report).reduced(size, report)
                else:
                    reduced = resize(pixels.clamp(0, 1), size).clamp(0, 1)  # a file holds no more
                self._at_rest = recipe.effect, reduced
            return self._at_rest[1]

    def _fitted(self, developed: Developed, recipe: Recipe, report: Report) -> Parts:
        """The parts of the photograph, with the edit fitted to the whole photograph."""
        while self._outdated:
            self._outdated.pop().close()
        developed.parts.fit(self._on(developed, recipe).steps, self._passes(developed.photograph, report))
        return developed.parts

    def _edited_at_once(self, developed: Developed, recipe: Recipe, report: Report) -> Tensor | None:
        """The edited pixels (1, C, H, W), as the command line computes them; None if that needs too much memory."""
        photograph, steps = developed.photograph, self._on(developed, recipe)
        height, width = photograph.size
        if height * width * steps.bytes_per_pixel > WHOLE_MEMORY:
            return None
        check_memory(Path(self.name), width, height, steps.bytes_per_pixel)
        return apply_recipe(steps, photograph.pixels, partial(report, "Editing"), weights=photograph.weights)

    def _passes(self, photograph: Photograph, report: Report) -> Passes:
        """How an edit passes over the photograph in tiles."""
        statistics: Statistics = "full" if math.prod(photograph.size) <= FULL_STATISTICS else "sample"
        kind = str(photograph.pixels.numpy().dtype)
        return Passes(kind, statistics, memory=usual_memory(TILED_MEMORY), report=report, folder=self.folder)

    def target(self, name: str) -> Path:
        """The file of that name in the folder; raises ValueError if ``name`` is invalid or leads out of the folder."""
        path = Path(name.strip())
        if not path.name or path.name != name.strip() or path.name.startswith(".") or "\0" in name:
            raise ValueError(
                f"the name must be one of a file, such as photo-edited.png, got {name!r}; files go to {self.folder}"
            )
        return self.folder / path

    def check_photograph(self, name: str) -> Path:
        """:meth:`target` of a name under which the photograph can be saved; raises ValueError for others."""
        target = self.target(name)
        if target.resolve() == self.path:
            raise ValueError(
                f"the name must not be that of the photograph, got {name!r}: its edit is kept, and would be "
                "applied again; choose another name"
            )
        check_output(target, self.developed.cut)
        return target

    def check_preset(self, name: str) -> Path:
        """:meth:`target` of a name under which the edit can be saved; raises ValueError for others."""
        target = self.target(name)
        if target.suffix.lower() != ".json":
            raise ValueError(f"the name of a preset must end in .json, got {name!r}")
        return target

    def suggested_name(self) -> str:
        """The name of the photograph with ``-edited`` appended, and the extension of a file type that can store it."""
        path, photograph = Path(self.name), self.original.photograph
        suffix = path.suffix.lower()
        kind = SUFFIXES.get(suffix)
        fits = kind is not None and photograph.depth in DEPTHS[kind] and (photograph.alpha is None or kind != "JPEG")
        if not fits:
            suffix = ".tif" if BITS[photograph.depth] == "floats" else ".png"
        return f"{path.stem}-edited{suffix}"

    def save(self, name: str, report: Report = in_silence, quality: int | None = None, side: int | None = None) -> Path:
        """Edit the photograph at its full size and write it to the folder; the file appears complete or not at all.

        ``quality`` is that of a JPEG file, None the default; ``side`` the longest side in pixels, None that it has.

        Raises:
            ValueError, OSError, MemoryError: if the file cannot be edited or written.
        """
        target = self.check_photograph(name)
        recipe, developed = self.recipe, self._develop(self.recipe.develop)
        photograph = developed.photograph
        size = reduced_size(photograph, side)
        pixels = self._edited_at_once(developed, recipe, report)
        if pixels is None:
            rows = photograph.pixels[0].permute(1, 2, 0).numpy()
            channels = 3 if recipe.gives_colour else rows.shape[2]
            pixels = photograph.pixels.new_empty((1, channels, *photograph.size))
            steps = self._on(developed, recipe).steps
            for part, values in edit_rows(self._passes(photograph, report), rows, steps, self.name):
                pixels[0, :, part] = torch.from_numpy(values).permute(2, 0, 1)
        report("Writing", 0, 1)
        quality = quality if type_of(target) == "JPEG" else None
        write_photograph(resized_photograph(photograph.with_pixels(pixels), size), target, quality=quality)
        self.saved = recipe
        return target

    def check_cutout(self, name: str) -> Path:
        """:meth:`target` of a name under which an object can be cut out; raises ValueError for others."""
        target, photograph = self.target(name), self.developed.cut
        if target.resolve() == self.path:
            raise ValueError(f"the name must not be that of the photograph, got {name!r}; choose another name")
        check_output(target, transparent(photograph, target))
        return target

    def cut_out(self, name: str, edit: str, report: Report = in_silence) -> Path:
        """Write the edited photograph without what the scribbles of the chosen step of an edit do not select.

        Raises:
            ValueError, OSError, MemoryError: if nothing is marked, or the file cannot be edited or written.
        """
        target, recipe, developed = self.check_cutout(name), self.recipe, self._develop(self.recipe.develop)
        photograph, steps = developed.photograph, self._on(developed, recipe)
        pixels = self._edited_at_once(developed, recipe, report)
        if pixels is None:
            raise ValueError(
                f"{self.name} must have fewer pixels to be cut out here, got {math.prod(photograph.size)}; save the "
                "edit, and use nlfilter-torch mask --cutout"
            )
        place = recipe.place_of(edit)
        before = apply_recipe(Recipe(steps.steps[: place or 0]), photograph.pixels, weights=photograph.weights)
        mask = None if place is None else selected(steps.steps[place].mixed(on=True, opacity=1.0), before)
        if mask is None:
            raise ValueError(f"an object of {edit} must be marked to be cut out, got none; paint on it, or draw a box")
        report("Writing", 0, 1)
        cut = cutout(pixels, mask.amax(1, keepdim=True).to(pixels))[:, -1 - pixels.shape[1] :]
        write_photograph(transparent(photograph, target, cut), target)
        return target

    def save_preset(self, name: str) -> Path:
        """Write the edit as a file for :meth:`load_preset` and the command line.

        Raises:
            ValueError, OSError: if it cannot be written.
        """
        target, recipe = self.check_preset(name), self.recipe
        with open_beside(target) as stream:
            stream.write(recipe.to_json(drawn=True).encode())
        self.saved = recipe
        return target

    def load_preset(self, content: bytes, name: str) -> None:
        """Load an edit from the content of a file, in which masks are named as seen from the editor's folder.

        Raises:
            ValueError: if it has no edit, or names a mask outside the folder.
        """
        path, folder = self.folder / name, self.folder.resolve()
        try:
            recipe = Recipe.from_file(content, str(path))
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from error
        for mark in (mark for step in recipe.steps for mark in step.strokes if isinstance(mark, Region) and mark.file):
            if not Path(mark.file).resolve().is_relative_to(folder):
                raise ValueError(
                    f"masks of {name} must be files in {folder}, got {mark.file}; move the file there, or apply the "
                    "edit on the command line"
                )
        recipe.check_crop(self.whole_size, name)
        self.load(recipe)


def reduced_size(photograph: Photograph, side: int | None) -> tuple[int, int]:
    """(height, width) of a photograph whose longest side is to have at most ``side`` pixels.

    Raises:
        ValueError: if it is smaller than now, and some pixels hold no data, which have no place in another size.
    """
    height, width = photograph.size
    if side is None or side >= max(height, width):
        return height, width
    if photograph.hidden is not None and photograph.hidden.nodata is not None:
        raise ValueError("a photograph with pixels without data must be saved in its own size; leave the size as it is")
    scale = side / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def resized_photograph(photograph: Photograph, size: tuple[int, int]) -> Photograph:
    """A photograph at another size (height, width); hidden pixels have colours of pixels nearby."""
    if size == photograph.size:
        return photograph
    pixels = resize(photograph.pixels.clamp(0, 1) if photograph.depth.startswith("uint") else photograph.pixels, size)
    alpha = None if photograph.alpha is None else resize(photograph.alpha, size).clamp(0, 1)
    exif = read_upright(photograph.exif, size=size[::-1]).block
    return replace(photograph, pixels=pixels, alpha=alpha, exif=exif, hidden=None)
