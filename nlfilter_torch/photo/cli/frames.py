"""``nlfilter-torch frames``: one edit for all frames of a film, without flicker."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import (
    DETAIL_OPTIONS,
    check_usual,
    other_recipe,
    preset_option,
    step_of,
    typed_options,
    with_options,
)
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.looks import LOOKS
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe

if TYPE_CHECKING:
    from nlfilter_torch.photo.edits.film import FilmEdit, FrameArray
    from nlfilter_torch.photo.picture.photographs import Photograph
    from nlfilter_torch.photo.picture.tiles import Passes

#: Edits without scribbles.
EDITS_WITHOUT_STROKES = tuple(edit for edit in EDITS.values() if not edit.requires_strokes)
BYTES_PER_PIXEL = 100  # bytes per pixel of a frame, besides those of the edit, which is tiled

Frames = Annotated[
    Path,
    typer.Argument(
        metavar="FRAMES",
        help="A film (.mp4, .m4v or .mov), or a folder of photographs, read in the order of their names.",
    ),
]
Edited = Annotated[
    Path,
    typer.Argument(
        metavar="OUT",
        help="The edited film (.mp4, .m4v or .mov), or the folder for the edited photographs; created if it does not "
        "exist.",
    ),
]
References = Annotated[
    int,
    typer.Option(
        min=1,
        metavar="N",
        help="Number of frames, spread over the film, to which the filter is fitted. Use more if the scene changes.",
    ),
]
EditName = Annotated[
    str,
    typer.Option(
        "--edit",
        metavar="|".join(edit.name for edit in EDITS_WITHOUT_STROKES),
        help="The edit to apply, with the name of its command.",
    ),
]
Preset = Annotated[
    str | None,
    preset_option(
        f"One of {', '.join((*PRESETS, *LOOKS))}, or a file of any edits without scribbles, as written by "
        "`nlfilter-torch fit` or the editor. Options on the command line override a detail preset; other presets "
        "accept none.",
        plain=False,
    ),
]


@with_options(*DETAIL_OPTIONS, more=EDITS_WITHOUT_STROKES)
def frames(
    context: typer.Context,
    source: Frames,
    target: Edited,
    edit: EditName = "detail",
    references: References = 3,
    seed: options.Seed = 0,
    preset: Preset = None,
    memory: options.Memory = None,
    force: options.Insist = False,
    **values: Value,
) -> None:
    """Edit all frames of a film alike, without flicker.

    The filter is fitted once, to frames spread over the film, and applied to every frame. Since objects move, distance
    counts only if --spatial-bandwidth is given. Films keep their sound, frame rate, time stamps, rotation and colour
    properties (needs the extra `films`). Photographs in a folder keep their names, types, depths, transparency, colour
    profiles and camera metadata; files in OUT are replaced if this command wrote them.

    By sliders: `nlfilter-torch frames film.mp4 edited.mp4 --alpha 2,2,2,1`

    By the name of a look, or a file: `nlfilter-torch frames shots edited --preset crisp`

    Another edit: `nlfilter-torch frames film.mp4 edited.mp4 --edit denoise --noise-level 8`
    """
    recipe = chosen_recipe(context, edit, preset, values)
    if not recipe.develop.is_idle:
        raise ValueError(f"--preset must not develop the photographs of a film, got {preset}; remove its entry develop")
    if not force and recipe.steps:
        check_usual(recipe.steps[0], typed_options(context, values))

    from nlfilter_torch.photo.cli.editing import allowed_memory
    from nlfilter_torch.photo.cli.showing import notes_if_idle
    from nlfilter_torch.photo.edits.film import film_steps
    from nlfilter_torch.photo.files.films import is_film
    from nlfilter_torch.photo.files.rows import TILED
    from nlfilter_torch.photo.picture.tiles import Passes

    film_steps(recipe.steps)
    film = is_film(source) and not source.is_dir()
    what = "the film is encoded again" if film else "the photographs are written"
    notes = notes_if_idle(recipe, preset or f"--edit {edit}", what)
    passes = Passes("float32", memory=allowed_memory(memory, TILED))

    work = edit_film if film else edit_folder
    count = work(source, target, references, partial(fitted, recipe, passes, seed, notes))
    typer.echo(f"{count} frames in {target}")


def fitted(
    recipe: Recipe, passes: "Passes", seed: int, notes: Iterable[str], samples: "list[FrameArray]"
) -> "FilmEdit":
    """Print the notes on the options, and fit an edit to frames that have been read."""
    from nlfilter_torch.photo.edits.film import FilmEdit

    for note in notes:
        options.note(note)
    return FilmEdit(recipe.steps, samples, passes=passes, seed=seed)


def chosen_recipe(context: typer.Context, name: str, preset: str | None, values: dict[str, Value]) -> Recipe:
    """Create the edit from the values of options.

    Raises:
        ValueError: if an option does not belong to the edit.
    """
    if preset is not None and (recipe := other_recipe(context, preset, (*values, "edit"))) is not None:
        return recipe
    if name not in {edit.name for edit in EDITS_WITHOUT_STROKES}:
        names = ", ".join(edit.name for edit in EDITS_WITHOUT_STROKES)
        raise ValueError(f"--edit must be one of {names}, got {name!r}; choose one of these")
    if preset is not None and not EDITS[name].presets:
        raise ValueError(f"--edit must not be given together with --preset, got {name} and {preset}; drop one of them")
    own, declared = typed_options(context, values), {parameter.name for parameter in EDITS[name]}
    other = next((option for option in own if option not in declared), None)
    if other is not None:
        edits = " or ".join(edit.name for edit in EDITS_WITHOUT_STROKES if other in {p.name for p in edit})
        raise ValueError(
            f"--{other.replace('_', '-')} must be used with --edit {edits}, got --edit {name}; drop it or change --edit"
        )
    edit_values = values if EDITS[name].presets else {option: values[option] for option in own}
    return Recipe((step_of(EDITS[name], edit_values),))


def edit_film(source: Path, target: Path, references: int, fit: "Callable[[list[FrameArray]], FilmEdit]") -> int:
    """Edit a film, and return the number of its frames."""
    from nlfilter_torch.photo.cli.progress import steps
    from nlfilter_torch.photo.files.films import check_film_output, open_film, write_film

    if target.exists() and target.samefile(source):
        raise ValueError(f"OUT must be another file than the film, got {target}; choose another name")
    check_film_output(target)
    with open_film(source) as film, steps(film.count + 1) as begin:
        begin("Fitting to sample frames")
        edit = fit(film.sample(references))
        return write_film(film, target, edit, lambda number: begin(f"Frame {number + 1} of {film.count}"))


def edit_folder(source: Path, target: Path, references: int, fit: "Callable[[list[FrameArray]], FilmEdit]") -> int:
    """Edit the photographs in a folder, and return their number."""
    import torch

    from nlfilter_torch.photo.cli.folders import check_replaced
    from nlfilter_torch.photo.cli.progress import steps

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
    from nlfilter_torch.photo.cli.folders import pictures
    from nlfilter_torch.photo.files.films import is_film
    from nlfilter_torch.photo.files.writing import check_folder

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

    def __call__(self, path: Path) -> "tuple[Photograph, FrameArray]":
        """A photograph, and its pixels (H, W, C)."""
        from nlfilter_torch.photo.picture.photographs import read_photograph

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

    def prepare(self, photograph: "Photograph", name: str, paths: list[Path]) -> None:
        """Create the folder, record the names of all frames there, and check that it can hold a photograph."""
        from nlfilter_torch.photo.cli.folders import record_written
        from nlfilter_torch.photo.picture.photographs import check_output

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

    def write(self, photograph: "Photograph", rows: "FrameArray", name: str) -> None:
        """Write a photograph with other pixels (H, W, C)."""
        import torch

        from nlfilter_torch.photo.picture.photographs import write_photograph

        write_photograph(photograph.with_pixels(torch.from_numpy(rows).permute(2, 0, 1)[None]), self._folder / name)
