"""``nlfilter-torch batch``: the same edit of the details for all photographs of a folder."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.apply import apply
from nlfilter_torch.photo.cli.edits import (
    DETAIL_OPTIONS,
    check_usual,
    edit_photograph,
    other_recipe,
    preset_option,
    step_of,
    typed_options,
    with_options,
)
from nlfilter_torch.photo.cli.interrupts import INTERRUPTED
from nlfilter_torch.photo.declared.looks import LOOKS
from nlfilter_torch.photo.declared.parameters import EDITS
from nlfilter_torch.photo.declared.presets import PRESETS, named_recipe

if TYPE_CHECKING:
    from nlfilter_torch.photo.cli.folders import Tally

NAMED = 5  # subfolders that are left out and named

Folder = Annotated[Path, typer.Argument(metavar="IN_DIR", help="The folder that holds the photographs.")]
Target = Annotated[
    Path,
    typer.Argument(
        metavar="OUT_DIR",
        help="The folder for the edited ones, under the same names; created if it does not exist. Photographs that "
        "it already contains are skipped.",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="How many photographs are edited at a time; each takes memory of its own. Default: one per core.",
    ),
]

Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help=f"The {options.ADDRESS} edit the photographs in place of this machine. {options.ON_CLUSTER}",
    ),
]

Preset = Annotated[
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
    target: Target,
    seed: options.Seed = 0,
    preset: Preset = None,
    workers: Workers = None,
    cluster: Cluster = None,
    memory: options.Memory = None,
    quality: options.QualityOfFolder = None,
    force: options.Insist = False,
    **values: Any,
) -> None:
    """Edit all photographs of a folder: their details, as `nlfilter-torch detail` does, or by any file of edits.

    A file that cannot be edited is reported and the others are done; the exit status is 1 then. After an interruption
    the same command does what is left. The workers share --memory; on a cluster, every worker may use that much.

    By a saved edit: `nlfilter-torch batch shots edited --preset look.json`

    On several machines that share the folders: `nlfilter-torch batch shots edited --cluster tcp://host:8786`
    """
    step = step_of(EDITS["detail"], values)
    if not force:
        check_usual(step, typed_options(context, values))

    from nlfilter_torch.photo.cli.editing import allowed_memory, check_quality_of, check_workers
    from nlfilter_torch.photo.cli.folders import Tally, edit_folder, left_out, pictures, prepare, subfolders
    from nlfilter_torch.photo.cli.progress import steps
    from nlfilter_torch.photo.files.rows import WHOLE, free_memory

    check_workers(workers, cluster)
    if cluster is not None:  # whose workers run in other folders
        folder, target = folder.absolute(), target.absolute()
    shared = free_memory() if memory is None else allowed_memory(memory)
    settings = {**values, "seed": seed}
    edit: Callable[..., object] = partial(edit_photograph, EDITS["detail"], **settings)
    if preset is not None and (recipe := other_recipe(context, preset, settings)) is not None:
        settings, edit = {"recipe": recipe.to_json()}, partial(apply, preset=[_absolute(preset)])
    paths = pictures(folder)
    if quality is not None:
        check_quality_of(paths, quality)
        settings, edit = {**settings, "quality": quality}, partial(_edit_at_quality, edit, quality)
    prepare(paths, target, settings)
    if others := left_out(folder):
        _tell(f"left out {others}; convert them to PNG, JPEG, TIFF, WebP or AVIF if they are photographs")
    if names := subfolders(folder, target):
        more = f" and {len(names) - NAMED} others" if len(names) > NAMED else ""
        _tell(
            f"left out the subfolders {', '.join(names[:NAMED])}{more}; run the command on each that holds photographs"
        )
    tally, interrupted = Tally(), False
    count = min(workers or _cores(), len(paths))
    room = memory  # of a worker; None is as much as the command of an edit uses
    if cluster is None and (memory is not None or shared < count * WHOLE):
        room = shared / count / 1e9
    try:
        with steps(len(paths), lines=False) as begin:  # files that fail are told by lines
            edit_folder(
                paths,
                target,
                partial(edit, memory=room),
                workers=count,
                threads=max(1, _cores() // count),
                cluster=cluster,
                tell=_tell,
                begin=begin,
                tally=tally,
            )
    except KeyboardInterrupt:
        interrupted = True
        _tell("run the same command again to edit the remaining photographs")
    _summarise(tally, target)
    if interrupted:
        raise typer.Exit(INTERRUPTED)
    if tally.failures or tally.left:
        raise typer.Exit(1)


def _absolute(preset: str) -> str:
    """A preset's name, or the absolute path of its file, since workers may run in other folders."""
    return preset if named_recipe(preset) is not None else str(Path(preset).absolute())


def _edit_at_quality(edit: Callable[..., object], quality: int, source: str, target: str, **limits: Any) -> None:
    """Edit a file, with that quality if it is a JPEG."""
    from nlfilter_torch.photo.cli.editing import is_jpeg

    edit(source, target, **limits, **({"quality": quality} if is_jpeg(target) else {}))


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _tell(sentence: str) -> None:
    typer.echo(f"nlfilter-torch: {sentence}", err=True)


def _summarise(tally: "Tally", target: Path) -> None:
    """Counts on the standard output, and the names of what is missing."""
    counts = [f"{tally.done} edited", f"{tally.skipped} there already", f"{len(tally.failures)} failed"]
    if tally.left:
        counts.append(f"{tally.left} not begun")
    typer.echo(f"{', '.join(counts)}, in {target}")
    if tally.failures:
        typer.echo(f"failed: {', '.join(sorted(tally.failures))}")
