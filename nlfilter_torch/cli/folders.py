"""A folder of photographs edited by worker processes, on one machine or, by their ranks, on several.

Needs the ``cli`` extra. A file is done when the output folder has a file of its name, since a name appears only when
its file is complete (:func:`~nlfilter_torch.io.photographs.open_beside`). An interrupted run continues when it is
started again.
"""

import contextlib
import io
import json
import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from queue import LifoQueue

import torch

from nlfilter_torch.io.photographs import SUFFIXES, check_folder, open_beside, remove_stale

RECORD = ".nlfilter-batch.json"  # in the output folder: the settings of the files there
DEATHS = 3  # per worker and in a row: after so many deaths the cause is not in the files

Edit = Callable[[str, str], object]  # from the name of the input to that of the output; can be pickled


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

    def add(self, other: "Tally") -> None:
        """Add the files of another tally."""
        self.done += other.done
        self.skipped += other.skipped
        self.failures |= other.failures
        self.left += other.left


def pictures(folder: Path, what: str = "photographs") -> list[Path]:
    """The image files of a folder, by name.

    Raises:
        ValueError: if it is no folder, or has no image files; the message calls them ``what``.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder; name the one that holds the {what}")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    if not paths:
        raise ValueError(f"{folder} holds no PNG, JPEG, TIFF, WebP or AVIF file; put the {what} there")
    return paths


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
                f"{target} was begun with other settings, which {record} tells; name a new folder, or empty this one"
            )
    elif present is not None:
        raise ValueError(f"{target} holds a file {present} from somewhere else; name a new folder")
    else:
        with open_beside(record) as stream:
            stream.write(text.encode())


def edit_folder(
    paths: Sequence[Path],
    target: Path,
    edit: Edit,
    *,
    workers: int,
    threads: int,
    tell: Callable[[str], None],
    begin: Callable[[str], None],
    tally: Tally,
) -> None:
    """Edit those of ``paths`` that the prepared folder ``target`` does not hold yet; failures do not stop the rest.

    Args:
        paths: image files, all in one folder.
        target: folder for the edited files, which keep their names.
        edit: edits one of them in a worker; its errors and warnings are reported.
        workers: number of processes.
        threads: of each process.
        tell: called with a sentence for every failure and warning, as they happen.
        begin: called with the name of every file that ended.
        tally: updated as each file ends, so that it is correct after an interrupt too.
    """
    remove_stale(target, {path.name for path in paths})
    jobs = [path for path in paths if not (target / path.name).exists()]
    tally.skipped += len(paths) - len(jobs)
    tally.left += len(jobs)
    deaths = 0
    with contextlib.closing(_outcomes(jobs, target, edit, workers=min(workers, len(jobs)), threads=threads)) as ended:
        for path, outcome in ended:
            begin(path.name)
            tally.left -= 1
            deaths = deaths + 1 if isinstance(outcome, BrokenProcessPool) else 0
            if isinstance(outcome, list):
                tally.done += 1
                for note in outcome:
                    tell(f"note: {path.name}: {note}")
                continue
            sentence = _sentence(outcome)
            tally.failures[path.name] = sentence
            tell(sentence if path.name in sentence else f"{path.name}: {sentence}")
            if deaths >= DEATHS * workers:
                tell(f"{deaths} workers died one after the other; no other file is begun")
                return


def _outcomes(
    jobs: Sequence[Path], target: Path, edit: Edit, *, workers: int, threads: int
) -> Generator[tuple[Path, list[str] | Exception]]:
    """Each job with its warnings or its error, as they end.

    Every worker is a pool of its own: when one dies, its file is known and the others continue.
    """

    def hire() -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=(threads,))

    idle: LifoQueue[ProcessPoolExecutor] = LifoQueue()
    for _ in range(workers):
        idle.put(hire())

    def run(path: Path) -> list[str]:
        worker = idle.get()
        try:
            return worker.submit(_work, edit, str(path), str(target / path.name)).result()
        except BrokenProcessPool:
            worker.shutdown()
            worker = hire()
            raise
        finally:
            idle.put(worker)

    lanes = ThreadPoolExecutor(max(workers, 1))
    try:
        futures: dict[Future[list[str]], Path] = {lanes.submit(run, path): path for path in jobs}
        for future in as_completed(futures):
            error = future.exception()
            if error is not None and not isinstance(error, Exception):
                raise error
            yield futures[future], future.result() if error is None else error
    finally:
        lanes.shutdown(cancel_futures=True)  # files that were begun are finished
        while not idle.empty():
            idle.get().shutdown()


def _begin(threads: int) -> None:
    """Initialise a worker."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the main process handles them
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    torch.set_num_threads(threads)
    # An idle worker would not notice that the main process was killed, and would wait for ever.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(edit: Edit, source: str, target: str) -> list[str]:
    """Edit one file in a worker; return its warnings."""
    with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stderr(io.StringIO()):
        warnings.simplefilter("always", UserWarning)
        edit(source, target)
    return [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]


def _sentence(error: Exception) -> str:
    """Why a file could not be edited."""
    if isinstance(error, BrokenProcessPool):
        return "the process that worked on it died; give it more memory, by fewer --workers, or look at the file"
    if isinstance(error, ValueError | OSError | MemoryError):
        return " ".join(str(error).split())
    return " ".join(f"{type(error).__name__}: {error}".split())
