"""One person's editing of one photograph: what is open, what was done, and what can be undone. Knows of no page."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from nlfilter_torch.app.preview import PIXELS, Preview
from nlfilter_torch.core.memory import working_bytes
from nlfilter_torch.edits.parameters import EDITS
from nlfilter_torch.edits.recipe import Recipe
from nlfilter_torch.edits.scribbles import Stroke, thin
from nlfilter_torch.io.photographs import (
    BITS,
    DEPTHS,
    SUFFIXES,
    Photograph,
    check_memory,
    check_output,
    open_beside,
    read_photograph,
    write_photograph,
)

SPACING = 0.2  # of the points that a stroke keeps, as a share of its radius
UNDOS = 100


@dataclass(frozen=True)
class Opened:
    """A photograph at hand.

    Attributes:
        name: of its file.
        photograph: as it was read.
        preview: of it.
    """

    name: str
    photograph: Photograph
    preview: Preview


class Session:
    """What one page edits; a second page has another one.

    Args:
        folder: where files are saved.
        pixels: of the preview, at most.
    """

    def __init__(self, folder: Path, pixels: int = PIXELS) -> None:
        self.folder = folder
        self.recipe = Recipe()
        self.opened: Opened | None = None
        self._pixels = pixels
        self._past: list[Recipe] = []
        self._future: list[Recipe] = []
        self._shown = Recipe()  # what the last committed edit is

    def open(self, path: Path, name: str | None = None) -> None:
        """Read a photograph and begin a new edit; on any failure all stays as it was.

        Args:
            path: of the file.
            name: of it, if ``path`` is not where it belongs.

        Raises:
            ValueError, OSError, MemoryError: see :func:`read_photograph`; the message names the file as ``name``.
        """
        try:
            # As much as saving takes at least: better to hear of it now.
            photograph = read_photograph(path, bytes_per_pixel=working_bytes(100, 5))
        except (ValueError, OSError, MemoryError) as error:
            raise type(error)(str(error).replace(str(path), name or str(path))) from error
        self.opened = Opened(name or path.name, photograph, Preview(photograph.pixels, self._pixels))
        self.recipe = self._shown = Recipe()
        self._past, self._future = [], []

    def open_bytes(self, content: bytes, name: str) -> None:
        """The same with a file's content, such as a browser sends."""
        with tempfile.TemporaryDirectory(prefix="nlfilter-torch-") as folder:
            path = Path(folder) / "photograph"
            path.write_bytes(content)
            self.open(path, Path(name).name)

    @property
    def preview(self) -> Preview:
        """The preview of what is open.

        Raises:
            ValueError: if nothing is.
        """
        if self.opened is None:
            raise ValueError("open a photograph first")
        return self.opened.preview

    def set(self, edit: str, **values: Any) -> None:
        """Change the last step of an edit, or add one; :meth:`commit` makes it a change that can be undone."""
        self.recipe = self.recipe.with_last(self.recipe.last(edit).changed(**values))

    def commit(self) -> None:
        """End a change, so that undo goes back to before it."""
        if self.recipe != self._shown:
            self._past = [*self._past[-UNDOS + 1 :], self._shown]
            self._future = []
            self._shown = self.recipe

    def load(self, recipe: Recipe) -> None:
        """Take another edit, as one change."""
        self.recipe = recipe
        self.commit()

    def undo(self) -> bool:
        """Take the last change back; False if there is none."""
        if not self._past:
            return False
        self._future.append(self._shown)
        self.recipe = self._shown = self._past.pop()
        return True

    def redo(self) -> bool:
        """Make the last change that was taken back again; False if there is none."""
        if not self._future:
            return False
        self._past.append(self._shown)
        self.recipe = self._shown = self._future.pop()
        return True

    def add_stroke(self, step: str, points: list[tuple[float, float]], radius: float, paint: str) -> None:
        """Paint for a step.

        Args:
            step: its name.
            points: (x, y) in pixels of the preview.
            radius: of the brush, as a share of the short side.
            paint: what it says.

        Raises:
            ValueError: if no photograph is open, or the step takes no such strokes.
        """
        height, width = self.preview.size
        shares = thin(((x / width, y / height) for x, y in points), SPACING * radius)
        entries = {"points": [list(point) for point in shares], "radius": round(radius, 4), "paint": paint}
        words = EDITS[step].words
        if not words:
            raise ValueError(f"{step} takes no strokes: it holds for the whole photograph")
        stroke = Stroke.from_entries(entries, words, step)
        last = self.recipe.last(step)
        if step == "detail" and paint == "in" and not last.has_region():  # what was set for all is meant for it
            self.set("detail", inside=last["alpha"], alpha=(1.0,) * len(last["alpha"]))
        self.set(step, strokes=(*last.strokes, stroke))
        self.commit()

    def render(self, upto: str | None = None) -> Tensor:
        """The preview under the edit, (1, C, h, w) in [0, 1]; see :meth:`Preview.render`."""
        return self.preview.render(self.recipe, upto)

    def target(self, name: str) -> Path:
        """The file of that name in the folder.

        Raises:
            ValueError: if ``name`` leads out of it, or is none.
        """
        path = Path(name.strip())
        if not path.name or path.name != name.strip() or path.name.startswith(".") or "\0" in name:
            raise ValueError(
                f"the name must be one of a file, such as photo-edited.png, got {name!r}; files go to {self.folder}"
            )
        return self.folder / path

    def suggested_name(self) -> str:
        """A name to save under: that of the photograph with ``-edited``, and an ending that can hold it."""
        if self.opened is None:
            return ""
        path, photograph = Path(self.opened.name), self.opened.photograph
        suffix = path.suffix.lower()
        kind = SUFFIXES.get(suffix)
        fits = kind is not None and photograph.depth in DEPTHS[kind] and (photograph.alpha is None or kind != "JPEG")
        if not fits:
            suffix = ".tif" if BITS[photograph.depth] == "floats" else ".png"
        return f"{path.stem}-edited{suffix}"

    def save(self, name: str) -> Path:
        """Edit the photograph at its full size and write it; the file appears complete or not at all.

        Raises:
            ValueError, OSError, MemoryError: if nothing is open, or it cannot be written or edited here.
        """
        target = self.target(name)
        if self.opened is None:
            raise ValueError("open a photograph first; there is nothing to save")
        recipe, photograph = self.recipe, self.opened.photograph
        check_output(target, photograph)
        height, width = photograph.pixels.shape[-2:]
        needed = working_bytes(recipe.landmarks, recipe.patch_size, factors=recipe.factors)
        check_memory(Path(self.opened.name), width, height, needed)
        pixels = recipe.apply(photograph.pixels)
        if pixels.shape[1] != photograph.pixels.shape[1]:  # a profile for grey fits no colours
            photograph = replace(photograph, icc=None)
        write_photograph(photograph.with_pixels(pixels), target)
        return target

    def save_preset(self, name: str) -> Path:
        """Write the edit as a file for :meth:`load_preset` and the command line.

        Raises:
            ValueError, OSError: if it cannot be written there.
        """
        target = self.target(name)
        if target.suffix.lower() != ".json":
            raise ValueError(f"the name of a preset must end in .json, got {name!r}")
        with open_beside(target) as stream:
            stream.write(self.recipe.to_json().encode())
        return target

    def load_preset(self, content: bytes, name: str) -> None:
        """Take the edit that a file holds.

        Raises:
            ValueError: if it holds none.
        """
        self.load(Recipe.from_json(content.decode("utf-8", errors="replace"), name))
