"""One edit for all frames of a film, without flicker."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.editing import allowed_memory
from nlfilter_torch.photo.cli.folders import check_replaced, pictures, record_written
from nlfilter_torch.photo.cli.progress import steps
from nlfilter_torch.photo.cli.showing import notes_if_idle
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.edits.film import FilmEdit, FrameArray, film_steps
from nlfilter_torch.photo.files.films import check_film_output, is_film, open_film
from nlfilter_torch.photo.files.rows import TILED_MEMORY
from nlfilter_torch.photo.files.writing import check_folder
from nlfilter_torch.photo.picture.photographs import Photograph, check_output, read_photograph, write_photograph
from nlfilter_torch.photo.picture.tiles import Passes

BYTES_PER_PIXEL = 100  # bytes per pixel of a frame, besides those of the edit, which is tiled


class Frames(Protocol):
    """The frames of a film, or of a folder."""

    @property
    def count(self) -> int:
        """Number of frames; that of a film is approximate."""

    def sample(self, count: int) -> list[FrameArray]:
        """Some of the frames (H, W, C), spread over all."""

    def write(self, path: Path, edit: Callable[[FrameArray], FrameArray], begin: Callable[[str], None], /) -> int:
        """Write every frame edited to a film or folder, after telling ``begin`` which; return their number."""


def edit_frames(
    recipe: Recipe, name: str, source: Path, target: Path, references: int, seed: int, memory: float | None
) -> int:
    """Apply a recipe to all frames, fitted to ``references`` of them; return their number.

    ``name`` is that of the recipe in notes, and ``memory`` are gigabytes.
    """
    film_steps(recipe.steps)
    film = is_film(source) and not source.is_dir()
    what = "the film is encoded again" if film else "the photographs are written"
    passes = Passes("float32", memory=allowed_memory(memory, TILED_MEMORY))
    with _film(source, target) if film else _stills(source, target) as frames, steps(frames.count + 1) as begin:
        begin("Fitting to sample frames")
        samples = frames.sample(references)
        for note in notes_if_idle(recipe, name, what):
            options.note(note)
        return frames.write(target, FilmEdit(recipe.steps, samples, passes=passes, seed=seed), begin)


@contextmanager
def _film(source: Path, target: Path) -> Iterator[Frames]:
    """The frames of a film that is edited to another one."""
    if target.exists() and target.samefile(source):
        raise ValueError(f"OUT must be another file than the film, got {target}; choose another name")
    check_film_output(target)
    with open_film(source) as film:
        yield film


@contextmanager
def _stills(source: Path, target: Path) -> Iterator[Frames]:
    """The photographs in a folder, of which edited ones can be written to another folder."""
    if source.is_file():
        raise ValueError(f"{source} must be a film (.mp4, .m4v or .mov) or a folder; convert it")
    paths = pictures(source, "frames")
    if target.exists() and target.resolve() == source.resolve():
        raise ValueError(f"{target} must not be the folder of the frames; choose another folder")
    if is_film(target) and not target.is_dir():
        raise ValueError(f"OUT must be a folder, as FRAMES is one, got {target}; choose the name of a folder")
    check_folder(target)
    yield Stills(paths, check_replaced(paths, target))


@dataclass
class Stills:
    """Photographs, which must have the size and channels of the first of them that is read.

    Attributes:
        paths: their files.
        written: names of files that an earlier run wrote to the folder of the edited ones.
        shape: (H, W, C) of the first; empty before it is read.
    """

    paths: list[Path]
    written: set[str]
    shape: tuple[int, ...] = ()

    @property
    def count(self) -> int:
        """Number of photographs."""
        return len(self.paths)

    def sample(self, count: int) -> list[FrameArray]:
        """Some of the photographs, spread over all."""
        spread = torch.linspace(0, self.count - 1, min(count, self.count)).round().long().tolist()
        return [self._read(self.paths[i])[1] for i in spread]

    def write(self, folder: Path, edit: Callable[[FrameArray], FrameArray], begin: Callable[[str], None]) -> int:
        """Write every photograph edited to a folder, which is made when it is known that it can hold the first."""
        is_new, is_begun = not folder.exists(), False
        for path in self.paths:
            begin(path.name)
            photograph, rows = self._read(path)
            folder.mkdir(exist_ok=True)
            try:
                check_output(folder / path.name, photograph)
            except ValueError:
                if is_new and not is_begun:
                    folder.rmdir()
                raise
            if not is_begun:
                record_written(folder, self.written | {path.name for path in self.paths})
            is_begun = True
            pixels = torch.from_numpy(edit(rows)).permute(2, 0, 1)[None]
            write_photograph(photograph.with_pixels(pixels), folder / path.name)
        return self.count

    def _read(self, path: Path) -> tuple[Photograph, FrameArray]:
        """A photograph, and its pixels (H, W, C)."""
        photograph = read_photograph(path, bytes_per_pixel=BYTES_PER_PIXEL)
        rows = photograph.pixels[0].permute(1, 2, 0).float().contiguous().numpy()
        self.shape = self.shape or rows.shape
        if rows.shape != self.shape:
            expected, actual = (
                f"{height}x{width} and {colours} channel(s)" for height, width, colours in (self.shape, rows.shape)
            )
            raise ValueError(
                f"{path} must have the size and channels of the first frame, {expected}, got {actual}; convert it"
            )
        return photograph, rows
