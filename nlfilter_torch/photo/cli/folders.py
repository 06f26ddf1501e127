"""A folder of photographs edited by worker processes: those of joblib on this machine, or those of a cluster.

Needs the ``cli`` extra, and ``cluster`` for a cluster. A file is done when the output folder has a file of
its name, since a name appears only when its file is complete
(:func:`~nlfilter_torch.photo.files.writing.open_beside`). An interrupted run continues when it is started again.
"""

import contextlib
import io
import json
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from nlfilter_torch.photo.cli.options import NOTE
from nlfilter_torch.photo.cli.workers import DEATHS, Workers, is_death, worker_pool
from nlfilter_torch.photo.files.formats import SUFFIXES
from nlfilter_torch.photo.files.writing import check_file, check_folder, open_beside, remove_stale

RECORD = ".nlfilter-batch.json"  # in the output folder: the settings of the files there
FRAMES_RECORD = ".nlfilter-frames.json"  # in that of ``frames``: the names of the files that it wrote there

DIED = "the process that worked on it died; use fewer --workers, so that each has more memory, or check the file"

Edit = Callable[[str, str], object]  # edits the file of the first name to that of the second; can be pickled
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


def pictures(folder: Path, what: str = "photographs") -> list[Path]:
    """The image files of a folder, by name, without hidden ones, such as those that macOS adds to every file.

    Raises:
        ValueError: if it is no folder, or has no image files; the message calls them ``what``.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; give the one that contains the {what}")
    paths = sorted(path for path in folder.iterdir() if is_picture(path))
    if not paths:
        raise ValueError(f"{folder} holds no PNG, JPEG, TIFF, WebP or AVIF file; put the {what} there")
    return paths


def is_picture(path: Path) -> bool:
    """Whether a path is an image file by its suffix, and not hidden."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()


def left_out(folder: Path) -> str:
    """Count the other files of a folder by suffix, such as ``3 .heic``; without hidden ones and settings (.json)."""
    suffixes = Counter(
        path.suffix.lower() or "without a suffix"
        for path in folder.iterdir()
        if path.is_file() and path.suffix.lower() not in {*SUFFIXES, ".json"} and not path.name.startswith(".")
    )
    return ", ".join(f"{count} {suffix}" for suffix, count in sorted(suffixes.items()))


def subfolders(folder: Path, target: Path) -> list[str]:
    """Names of the folders in a folder, without hidden ones and the folder ``target``."""
    inner = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [path.name for path in inner if path.resolve() != target.resolve()]


def prepare(paths: Sequence[Path], target: Path, settings: Mapping[str, object]) -> None:
    """Create the output folder, or check that an earlier run with the same settings began it.

    Raises:
        ValueError: if ``target`` is the folder of ``paths``, is no folder, or holds files of these names that were made
            with other settings or by another program.
        OSError: if it cannot be written to.
    """
    if target.resolve() == paths[0].parent.resolve():
        raise ValueError(f"{target} must be another folder than that of the photographs; name a new one")
    check_folder(target)
    target.mkdir(exist_ok=True)
    # Look for files first: another rank may be running, which writes the record before its first file.
    present = next((path.name for path in paths if (target / path.name).exists()), None)
    record, text = target / RECORD, json.dumps(settings, indent=2, sort_keys=True) + "\n"
    if record.exists():
        if record.read_text(encoding="utf-8") != text:
            raise ValueError(
                f"{target} contains results of other settings, listed in {record}; name a new folder, or empty this one"
            )
    elif present is not None:
        raise ValueError(_foreign(target, present))
    else:
        with open_beside(record) as stream:
            stream.write(text.encode())


def _foreign(target: Path, name: str) -> str:
    return f"{target} already contains {name}, which this command did not write; name a new folder"


def check_replaced(paths: Sequence[Path], target: Path) -> set[str]:
    """Check that ``frames`` may write files of these names; return the names of those that it wrote there before.

    Raises:
        ValueError: if ``target`` holds files of these names that other programs wrote, or links to ``paths``.
    """
    record, written = target / FRAMES_RECORD, set[str]()
    if record.exists():
        with contextlib.suppress(ValueError, TypeError):  # damaged
            written.update(json.loads(record.read_text(encoding="utf-8")))
    inputs = {path.resolve() for path in paths}
    for path in paths:
        place = target / path.name
        if place.is_symlink() and place.resolve() in inputs:
            raise ValueError(f"{place} is a link to {place.resolve()}, which is one of the frames; name a new folder")
        if place.exists() or place.is_symlink():
            if path.name not in written:
                raise ValueError(_foreign(target, path.name))
            check_file(place)
    return written


