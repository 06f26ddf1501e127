"""Tiles worked out at once, each by a thread of its own: a tile's many short operations are not worth dividing."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Barrier
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """The function of every item, without gradients, in the order of the items, which are taken as they are needed.

    Args:
        function: to be called by several threads at once.
        items: of which one more is held than there are workers.
        workers: threads, which share those that torch has for an operation.
    """
    call = torch.no_grad()(function)
    if workers == 1:
        yield from map(call, items)
        return
    threads = torch.get_num_threads()
    started = Barrier(workers + 1)

    def start() -> None:
        torch.get_num_threads()  # the first call in a thread sets their number
        torch.set_num_threads(max(1, threads // workers))
        started.wait()

    with ThreadPoolExecutor(workers) as pool:
        for _ in range(workers):
            pool.submit(start)
        started.wait()
        torch.set_num_threads(threads)  # what threads to come begin with
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(call, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def alone(function: Callable[[], Result], workers: int) -> Result:
    """What a function of few pixels gives, by as many of torch's threads as one of the workers has.

    A second thread would wait, at full speed, most of the time.
    """
    return next(in_order(lambda call: call(), [function], workers))
