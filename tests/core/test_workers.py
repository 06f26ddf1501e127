"""Tiles in separate threads: torch's number of threads inside them, afterwards and elsewhere."""

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from nlfilter_torch.core.kernels import library
from nlfilter_torch.core.kernels.tall_skinny import moment, spread
from nlfilter_torch.core.workers import divided_among, in_order, single_threaded, threads_for


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(6)
    yield
    torch.set_num_threads(before)


def of_new_thread() -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


@pytest.mark.parametrize(("workers", "threads"), [(1, 6), (2, 3), (4, 1), (9, 1)])
def test_workers_share_the_threads_and_leave_those_of_others(workers: int, threads: int) -> None:
    results = in_order(lambda k: (k, torch.get_num_threads(), torch.is_grad_enabled()), range(20), workers)
    assert next(results) == (0, threads, False)
    assert (torch.get_num_threads(), of_new_thread()) == (6, 6)
    assert list(results) == [(k, threads, False) for k in range(1, 20)]
    assert (torch.get_num_threads(), of_new_thread()) == (6, 6)


def test_workers_may_not_divide_operations() -> None:
    assert list(in_order(lambda _: torch.get_num_threads(), range(3), 2, divided=False)) == [1, 1, 1]
    assert (torch.get_num_threads(), of_new_thread()) == (6, 6)


def test_one_worker_keeps_gradients_where_work_is_divided() -> None:
    kept = {workers: list(divided_among(workers, lambda _: torch.is_grad_enabled(), range(2))) for workers in (1, 2)}
    assert kept == {1: [True, True], 2: [False, False]}


def test_single_threaded_holds_for_the_calling_thread_and_its_workers() -> None:
    with single_threaded(2):
        assert (torch.get_num_threads(), of_new_thread()) == (1, 6)
        assert list(in_order(lambda _: torch.get_num_threads(), range(3), 2)) == [3, 3, 3]
        assert (torch.get_num_threads(), of_new_thread()) == (1, 6)
    assert (torch.get_num_threads(), of_new_thread()) == (6, 6)
    with single_threaded(1):  # no other work runs then
        assert torch.get_num_threads() == 6


class Watching(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return func(*args, **(kwargs or {}))


def test_threads_are_for_plain_operations_on_cpus_without_derivatives() -> None:
    plain, weight = torch.ones(2), torch.ones(2, requires_grad=True)
    assert threads_for(plain) == 6
    assert threads_for(plain, weight) == 1
    with torch.no_grad():
        assert threads_for(plain, weight) == 6
    assert threads_for(plain, torch.ones(2, device="meta")) == 1
    with torch.autocast("cpu"):
        assert threads_for(plain) == 1
    with Watching():
        assert threads_for(plain) == 1
    with torch.device("cpu"):
        assert threads_for(plain) == 1
    assert torch.func.vmap(lambda tensor: tensor * threads_for(plain))(plain).tolist() == [1, 1]
    assert threads_for(plain) == 6


@pytest.fixture
def own_threads() -> Iterator[None]:
    """Kernels on their own thread pool."""
    library.share_threads(library._library, None)
    yield
    library.share_threads(library._library, library._openmp())


@pytest.mark.skipif(not library.level, reason="this installation or processor has no kernels in C")
@pytest.mark.usefixtures("own_threads")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_the_pool_serves_several_callers_at_once_and_a_forked_process() -> None:
    factor = torch.randn(1, 20, 30_000, generator=torch.Generator().manual_seed(0))
    rows = torch.ones(1, 2, 20)
    with torch.no_grad():
        torch.set_num_threads(1)
        exact = spread(rows, factor)
        torch.set_num_threads(6)
        sums = moment(factor, exact)

        def many(_: int) -> bool:
            torch.set_num_threads(6)
            pairs = [(spread(rows, factor), moment(factor, exact)) for _ in range(20)]
            return all(torch.equal(first, exact) and torch.equal(second, sums) for first, second in pairs)

        with ThreadPoolExecutor(4) as callers:
            assert all(callers.map(many, range(8)))
        child = os.fork()
        if child == 0:
            signal.alarm(60)  # instead of hanging
            os._exit(0 if torch.equal(moment(factor, exact), sums) else 1)
        assert os.waitpid(child, 0)[1] == 0
