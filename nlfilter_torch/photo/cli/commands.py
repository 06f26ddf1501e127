"""The commands besides those of single edits: arguments and help. What they do is imported when they are called."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import (
    DETAIL_OPTIONS,
    check_usual,
    edit_photograph,
    other_recipe,
    parsed_value,
    preset_option,
    step_of,
    typed_options,
    with_declared,
    with_options,
)
from nlfilter_torch.photo.declared.colour_tables import CUBE_NODES
from nlfilter_torch.photo.declared.development import DEVELOP, Development
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import DETAIL, EDITS
from nlfilter_torch.photo.declared.presets import (
    CHARACTERS,
    LOOKS,
    PRESETS,
    PURPOSES,
    Recipe,
    find_recipe,
    named_recipe,
)
from nlfilter_torch.photo.declared.shared_parameters import LOOK

#: Edits without scribbles.
EDITS_WITHOUT_STROKES = tuple(edit for edit in EDITS.values() if not edit.requires_strokes)

Crop = Annotated[
    str | None,
    typer.Option(
        "--crop",
        metavar="X,Y,W,H",
        help="What is kept of the straightened photograph: column and row of the upper left corner, width and height, "
        "in pixels or in % of it. It shrinks about its middle if it has empty corners.",
    ),
]
Aspect = Annotated[
    str | None,
    typer.Option(
        "--aspect",
        metavar="W:H",
        help="Width and height to which the crop is trimmed about its middle, such as 3:2 or 1:1; without --crop, that "
        "of the whole photograph.",
    ),
]


@with_declared(DEVELOP)
def develop(
    source: options.Source,
    target: options.Target,
    *,
    crop: Crop = None,
    aspect: Aspect = None,
    files: options.PhotographOptions,
    **values: Any,
) -> None:
    """Develop a photograph; the help is that of the declaration."""
    sides = None if aspect is None else options.parse_aspect(aspect)
    development = Development(**{name: parsed_value(value, DEVELOP[name]) for name, value in values.items()})

    from nlfilter_torch.photo.cli.jobs import develop_file

    develop_file(Recipe((), development), crop, sides, source, target, files)


Edits = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="PRESET",
        help="A file saved by the editor (`nlfilter-torch app`) or written by `nlfilter-torch fit`, a colour table (a "
        ".cube file or a Hald), or the name of a preset (see `nlfilter-torch presets`). Several have a --mask each, "
        "in the same order; the rest of the photograph stays unchanged.",
        show_default=False,
    ),
]
NamedEdits = Annotated[
    list[str] | None, typer.Option("--preset", metavar="FILE|NAME", help="The same as an option; may be repeated.")
]


@with_options()
def apply(
    source: options.Source,
    target: options.Target,
    presets: Edits = None,
    *,
    preset: NamedEdits = None,
    mask: options.Masks = None,
    files: options.PhotographOptions,
    full: options.Full = False,
) -> None:
    """Apply an edit to a photograph: one saved in the browser, with its strokes and crop, a look, or a colour table.

    Photographs larger than memory are edited in tiles.

    Example: `nlfilter-torch apply in.jpg out.jpg edit.json`

    A look by its name: `nlfilter-torch apply in.jpg out.jpg vivid`

    Two looks that `nlfilter-torch fit` found for regions: `nlfilter-torch apply in.jpg out.jpg look-1.json look-2.json
    --mask sky.png --mask ground.png`
    """
    named = [*(presets or []), *(preset or [])]
    if not named:
        raise ValueError(
            "PRESET must be given, such as nlfilter-torch apply IN OUT vivid; nlfilter-torch presets lists the names"
        )
    from nlfilter_torch.photo.cli.jobs import apply_files

    apply_files(named, mask or [], source, target, files, full=full)


Before = Annotated[str, typer.Argument(metavar="BEFORE", help="The photograph before the edit, or a folder of them.")]
After = Annotated[
    str, typer.Argument(metavar="AFTER", help="The same after the edit; in a folder, under the same names.")
]
LookFile = Annotated[Path, typer.Argument(metavar="PRESET", help="The JSON file in which the look is saved.")]
Order = Annotated[
    int,
    typer.Option("--layers", min=2, max=10, metavar="N", help="Number of sliders, from the finest to the coarsest."),
]
Preview = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A picture of the first pair at the viewing size: before, after, the look, and the remaining difference, "
        "amplified, around grey.",
    ),
]
Map = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="A grey picture of the part of the first pair's edit that the look does not explain.",
    ),
]
Cube = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=f"A colour table of {CUBE_NODES}^3 for other programs, a .cube file: the part of the look that depends on "
        "the colour alone.",
    ),
]
Hald = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="The same as a picture, a Hald of level 8, in 16 bits: a PNG or TIFF file."),
]


@with_options("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling")
def fit(
    before: Before,
    after: After,
    preset: LookFile = Path("preset.json"),
    layers: Order = 4,
    mask: options.MasksOfPairs = None,
    preview: Preview = None,
    left: Map = None,
    cube: Cube = None,
    hald: Hald = None,
    **values: Value,
) -> None:
    """Find the look that turns a photograph into an edited one, or a folder of them, whatever program made the edit.

    A look has sliders, tone curves, colours and sharpness, but only those that also explain photographs left out of
    the fit. Prints how much of the change it explains, and saves it in a file for other photographs:

    `nlfilter-torch fit before.jpg after.jpg look.json --preview seen.png`

    `nlfilter-torch apply other.jpg out.jpg look.json`

    For other programs: `nlfilter-torch fit before.jpg after.jpg look.json --cube look.cube`

    Each --mask is a region that has a look of its own, in numbered files:

    `nlfilter-torch fit before.jpg after.jpg look.json --mask sky.png --mask ground.png`
    """
    from nlfilter_torch.photo.cli.fit_job import FitJob

    step = step_of(LOOK, values)
    job = FitJob(step, Path(before), Path(after), preset, mask or [], preview, left, cube, hald)
    job.run(layers - 1)


PresetOfList = Annotated[
    str | None,
    typer.Argument(metavar="NAME", help="Print this preset or look as JSON, to be edited and passed to `apply`."),
]


def presets(name: PresetOfList = None) -> None:
    """List the presets and looks for `nlfilter-torch detail --preset NAME`, or print one of them as a file.

    To start one of your own: `nlfilter-torch presets crisp > mine.json`
    """
    if name not in (None, "list"):
        typer.echo(find_recipe(name).to_json(complete=True), nl=False)
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("preset", "alpha", "bandwidth", "what it does")
    for title, preset in PRESETS.items():
        step = preset.steps[0]
        sliders = ", ".join(f"{value:g}" for value in step["alpha"])
        bandwidth = step["bandwidth"] if isinstance(step["bandwidth"], str) else f"{step['bandwidth']:g}"
        table.add_row(title, sliders, bandwidth, PURPOSES[title])
    console = Console()
    console.print(table)
    looks = Table("look", "what it does")
    for title, character in CHARACTERS.items():
        looks.add_row(title, character)
    console.print(looks)


Folder = Annotated[Path, typer.Argument(metavar="IN_DIR", help="The folder that holds the photographs.")]
EditedFolder = Annotated[
    Path,
    typer.Argument(
        metavar="OUT_DIR",
        help="The folder for the edited ones, under the same names; created if it does not exist. Photographs that "
        "it already contains are skipped.",
    ),
]
PresetOfFolder = Annotated[
    str | None,
    preset_option(
        f"One of {', '.join((*PRESETS, *LOOKS))}, or a file of any edits, such as `nlfilter-torch fit` and the editor "
        "make. Options on the command line override a detail preset; other presets accept none.",
        plain=False,
    ),
]


@with_options(*DETAIL_OPTIONS)
def batch(
    context: typer.Context,
    folder: Folder,
    target: EditedFolder,
    *,
    seed: options.Seed = 0,
    preset: PresetOfFolder = None,
    files: options.FolderOptions,
    **values: Any,
) -> None:
    """Edit all photographs of a folder: their details, as `nlfilter-torch detail` does, or by any file of edits.

    A file that cannot be edited is reported and the others are done; the exit status is 1 then. After an interruption
    the same command does what is left. The workers share --memory; on a cluster, every worker may use that much.

    By a saved edit: `nlfilter-torch batch shots edited --preset look.json`

    On several machines that share the folders: `nlfilter-torch batch shots edited --cluster tcp://host:8786`
    """
    step = step_of(DETAIL, values)
    if not files.force:
        check_usual(step, typed_options(context, values))
    settings = {**values, "seed": seed}
    recipe = None if preset is None else other_recipe(context, preset, settings)

    from nlfilter_torch.photo.cli.batch import FileEdit, edit_photographs
    from nlfilter_torch.photo.cli.jobs import apply_files

    edit: FileEdit = partial(edit_photograph, DETAIL, **settings)
    if preset is not None and recipe is not None:
        absolute = preset if named_recipe(preset) is not None else str(Path(preset).absolute())  # workers are elsewhere
        edit, settings = partial(apply_files, [absolute], []), {"recipe": recipe.to_json()}
    edit_photographs(edit, settings, folder, target, files)


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
PresetOfFilm = Annotated[
    str | None,
    preset_option(
        f"One of {', '.join((*PRESETS, *LOOKS))}, or a file of any edits without scribbles, as written by "
        "`nlfilter-torch fit` or the editor. Options on the command line override a detail preset; other presets "
        "accept none.",
        plain=False,
    ),
]


@dataclass(frozen=True)
class FilmOptions:
    """The options of ``frames``, in the order of its help."""

    edit: EditName = "detail"
    references: References = 3
    seed: options.Seed = 0
    preset: PresetOfFilm = None
    memory: options.Memory = None
    force: options.Insist = False


@with_options(*DETAIL_OPTIONS, more=EDITS_WITHOUT_STROKES)
def frames(context: typer.Context, source: Frames, target: Edited, film: FilmOptions, **values: Value) -> None:
    """Edit all frames of a film alike, without flicker.

    The filter is fitted once, to frames spread over the film, and applied to every frame. Since objects move, distance
    counts only if --spatial-bandwidth is given. Films keep their sound, frame rate, time stamps, rotation and colour
    properties (needs the extra `films`). Photographs in a folder keep their names, types, depths, transparency, colour
    profiles and camera metadata; files in OUT are replaced if this command wrote them.

    By sliders: `nlfilter-torch frames film.mp4 edited.mp4 --alpha 2,2,2,1`

    By the name of a look, or a file: `nlfilter-torch frames shots edited --preset crisp`

    Another edit: `nlfilter-torch frames film.mp4 edited.mp4 --edit denoise --noise-level 8`
    """
    recipe = chosen_recipe(context, film.edit, film.preset, values)
    if not recipe.develop.is_idle:
        raise ValueError(
            f"--preset must not develop the photographs of a film, got {film.preset}; remove its entry develop"
        )
    if not film.force and recipe.steps:
        check_usual(recipe.steps[0], typed_options(context, values))

    from nlfilter_torch.photo.cli.frames import edit_frames

    name = film.preset or f"--edit {film.edit}"
    count = edit_frames(recipe, name, source, target, film.references, film.seed, film.memory)
    typer.echo(f"{count} frames in {target}")


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


Figures = Annotated[
    Path, typer.Argument(metavar="OUTDIR", help="The folder for the pictures; created if it does not exist.")
]


@with_options("alpha", "bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling", "viewing_size")
def inspect(source: options.Source, folder: Figures, seed: options.Seed = 0, **values: Value) -> None:
    """Show the filter of a photograph: the patterns it finds, how strong they are, and how sliders change them.

    Writes eigenvectors.png, eigenvalues.png, response.png and diagnostics.json into a folder and prints a table. A
    photograph larger than the viewing size is reduced to it, as for `detail`.

    Example: `nlfilter-torch inspect in.jpg looks --alpha 3,3,4,1.05`
    """
    step = step_of(DETAIL, values)

    from nlfilter_torch.photo.cli.inspect import write_diagnostics

    write_diagnostics(source, folder, step, seed)


def demo(folder: Figures = Path("out")) -> None:
    """Show what this program does, on an example photograph.

    Writes pictures of the photograph before and after, of its layers, of the patterns that the filter finds, of the
    response of the sliders and of a region extended to everything that looks like it, and prints a table.
    """
    from nlfilter_torch.photo.cli.inspect import write_examples

    write_examples(folder)
