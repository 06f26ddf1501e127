"""One edit for all frames of a film, without flicker."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import torch

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.editing import allowed_memory
from nlfilter_torch.photo.cli.folders import check_replaced, pictures, record_written
from nlfilter_torch.photo.cli.progress import steps
from nlfilter_torch.photo.cli.showing import notes_if_idle
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.edits.film import FilmEdit, FrameArray, film_steps
from nlfilter_torch.photo.files.films import check_film_output, is_film, open_film, write_film
from nlfilter_torch.photo.files.rows import TILED_MEMORY
from nlfilter_torch.photo.files.writing import check_folder
from nlfilter_torch.photo.picture.photographs import Photograph, check_output, read_photograph, write_photograph
from nlfilter_torch.photo.picture.tiles import Passes

BYTES_PER_PIXEL = 100  # bytes per pixel of a frame, besides those of the edit, which is tiled


def edit_frames(
    recipe: Recipe, name: str, source: Path, target: Path, references: int, seed: int, memory: float | None
) -> int:
    """Apply a recipe to all frames, fitted to ``references`` of them; return their number.

    ``name`` is that of the recipe in notes, and ``memory`` are gigabytes.
    """
    film_steps(recipe.steps)
    film = is_film(source) and not source.is_dir()
    what = "the film is encoded again" if film else "the photographs are written"
    notes = notes_if_idle(recipe, name, what)
    passes = Passes("float32", memory=allowed_memory(memory, TILED_MEMORY))
    work = edit_film if film else edit_stills
    return work(source, target, references, partial(fitted, recipe, passes, seed, notes))


def fitted(recipe: Recipe, passes: Passes, seed: int, notes: Iterable[str], samples: list[FrameArray]) -> FilmEdit:
    """Print the notes on the options, and fit an edit to frames that have been read."""
    for note in notes:
        options.note(note)
    return FilmEdit(recipe.steps, samples, passes=passes, seed=seed)


def edit_film(source: Path, target: Path, references: int, fit: Callable[[list[FrameArray]], FilmEdit]) -> int:
    """Edit a film, and return the number of its frames."""
    if target.exists() and target.samefile(source):
        raise ValueError(f"OUT must be another file than the film, got {target}; choose another name")
    check_film_output(target)
    with open_film(source) as film, steps(film.count + 1) as begin:
        begin("Fitting to sample frames")
        edit = fit(film.sample(references))
        return write_film(film, target, edit, lambda number: begin(f"Frame {number + 1} of {film.count}"))


def edit_stills(source: Path, target: Path, references: int, fit: Callable[[list[FrameArray]], FilmEdit]) -> int:
    """Edit the photographs in a folder, and return their number."""
    paths = frames_of(source, target)
    folder, reader = EditedFrames(target, check_replaced(paths, target)), FrameReader()
    with steps(len(paths) + 1) as begin:
        begin("Fitting to sample frames")
        spread = torch.linspace(0, len(paths) - 1, min(references, len(paths))).round().long().tolist()
        edit = fit([reader(paths[i])[1] for i in spread])
        for path in paths:
            begin(path.name)
            photograph, rows = reader(path)
            folder.prepare(photograph, path.name, paths)
            folder.write(photograph, edit(rows), path.name)
    return len(paths)


def frames_of(source: Path, target: Path) -> list[Path]:
    """The photographs in a folder, of which edited ones can be written to another folder."""
    if source.is_file():
        raise ValueError(f"{source} must be a film (.mp4, .m4v or .mov) or a folder; convert it")
    paths = pictures(source, "frames")
    if target.exists() and target.resolve() == source.resolve():
        raise ValueError(f"{target} must not be the folder of the frames; choose another folder")
    if is_film(target) and not target.is_dir():
        raise ValueError(f"OUT must be a folder, as FRAMES is one, got {target}; choose the name of a folder")
    check_folder(target)
    return paths


class FrameReader:
    """Reads photographs, which must have the size and channels of the first of them."""

    def __init__(self) -> None:
        self._shape: tuple[int, ...] = ()

    def __call__(self, path: Path) -> tuple[Photograph, FrameArray]:
        """A photograph, and its pixels (H, W, C)."""
        photograph = read_photograph(path, bytes_per_pixel=BYTES_PER_PIXEL)
        rows = photograph.pixels[0].permute(1, 2, 0).float().contiguous().numpy()
        self._shape = self._shape or rows.shape
        if rows.shape != self._shape:
            expected, actual = (
                f"{height}x{width} and {colours} channel(s)" for height, width, colours in (self._shape, rows.shape)
            )
            raise ValueError(
                f"{path} must have the size and channels of the first frame, {expected}, got {actual}; convert it"
            )
        return photograph, rows


class EditedFrames:
    """The folder of the edited frames; ``written`` are the names of files that an earlier run wrote there."""

    def __init__(self, folder: Path, written: set[str]) -> None:
        self._folder, self._written = folder, written
        self._is_new, self._is_begun = not folder.exists(), False

    def prepare(self, photograph: Photograph, name: str, paths: list[Path]) -> None:
        """Create the folder, record the names of all frames there, and check that it can hold a photograph."""
        self._folder.mkdir(exist_ok=True)
        try:
            check_output(self._folder / name, photograph)
        except ValueError:
            if self._is_new and not self._is_begun:
                self._folder.rmdir()
            raise
        if not self._is_begun:
            record_written(self._folder, self._written | {path.name for path in paths})
        self._is_begun = True

    def write(self, photograph: Photograph, rows: FrameArray, name: str) -> None:
        """Write a photograph with other pixels (H, W, C)."""
        write_photograph(photograph.with_pixels(torch.from_numpy(rows).permute(2, 0, 1)[None]), self._folder / name)