def record_written(target: Path, names: set[str]) -> None:
    """Record, for :func:`check_replaced`, the names that ``frames`` writes to a folder."""
    with open_beside(target / FRAMES_RECORD) as stream:
        stream.write((json.dumps(sorted(names), indent=2) + "\n").encode())


def edit_folder(
    paths: Sequence[Path],
    target: Path,
    edit: Edit,
    *,
    workers: int,
    threads: int,
    cluster: str | None = None,
    tell: Callable[[str], None],
    begin: Callable[[str], None],
    tally: Tally,
) -> None:
    """Edit those of ``paths`` that the prepared folder ``target`` does not hold yet; failures do not stop the rest.

    Args:
        paths: image files, all in one folder.
        target: folder for the edited files, which keep their names.
        edit: edits one of them in a worker; its errors and warnings are reported.
        workers: number of processes on this machine.
        threads: of each process.
        cluster: address of a cluster as in :func:`worker_pool`, whose workers see the folders under the same names.
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
        worker_pool(cluster, min(workers, len(jobs)), threads) as pool,
        contextlib.closing(_Work(target, edit, pool).outcomes(jobs)) as ended,
    ):
        afterwards.callback(remove_stale, target, names)  # of workers that were ended by an interrupt
        for path, outcome in ended:
            begin(path.name)
            tally.left -= 1
            deaths = deaths + 1 if outcome == DIED else 0
            if isinstance(outcome, list):
                tally.done += 1
                for note in outcome:
                    tell(f"note: {note}" if path.name in note else f"note: {path.name}: {note}")
                continue
            tally.failures[path.name] = outcome
            tell(outcome if path.name in outcome else f"{path.name}: {outcome}")
            if deaths >= DEATHS * pool.number:
                tell(f"{deaths} workers died one after the other; no other file is begun")
                return


@dataclass(frozen=True)
class _Work:
    """The same edit of several files by worker processes."""

    target: Path
    edit: Edit
    workers: Workers

    def outcomes(self, jobs: Sequence[Path]) -> Generator[tuple[Path, Outcome]]:
        """Yield each file with its outcome, as they end.

        When a worker dies, joblib ends the others, too. Files are begun in their order, so that one of the first that
        have not ended is the cause. Each of these is then worked on alone.
        """
        waiting = dict.fromkeys(jobs)
        while waiting:
            try:
                with contextlib.closing(self._run(list(waiting))) as ended:
                    for path, outcome in ended:
                        del waiting[path]
                        yield path, outcome
            except Exception as error:
                if not is_death(error):
                    raise
                for path in list(waiting)[: self.workers.number]:
                    del waiting[path]
                    yield self._alone(path)

    def _run(self, paths: Sequence[Path]) -> Generator[tuple[Path, Outcome]]:
        return self.workers.run([partial(_edit_file, self.edit, path, self.target / path.name) for path in paths])

    def _alone(self, path: Path) -> tuple[Path, Outcome]:
        """Edit a file while no worker works on another one."""
        if (self.target / path.name).exists():  # it had ended
            return path, []
        if self.workers.number > 1:
            try:
                (outcome,) = self._run([path])
            except Exception as error:
                if not is_death(error):
                    raise
            else:
                return outcome
        return path, DIED


def _edit_file(edit: Edit, source: Path, target: Path) -> tuple[Path, Outcome]:
    """Edit one file in a worker; return its name, and its notes and warnings or why it failed."""
    printed = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stderr(printed):
        warnings.simplefilter("always", UserWarning)
        try:
            edit(str(source), str(target))
        except Exception as error:
            return source, _sentence(error)
    notes = [line.removeprefix(NOTE) for line in printed.getvalue().splitlines() if line.startswith(NOTE)]
    return source, notes + [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]


def _sentence(error: Exception) -> str:
    """Why a file could not be edited."""
    if isinstance(error, ValueError | OSError | MemoryError):
        return " ".join(str(error).split())
    return " ".join(f"{type(error).__name__}: {error}".split())
