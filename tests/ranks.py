"""Processes for tests of distributed code, and of commands that are interrupted."""

import multiprocessing
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess

from torch.multiprocessing.spawn import start_processes

PRELOADED = ["tests.core.test_communicator", "tests.themes.clients.test_fsdp", "tests.themes.test_cli_by_rows"]


def run_ranks(work: Callable[..., None], arguments: tuple[object, ...], processes: int) -> None:
    """Run ``work(rank, *arguments)`` in several processes, and wait for them to end.

    They are forked from a process that has imported the modules, as the imports take longer than the work.
    """
    multiprocessing.set_forkserver_preload(PRELOADED)
    start_processes(work, arguments, processes, start_method="forkserver")


def forked(work: Callable[..., object], arguments: Sequence[object]) -> BaseProcess:
    """Start a process that runs ``work(*arguments)``, forked from the same process."""
    multiprocessing.set_forkserver_preload(PRELOADED)
    process = multiprocessing.get_context("forkserver").Process(target=work, args=tuple(arguments))
    process.start()
    return process
