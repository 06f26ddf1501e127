"""Tiles worked out at once, each by a thread of its own: a tile's many short operations are not worth dividing.

OpenMP divides each operation anew, and its threads wait for each other at full speed: beside another busy program most
of the time goes into that. Tiled work therefore divides pictures, not operations.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier, Lock
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")
_setting = Lock()  # what torch begins new threads with is for all of a process, and is changed for a moment


def in_order(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """The function of every item, without gradients, in the order of the items, which are taken as they are needed.

    Args:
        function: to be called by several threads at once.
        items: of which one more is held than there are workers.
        workers: threads, which share those that torch has for an operation; a single one is the calling thread.
    """
    call = torch.no_grad()(function)
    if workers == 1:
        yield from map(call, items)
        return
    started = Barrier(workers + 1)

    def start(threads: int) -> None:
        torch.get_num_threads()  # the first call in a thread sets their number
        torch.set_num_threads(max(1, threads // workers))
        started.wait()

    with ThreadPoolExecutor(workers) as pool:
        with _for_some_threads() as threads:
            for _ in range(workers):
                pool.submit(start, threads)
            started.wait()
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(call, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


@contextmanager
def undivided(workers: int) -> Iterator[None]:
    """Have the calling thread not divide operations, where workers divide the picture; other threads still do."""
    before = torch.get_num_threads()
    if workers == 1 or before == 1:
        yield
        return
    with _for_some_threads():
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _for_some_threads() -> Iterator[int]:
    """Gives the number of threads that new ones divide an operation among, and keeps it from being changed inside.

    Torch keeps a number for each thread, and the last that was set for threads to come.
    """
    with _setting, ThreadPoolExecutor(1) as another:
        threads = another.submit(torch.get_num_threads).result()
        try:
            yield threads
        finally:
            another.submit(torch.set_num_threads, threads).result()
