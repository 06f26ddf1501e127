"""Worker processes: those of joblib on this machine, or those of a cluster.

A worker begins by importing this module, which therefore imports nothing that takes time.
"""

import contextlib
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

import psutil

CONNECTING = 30  # seconds for a cluster to answer
LOOK_PAUSE = 0.5  # seconds between two looks at the main process

Key = TypeVar("Key")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Crew:
    """Worker processes of joblib.

    Attributes:
        number: of processes; those of a cluster are counted when it answers.
        threads: of each of these on this machine.
        cluster: address of the scheduler of a Dask cluster, whose workers have one thread each; None is this machine.
    """

    number: int
    threads: int = 1
    cluster: str | None = None

    def outcomes(self, work: Callable[[Key], Result], keys: Iterable[Key]) -> Generator[tuple[Key, Result | None]]:
        """Yield each key with what the work on it returns, as it ends; None if workers die of it.

        When a worker dies, joblib ends the others, too. Work is begun in the order of keys, so that one of the first
        that have not ended is the cause. Each of these is then begun once more while no worker does anything else.
        """
        waiting = dict.fromkeys(keys)
        while waiting:
            try:
                with contextlib.closing(self._done(work, list(waiting))) as ended:
                    for key, result in ended:
                        del waiting[key]
                        yield key, result
            except Exception as error:
                if not _is_death(error):
                    raise
                for key in list(waiting)[: self.number]:
                    del waiting[key]
                    yield key, self._alone(work, key)

    def _alone(self, work: Callable[[Key], Result], key: Key) -> Result | None:
        try:
            ((_, result),) = self._done(work, [key])
        except Exception as error:
            if not _is_death(error):
                raise
            return None
        return result

    def _done(self, work: Callable[[Key], Result], keys: list[Key]) -> Generator[tuple[Key, Result]]:
        """Keys and results of work, as it ends."""
        from joblib import Parallel, delayed

        parallel = Parallel(return_as="generator_unordered", pre_dispatch=self.number, batch_size=1)
        yield from parallel([delayed(_with_key)(work, key) for key in keys])


def _with_key(work: Callable[[Key], Result], key: Key) -> tuple[Key, Result]:
    return key, work(key)


@contextlib.contextmanager
def worker_pool(crew: Crew) -> Iterator[Crew]:
    """Have joblib work in processes of this machine, or in those of a cluster; yield these.

    Raises:
        ValueError: if there is no cluster at that address.
    """
    if crew.cluster is None:
        yield from _of_this_machine(crew)
    else:
        yield from _of_dask(crew.cluster)


def _of_this_machine(crew: Crew) -> Iterator[Crew]:
    import joblib
    from joblib.externals.loky import get_reusable_executor

    # With a single worker, joblib would work in this process, which must outlive the work; a second one stays idle.
    done = False
    try:
        with (
            joblib.parallel_config(
                "loky",
                n_jobs=max(2, crew.number),
                inner_max_num_threads=crew.threads,
                initializer=be_worker,
                initargs=(os.getpid(),),
            ),
            warnings.catch_warnings(),
        ):
            warnings.filterwarnings("ignore", "A worker stopped")  # joblib replaces those that grew by 300 MB
            yield crew
        done = True
    finally:
        # After an interrupt, which reaches us as other errors too, workers would go on, and be waited for.
        get_reusable_executor().shutdown(kill_workers=not done)


def _of_dask(address: str) -> Iterator[Crew]:
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
        yield Crew(joblib.effective_n_jobs(), cluster=address)


def _is_death(error: Exception) -> bool:
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
        time.sleep(LOOK_PAUSE)
    os._exit(1)
