"""Worker processes: those of joblib on this machine, or those of a cluster.

A worker begins by importing this module, which therefore imports nothing that takes time.
"""

import contextlib
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

import psutil

CONNECTING = 30  # seconds for a cluster to answer
DEATHS = 3  # per worker and in a row: after so many deaths the cause is not in the work
PAUSE = 0.5  # seconds between two looks at the main process

Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """Worker processes of joblib; ``number`` is how many there are."""

    number: int

    def run(self, calls: Sequence[Callable[[], Result]]) -> Generator[Result]:
        """Results of calls in the workers, as they end; calls begin in their order."""
        from joblib import Parallel, delayed

        parallel = Parallel(return_as="generator_unordered", pre_dispatch=self.number, batch_size=1)
        yield from parallel([delayed(call)() for call in calls])


@contextlib.contextmanager
def worker_pool(cluster: str | None, workers: int, threads: int) -> Iterator[Workers]:
    """Have joblib work in processes of this machine, or in those of a cluster.

    Args:
        cluster: address of the scheduler of a Dask cluster, whose workers have one thread each; None is this machine.
        workers: number of processes on this machine.
        threads: of each of these.

    Raises:
        ValueError: if there is no cluster at that address.
    """
    if cluster is None:
        yield from _of_this_machine(workers, threads)
    else:
        yield from _of_dask(cluster)


def _of_this_machine(workers: int, threads: int) -> Iterator[Workers]:
    import joblib
    from joblib.externals.loky import get_reusable_executor

    # With a single worker, joblib would work in this process, which must outlive the work; a second one stays idle.
    done = False
    try:
        with (
            joblib.parallel_config(
                "loky",
                n_jobs=max(2, workers),
                inner_max_num_threads=threads,
                initializer=be_worker,
                initargs=(os.getpid(),),
            ),
            warnings.catch_warnings(),
        ):
            warnings.filterwarnings("ignore", "A worker stopped")  # joblib replaces those that grew by 300 MB
            yield Workers(workers)
        done = True
    finally:
        # After an interrupt, which reaches us as other errors too, workers would go on, and be waited for.
        get_reusable_executor().shutdown(kill_workers=not done)


def _of_dask(address: str) -> Iterator[Workers]:
    import joblib

    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError("--cluster needs the extra cluster; install nlfilter-torch[cluster]") from error
    try:
        client = Client(address, timeout=CONNECTING)
    except (OSError, ValueError) as error:
        raise ValueError(f"--cluster must be the address of a Dask scheduler, got {address}; {error}") from error
    with client, joblib.parallel_config("dask", client=client, wait_for_workers_timeout=CONNECTING):
        yield Workers(joblib.effective_n_jobs())


def is_death(error: Exception) -> bool:
    """Whether an error means that a worker died; Dask tries a task on several workers before it says so."""
    return isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker"


def be_worker(parent: int) -> None:
    """Leave signals to the process of number ``parent``, and end when it does."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    # A worker would not notice that the main process was killed, and would wait for ever.
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent and psutil.pid_exists(parent):  # the first on POSIX, the second on Windows
        time.sleep(PAUSE)
    os._exit(1)
