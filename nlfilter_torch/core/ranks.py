"""The processes of one command on several machines, as ``torchrun`` starts them: who does what, and how it ended."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch.distributed as dist

T = TypeVar("T")

MEETING = timedelta(minutes=5)  # for all ranks to be there
WORKING = timedelta(days=30)  # for all ranks to end; one that dies is noticed at once
ANSWERING = timedelta(seconds=10)  # for the ranks that are left to say so


@dataclass(frozen=True)
class Ranks:
    """This process among those of the same command.

    Attributes:
        rank: its number, from 0.
        size: how many there are.
        local: how many of them share this machine.
        group: through which they are connected, or None.
    """

    rank: int = 0
    size: int = 1
    local: int = 1
    group: Any = None

    def share(self, items: list[T]) -> list[T]:
        """This rank's part of what all of them are to do: no item is in two parts.

        >>> Ranks(1, 3).share(list("abcdefg"))
        ['b', 'e']
        """
        return items[self.rank :: self.size]

    def gather(self, item: T) -> list[T]:
        """The items of all ranks, as soon as the last of them is here; without a connection, this rank's own.

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
    """Which ranks of a group are gone, in words, after an exchange between them failed; within :data:`ANSWERING`.

    The ranks that are there all see the exchange fail, and leave a note in the store through which they once met.
    """
    ranks = dist.get_process_group_ranks(group)
    notes = {rank: f"nlfilter/{group.group_name}/{rank} is here" for rank in ranks}
    try:
        store = dist.distributed_c10d._get_default_store()
        store.set(notes[dist.get_rank()], "")
        with suppress(RuntimeError):  # DistStoreError, where some are missing
            store.wait(list(notes.values()), ANSWERING)
        missing = [str(rank) for rank, note in notes.items() if not store.check([note])]
    except RuntimeError:  # the store went with the rank that held it
        return "rank 0, or the process in which the ranks had met, died"
    if not missing:
        return "the connection between ranks broke, though all of them are alive"
    return f"rank{'s' * (len(missing) > 1)} {', '.join(missing)} of {len(ranks)} died or did not answer"


@contextmanager
def connected_ranks() -> Iterator[Ranks]:
    """The ranks that ``RANK`` and ``WORLD_SIZE`` tell of, connected where ``MASTER_ADDR`` tells how.

    Raises:
        ValueError: if these are no such numbers.
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
