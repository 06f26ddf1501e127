"""Processes for tests of distributed code."""

import multiprocessing
from collections.abc import Callable

from torch.multiprocessing.spawn import start_processes


def run_ranks(work: Callable[..., None], arguments: tuple[object, ...], processes: int) -> None:
    """Run ``work(rank, *arguments)`` in several processes, and wait for them to end.

    They are forked from a process that has imported the modules, as the imports take longer than the work.
    """
    multiprocessing.set_forkserver_preload(["tests.core.test_communicator", "tests.themes.clients.test_fsdp"])
    start_processes(work, arguments, processes, start_method="forkserver")
