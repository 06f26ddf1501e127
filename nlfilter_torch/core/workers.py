"""Several tiles at once, each in its own thread: the short operations on a tile are not worth dividing among threads.

OpenMP divides every operation among threads that busy-wait for each other, so that most of the time is spent waiting if
another program is busy. Tiled edits and the denoiser therefore divide the picture among threads, not single operations.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier, Lock
from typing import TypeVar, TypeVarTuple

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import has_modes, is_hidden

Item = TypeVar("Item")
Result = TypeVar("Result")
Rest = TypeVarTuple("Rest")
_setting = Lock()  # torch's default for new threads is shared by the process, and is changed temporarily


def in_order(
    function: Callable[[Item, *Rest], Result],
    items: Iterable[Item],
    workers: int,
    *arguments: *Rest,
    divided: bool = True,
) -> Iterator[Result]:
    """Apply a function to items without gradients, and yield the results in order; items are consumed as needed.

    Args:
        function: called by several threads at once.
        items: up to twice as many as there are workers, plus one, are in memory at once, so that no worker waits for
            a slower one.
        workers: number of threads, which share torch's threads for operations; 1 runs in the calling thread.
        arguments: further ones of the function.
        divided: whether workers divide operations among several threads, if there are fewer workers than threads.
    """
    call = torch.no_grad()(function)
    if workers == 1:
        for item in items:
            yield call(item, *arguments)
        return
    started = Barrier(workers + 1)
    with ThreadPoolExecutor(workers) as pool:
        with _for_new_threads() as threads:
            for _ in range(workers):
                pool.submit(_begin, max(1, threads // workers) if divided else 1, started)
            started.wait()
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(call, item, *arguments))
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def divided_among(
    workers: int, function: Callable[[Item, *Rest], Result], items: Iterable[Item], *arguments: *Rest
) -> Iterator[Result]:
    """:func:`in_order`, but one worker keeps gradients."""
    if workers == 1:
        return (function(item, *arguments) for item in items)
    return in_order(function, items, workers, *arguments)


def threads_for(*tensors: Tensor) -> int:
    """Number of threads that may compute parts of a result from these tensors, each by itself: for :func:`in_order`.

    As many as an operation is divided among, but 1 for derivatives, on accelerators, and where a mode of torch that
    holds for the calling thread alone may change results.
    """
    differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if differentiable or has_modes() or any(map(is_hidden, tensors)):
        return 1
    return torch.get_num_threads()


def _begin(threads: int, started: Barrier) -> None:
    """Set the number of threads among which a new worker divides an operation, and wait for the other workers."""
    torch.get_num_threads()  # the first call in a thread sets their number
    torch.set_num_threads(threads)
    started.wait()


@contextmanager
def single_threaded(workers: int) -> Iterator[None]:
    """Keep the calling thread from dividing operations among threads, if there are several workers.

    Other threads still divide their operations.
    """
    before = torch.get_num_threads()
    if workers == 1 or before == 1:
        yield
        return
    with _for_new_threads():
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _for_new_threads() -> Iterator[int]:
    """Yield the number of threads that an operation in a new thread is divided among, and restore it afterwards.

    Torch has a number for each thread; a new thread begins with the number that was last set in any thread.
    """
    with _setting, ThreadPoolExecutor(1) as another:
        threads = another.submit(torch.get_num_threads).result()
        try:
            yield threads
        finally:
            another.submit(torch.set_num_threads, threads).result()
