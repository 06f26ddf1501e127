"""A folder of photographs edited by worker processes: those of joblib on this machine, or those of a cluster.

Needs the ``cli`` extra, and ``cluster`` for a cluster. A file is done when the output folder has a file of
its name, since a name appears only when its file is complete
(:func:`~nlfilter_torch.photo.files.writing.open_beside`). An interrupted run continues when it is started again.
"""

import contextlib
import io
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import typer

from nlfilter_torch.photo.cli.editing import allowed_memory, check_quality_of, check_workers
from nlfilter_torch.photo.cli.folders import left_out, pictures, prepare, subfolders
from nlfilter_torch.photo.cli.options import NOTE, FolderOptions, PhotographOptions
from nlfilter_torch.photo.cli.process import INTERRUPTED
from nlfilter_torch.photo.cli.progress import steps
from nlfilter_torch.photo.cli.workers import Crew, worker_pool
from nlfilter_torch.photo.files.formats import LOSSY, type_of
from nlfilter_torch.photo.files.rows import WHOLE_MEMORY, free_memory
from nlfilter_torch.photo.files.writing import remove_stale

DEATHS = 3  # per worker and in a row: after so many deaths the cause is not in the files
NAMED = 5  # subfolders that are left out and named
DIED = "the process that worked on it died; use fewer --workers, so that each has more memory, or check the file"

Edit = Callable[[str, str], object]  # edits the file of the first name to that of the second; can be pickled
FileEdit = Callable[[str, str, PhotographOptions], object]
Outcome = list[str] | str  # warnings of a file that was edited, or why it could not be edited


@dataclass
class Tally:
    """Counts of files.

    Attributes:
        done: edited in this run.
        skipped: present before.
        failures: from the name of a file that could not be edited to the reason.
        left: not begun.
    """

    done: int = 0
    skipped: int = 0
    failures: dict[str, str] = field(default_factory=dict)
    left: int = 0


def edit_photographs(
    edit: FileEdit, settings: Mapping[str, object], folder: Path, target: Path, files: FolderOptions
) -> None:
    """Edit all photographs of a folder, and say how many; raises typer.Exit if not all were edited.

    ``settings`` are recorded in the output folder.
    """
    check_workers(files.workers, files.cluster)
    if files.cluster is not None:  # whose workers run in other folders
        folder, target = folder.absolute(), target.absolute()
    shared = free_memory() if files.memory is None else allowed_memory(files.memory)
    paths = pictures(folder)
    if files.quality is not None:
        check_quality_of(paths, files.quality)
        settings = {**settings, "quality": files.quality}
    prepare(paths, target, settings)
    if others := left_out(folder):
        _tell(f"left out {others}; convert them to PNG, JPEG, TIFF, WebP or AVIF if they are photographs")
    if names := subfolders(folder, target):
        more = f" and {len(names) - NAMED} others" if len(names) > NAMED else ""
        _tell(
            f"left out the subfolders {', '.join(names[:NAMED])}{more}; run the command on each that holds photographs"
        )
    tally, interrupted = Tally(), False
    count = min(files.workers or _cores(), len(paths))
    room = files.memory  # of a worker; None is as much as the command of an edit uses
    if files.cluster is None and (files.memory is not None or shared < count * WHOLE_MEMORY):
        room = shared / count / 1e9
    try:
        with steps(len(paths), lines=False) as begin:  # files that fail are told by lines
            edit_folder(
                paths,
                target,
                partial(_edited, edit, PhotographOptions(quality=files.quality, memory=room)),
                Crew(count, max(1, _cores() // count), files.cluster),
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


def _edited(edit: FileEdit, files: PhotographOptions, source: str, target: str) -> None:
    """Edit a file, with the quality of these options if its type has one."""
    edit(source, target, files if type_of(target) in LOSSY else replace(files, quality=None))


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _tell(sentence: str) -> None:
    typer.echo(f"nlfilter-torch: {sentence}", err=True)


def _summarise(tally: Tally, target: Path) -> None:
    """Counts on the standard output, and the names of what is missing."""
    counts = [f"{tally.done} edited", f"{tally.skipped} there already", f"{len(tally.failures)} failed"]
    if tally.left:
        counts.append(f"{tally.left} not begun")
    typer.echo(f"{', '.join(counts)}, in {target}")
    if tally.failures:
        typer.echo(f"failed: {', '.join(sorted(tally.failures))}")


def edit_folder(
    paths: Sequence[Path],
    target: Path,
    edit: Edit,
    crew: Crew,
    *,
    tell: Callable[[str], None],
    begin: Callable[[str], None],
    tally: Tally,
) -> None:
    """Edit those of ``paths`` that the prepared folder ``target`` does not hold yet; failures do not stop the rest.

    Args:
        paths: image files, all in one folder.
        target: folder for the edited files, which keep their names.
        edit: edits one of them in a worker; its errors and warnings are reported.
        crew: the workers, which see the folders under the same names.
        tell: called with a sentence for every failure and warning, as they happen.
        begin: called with the name of every file that ended.
        tally: updated as each file ends, so that it is correct after an interrupt too.
    """
    names = {path.name for path in paths}
    remove_stale(target, names)
    jobs = [path for path in paths if not (target / path.name).exists()]
    tally.skipped += len(paths) - len(jobs)
    tally.left += len(jobs)
    if not jobs:
        return
    deaths = 0
    with (
        contextlib.ExitStack() as afterwards,
        worker_pool(replace(crew, number=min(crew.number, len(jobs)))) as pool,
        contextlib.closing(pool.outcomes(partial(_edit_file, edit, target), jobs)) as ended,
    ):
        afterwards.callback(remove_stale, target, names)  # of workers that were ended by an interrupt
        for path, outcome in ended:
            begin(path.name)
            tally.left -= 1
            deaths = deaths + 1 if outcome is None else 0
            if isinstance(outcome, list):
                tally.done += 1
                for note in outcome:
                    tell(f"note: {note}" if path.name in note else f"note: {path.name}: {note}")
                continue
            reason = DIED if outcome is None else outcome
            tally.failures[path.name] = reason
            tell(reason if path.name in reason else f"{path.name}: {reason}")
            if deaths >= DEATHS * pool.number:
                tell(f"{deaths} workers died one after the other; no other file is begun")
                return


def _edit_file(edit: Edit, target: Path, source: Path) -> Outcome:
    """Edit one file in a worker to a folder; return its notes and warnings or why it failed."""
    printed = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stderr(printed):
        warnings.simplefilter("always", UserWarning)
        try:
            edit(str(source), str(target / source.name))
        except Exception as error:
            return _sentence(error)
    notes = [line.removeprefix(NOTE) for line in printed.getvalue().splitlines() if line.startswith(NOTE)]
    return notes + [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]


def _sentence(error: Exception) -> str:
    """Why a file could not be edited."""
    if isinstance(error, ValueError | OSError | MemoryError):
        return " ".join(str(error).split())
    return " ".join(f"{type(error).__name__}: {error}".split())
