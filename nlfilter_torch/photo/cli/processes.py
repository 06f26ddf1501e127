"""Tiles computed by worker processes, which write them to a zarr array: the last part of an edit of a large picture.

The edit is fitted in one process. The result, a :class:`~nlfilter_torch.photo.picture.tiles.Tiling`, is written to a
file in the folder of the new array. A worker reads it, opens the picture and the array, computes some rows, and writes
the chunks that they make up. If a worker dies, another one computes its rows again. Workers need to see the folders
under the same names; pixels do not pass through the process that fits.
"""

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import gettempdir

from nlfilter_torch.photo.cli.workers import Crew, worker_pool
from nlfilter_torch.photo.declared.rows import RowSource
from nlfilter_torch.photo.files.rows import ZarrRows, write_band, zarr_package
from nlfilter_torch.photo.files.writing import claimed, part_beside
from nlfilter_torch.photo.picture.tiles import Comparison, Tiling

TASK_PIXELS = 1 << 20  # that a worker computes before it is given others, if there are enough of them
TASKS = 4  # per worker at least, so that they end at about the same time
STEP_ROWS = 32  # rows of a chunk of an array between two steps
JOB = "tiling.pickle"  # in the folder of an array that is being written


@dataclass(frozen=True)
class ZarrProcesses:
    """Worker processes that compute tiles.

    Attributes:
        crew: these processes.
    """

    crew: Crew

    @property
    def on_this_machine(self) -> int:
        """Number of processes that share the memory of this machine."""
        return self.crew.number if self.crew.cluster is None else 0

    def fill(self, tiling: Tiling, path: Path) -> None:
        """Compute rows and write them to the zarr array in a folder.

        Raises:
            ChildProcessError: if workers keep dying.
        """
        import cloudpickle

        tiling.part(0, 1)  # computes what is computed once, such as sums over the picture
        path = path.absolute()
        with (path / JOB).open("wb") as stream:
            cloudpickle.dump(tiling, stream)
        height, chunk = tiling.picture.size[0], zarr_package().open_array(path, mode="r").chunks[0]
        shares = min(TASK_PIXELS // (chunk * tiling.picture.size[1]), height // (chunk * TASKS * self.crew.number))
        rows = chunk * max(1, shares)
        done, report = 0, tiling.passes.report
        report(tiling.stage, 0, height)
        parts = [range(start, min(start + rows, height)) for start in range(0, height, rows)]
        for part, comparisons in self.crew.outcomes(partial(compute, path), parts):
            if comparisons is None:
                raise ChildProcessError(
                    f"the processes that worked on the rows from {part.start} on died, one after the other; leave them "
                    "more memory, by fewer --workers or a smaller --memory"
                )
            done += len(part)
            report(tiling.stage, done, height)
            tiling.note(comparisons)
        (path / JOB).unlink()

    @contextmanager
    def stored(self, tiling: Tiling, folder: Path | None) -> Iterator[RowSource]:
        """Compute rows and store them in a temporary array in a folder that the workers see."""
        values, _ = tiling.part(0, 1)
        height, width = tiling.picture.size
        with part_beside((folder or Path(gettempdir())) / "steps.zarr") as beside:
            zarr_package().create_array(
                store=beside,
                shape=(height, width, values.shape[2]),
                chunks=(min(STEP_ROWS, height), width, values.shape[2]),
                dtype=values.dtype,
                compressors=None,
            )
            with claimed(beside):
                self.fill(tiling, beside)
                yield ZarrRows(beside)


def compute(path: Path, rows: range) -> list[Comparison]:
    """Compute a range of rows and write it to the array in a folder, chunk by chunk; runs in a worker."""
    if not (path / JOB).exists():
        raise ValueError(
            f"{path.parent} must be seen by all workers under this name, but one of them finds no file {JOB} there; "
            "share the folder"
        )
    with (path / JOB).open("rb") as stream:
        tiling: Tiling = pickle.load(stream)
    array, comparisons = zarr_package().open_array(path, mode="r+"), list[Comparison]()
    for start in range(rows.start, rows.stop, array.chunks[0]):
        values, part_comparisons = tiling.part(start, min(start + array.chunks[0], rows.stop))
        write_band(array, start, values)
        comparisons += part_comparisons
    return comparisons


@contextmanager
def zarr_processes(workers: int | None, cluster: str | None) -> Iterator[ZarrProcesses | None]:
    """So many processes on this machine, or those of a cluster; None if neither is asked for."""
    if workers is None and cluster is None:
        yield None
        return
    with worker_pool(Crew(workers or 1, cluster=cluster)) as crew:
        yield ZarrProcesses(crew)
