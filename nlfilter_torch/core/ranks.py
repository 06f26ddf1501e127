"""The processes of one command on one or more machines, as ``torchrun`` starts them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch.distributed as dist

T = TypeVar("T")

MEETING = timedelta(minutes=5)  # for all ranks to connect
WORKING = timedelta(days=30)  # for all ranks to finish; one that dies is noticed at once
ANSWERING = timedelta(seconds=10)  # for the remaining ranks to say that they are alive


@dataclass(frozen=True)
class Ranks:
    """This process among those of the same command.

    Attributes:
        rank: number of this process, from 0.
        size: number of processes.
        local: number of processes on this machine.
        group: the process group that connects them, or None.
    """

    rank: int = 0
    size: int = 1
    local: int = 1
    group: Any = None

    def share(self, items: list[T]) -> list[T]:
        """This rank's part of the items; each item is in the part of one rank.

        >>> Ranks(1, 3).share(list("abcdefg"))
        ['b', 'e']
        """
        return items[self.rank :: self.size]

    def all_gather(self, item: T) -> list[T]:
        """The items of all ranks, once every rank has called this; without a connection, only the item of this rank.

        Raises:
            OSError: if a rank is gone.
        """
        if self.group is None:
            return [item]
        items: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(items, item, group=self.group)
        except RuntimeError as error:
            raise OSError(f"{name_the_missing(self.group)}; start the same command again to do the rest") from error
        return items


def name_the_missing(group: Any) -> str:
    """Name the ranks of a group that are gone, after a call between them failed; takes at most :data:`ANSWERING`.

    The call fails on all remaining ranks. Each of them sets a key in the store that connected the group.
    """
    ranks = dist.get_process_group_ranks(group)
    keys = {rank: f"nlfilter/{group.group_name}/{rank} is here" for rank in ranks}
    try:
        store = dist.distributed_c10d._get_default_store()
        store.set(keys[dist.get_rank()], "")
        with suppress(RuntimeError):  # DistStoreError, where some are missing
            store.wait(list(keys.values()), ANSWERING)
        missing = [str(rank) for rank, key in keys.items() if not store.check([key])]
    except RuntimeError:  # the store ends with the process that holds it
        return "rank 0, or the process in which the ranks had met, died"
    if not missing:
        return "the connection between ranks broke, though all of them are alive"
    return f"rank{'s' * (len(missing) > 1)} {', '.join(missing)} of {len(ranks)} died or did not answer"


@contextmanager
def connected_ranks() -> Iterator[Ranks]:
    """The ranks that the environment variables ``RANK`` and ``WORLD_SIZE`` give, connected if ``MASTER_ADDR`` is set.

    Raises:
        ValueError: if ``RANK`` and ``WORLD_SIZE`` are not numbers, or ``RANK`` is not below ``WORLD_SIZE``.
    """
    numbers = {name: os.environ.get(name, default) for name, default in (("RANK", "0"), ("WORLD_SIZE", "1"))}
    local = os.environ.get("LOCAL_WORLD_SIZE", "1")
    if not all(text.isdecimal() for text in (*numbers.values(), local)) or not int(local):
        raise ValueError(f"RANK and WORLD_SIZE must be numbers, got {numbers}; unset them, or start with torchrun")
    rank, size = int(numbers["RANK"]), int(numbers["WORLD_SIZE"])
    if rank >= size:
        raise ValueError(f"RANK must be below WORLD_SIZE, {size}, got {rank}; unset them, or start with torchrun")
    if size == 1 or "MASTER_ADDR" not in os.environ:
        yield Ranks(rank, size, int(local))
        return
    dist.init_process_group("gloo", timeout=MEETING)
    try:
        yield Ranks(rank, size, int(local), dist.new_group(timeout=WORKING))
    finally:
        dist.destroy_process_group()
