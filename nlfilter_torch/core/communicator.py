"""One image whose rows of pixels are spread over the ranks of a process group of :mod:`torch.distributed`.

All that links pixels are sums over them: M-vectors, M x M matrices and the patches that landmarks are made of. Each
rank computes with its own rows as if they were all, and what would be such a sum goes through :func:`reduce_sum`; the
rows that patches at a border reach into come from the neighbours, by :func:`with_halo`. Nothing that is sent grows with
the height of the image.

Gradients: the loss is the sum of what every rank's ``backward`` starts from. What all ranks hold alike (landmarks,
sums) collects on each of them the part that its own rows contribute; the backward pass of a sum over ranks adds these
parts up, and so does that of :func:`replicate`, through which parameters come in.

The processes of one command on several machines, as ``torchrun`` starts them: who does what, and how it ended.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from itertools import accumulate
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from nlfilter_torch.core.autograd import Gradients, once_differentiable


@dataclass(frozen=True, eq=False)
class Shard:
    """This rank's part of an image.

    Attributes:
        group: the process group.
        rows: how many rows each rank has, from the top of the image down.
        width: of the image.
    """

    group: Any
    rows: tuple[int, ...]
    width: int

    @property
    def rank(self) -> int:
        """This process among those of the group."""
        return dist.get_rank(self.group)

    @property
    def height(self) -> int:
        """Rows of the whole image."""
        return sum(self.rows)

    @property
    def first(self) -> int:
        """Row of the whole image that is the first one here."""
        return sum(self.rows[: self.rank])

    @property
    def pixels(self) -> int:
        """Pixels of the whole image."""
        return self.height * self.width

    def peer(self, rank: int) -> int:
        """What the whole world calls rank ``rank`` of the group."""
        return dist.get_global_rank(self.group, rank)


def meet(guide: Tensor, group: Any) -> Shard | None:
    """Tell the other ranks of the rows (B, C, H, W) that are here.

    Raises:
        TypeError: if ``group`` is no process group that this process belongs to.
        ValueError: if the guides differ in more than their number of rows.
    """
    check_group(group)
    if group is None:
        return None
    batch, channels, height, width = guide.shape
    own = [height, batch, channels, width, torch.finfo(guide.dtype).bits]
    shapes = [part.tolist() for part in _gather(torch.tensor(own, device=guide.device), group)]
    for rank, shape in enumerate(shapes):
        if shape[1:] != shapes[0][1:]:
            raise ValueError(
                f"guide must have the batch, channels, width and dtype of the other ranks' rows, {shapes[0][1:]} on "
                f"rank 0, got {shape[1:]} on rank {rank}; cut one image into rows"
            )
    return Shard(group, tuple(shape[0] for shape in shapes), width)


def check_group(group: Any) -> None:
    """Raise TypeError unless ``group`` is None or a process group that this process belongs to."""
    if group is None:
        return
    if not dist.is_available() or not isinstance(group, dist.ProcessGroup):
        raise TypeError(
            f"group must be a process group of torch.distributed with this process in it, got {type(group).__name__}; "
            "pass torch.distributed.group.WORLD after torch.distributed.init_process_group"
        )


def reduce_sum(tensor: Tensor, shard: Shard | None) -> Tensor:
    """The sum of what the ranks hold, on all of them; differentiable any number of times. Without a shard, itself."""
    if shard is None:
        return tensor
    total: Tensor = _Sum.apply(tensor, shard.group)  # type: ignore[no-untyped-call]
    return total


def reduce_max(tensor: Tensor, shard: Shard | None) -> Tensor:
    """The elementwise maximum over the ranks, without a gradient. Without a shard, the tensor itself."""
    if shard is None:
        return tensor
    largest = tensor.detach().clone(memory_format=torch.contiguous_format)
    _together(lambda: dist.all_reduce(largest, op=dist.ReduceOp.MAX, group=shard.group), shard.group)
    return largest


def replicate(value: Any, shard: Shard | None) -> Any:
    """A parameter that all ranks hold alike: its gradient is the sum of what the ranks' rows contribute, on each.

    Anything but a tensor is left as it is.
    """
    if shard is None or not isinstance(value, Tensor):
        return value
    return _Replica.apply(value, shard.group)  # type: ignore[no-untyped-call]


def from_first(tensor: Tensor, shard: Shard | None) -> Tensor:
    """What the first rank holds, on all of them; for choices. Without a shard, the tensor itself."""
    if shard is None:
        return tensor
    chosen = tensor.detach().to(_device(shard.group)).clone(memory_format=torch.contiguous_format)
    _together(lambda: dist.broadcast(chosen, src=shard.peer(0), group=shard.group), shard.group)
    return chosen.to(tensor.device)


def gather_columns(features: Tensor, indices: Tensor, shard: Shard | None) -> Tensor:
    """Columns (B, D, S) of the features (B, D, N), wherever they are, by their pixels' indices in the whole image."""
    # Under one index for all planes torch gathers on all cores, and selects on one.
    batch, size, _ = features.shape
    if shard is None:
        return features.gather(2, indices.expand(batch, size, -1))
    local = indices - shard.first * shard.width
    here = (local >= 0) & (local < features.shape[2])
    columns = features.gather(2, local.clamp(0, features.shape[2] - 1).expand(batch, size, -1))
    return reduce_sum(torch.where(here, columns, torch.zeros_like(columns)), shard)


def with_halo(guide: Tensor, margin: int, shard: Shard | None) -> tuple[Tensor, tuple[int, int]]:
    """The rows (B, C, H, W) with as many of the neighbours' above and below as patches reach into; differentiable.

    Returns:
        The rows, and how many were added above and below: ``margin``, or as many as the image has there.
    """
    if shard is None or margin == 0:
        return guide, (0, 0)
    first, last = shard.first, shard.first + shard.rows[shard.rank]
    extended: Tensor = _Halo.apply(guide, margin, shard)  # type: ignore[no-untyped-call]
    return extended, (min(margin, first), min(margin, shard.height - last))


def check_whole(shard: Shard | None, what: str) -> None:
    """Raise if there is a shard, for what has no form for one."""
    if shard is not None:
        raise ValueError(
            f"{what} needs the whole image on one rank, got one that is spread over {len(shard.rows)}; "
            "build the operator without a group"
        )


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, group: Any) -> Tensor:
        ctx.group = group
        total = tensor.clone(memory_format=torch.contiguous_format)
        _together(lambda: dist.all_reduce(total, group=group), group)
        return total

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Sum.apply(grad, ctx.group), None  # type: ignore[no-untyped-call]


class _Replica(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, group: Any) -> Tensor:
        ctx.group = group
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Sum.apply(grad, ctx.group), None  # type: ignore[no-untyped-call]


class _Halo(torch.autograd.Function):
    """Every rank needs the rows ``margin`` beyond its own; ranks may have fewer rows than that."""

    @staticmethod
    def forward(ctx: Any, guide: Tensor, margin: int, shard: Shard) -> Tensor:
        ctx.margin, ctx.shard = margin, shard
        wanted, lent = _overlaps(shard, margin)
        base = max(0, shard.first - margin)
        height = min(shard.height, shard.first + guide.shape[2] + margin) - base
        extended = guide.new_empty(*guide.shape[:2], height, guide.shape[3])
        extended[:, :, shard.first - base : shard.first - base + guide.shape[2]] = guide
        sent = {peer: guide[:, :, rows.start - shard.first : rows.stop - shard.first] for peer, rows in lent.items()}
        shapes = {peer: rows.stop - rows.start for peer, rows in wanted.items()}
        for peer, rows in _swap(sent, shapes, guide, shard).items():
            extended[:, :, wanted[peer].start - base : wanted[peer].stop - base] = rows
        return extended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        shard: Shard = ctx.shard
        wanted, lent = _overlaps(shard, ctx.margin)
        base = max(0, shard.first - ctx.margin)
        own = grad[:, :, shard.first - base : shard.first - base + shard.rows[shard.rank]].clone()
        sent = {peer: grad[:, :, rows.start - base : rows.stop - base] for peer, rows in wanted.items()}
        shapes = {peer: rows.stop - rows.start for peer, rows in lent.items()}
        for peer, rows in _swap(sent, shapes, grad, shard).items():
            own[:, :, lent[peer].start - shard.first : lent[peer].stop - shard.first] += rows
        return own, None, None


def _overlaps(shard: Shard, margin: int) -> tuple[dict[int, slice], dict[int, slice]]:
    """Rows of other ranks that are needed here, and rows from here that others need, by rank."""
    ends = list(accumulate(shard.rows))
    owned = [range(end - rows, end) for end, rows in zip(ends, shard.rows, strict=True)]
    needed = [range(max(0, rows.start - margin), min(ends[-1], rows.stop + margin)) for rows in owned]

    def common(one: range, other: range) -> slice:
        return slice(max(one.start, other.start), min(one.stop, other.stop))

    here = shard.rank
    wanted: dict[int, slice] = {}
    lent: dict[int, slice] = {}
    for peer in range(len(owned)):
        for table, rows in ((wanted, common(needed[here], owned[peer])), (lent, common(owned[here], needed[peer]))):
            if peer != here and rows.start < rows.stop:
                table[peer] = rows
    return wanted, lent


def _swap(sent: dict[int, Tensor], heights: dict[int, int], like: Tensor, shard: Shard) -> dict[int, Tensor]:
    """Send rows (B, C, h, W) to some ranks and receive others, of these heights, from some."""
    received = {peer: like.new_empty(*like.shape[:2], height, like.shape[3]) for peer, height in heights.items()}
    transfers = [
        dist.P2POp(dist.isend, rows.contiguous(), shard.peer(peer), shard.group) for peer, rows in sent.items()
    ]
    transfers += [dist.P2POp(dist.irecv, rows, shard.peer(peer), shard.group) for peer, rows in received.items()]

    def transfer() -> None:
        for request in dist.batch_isend_irecv(transfers) if transfers else ():
            request.wait()

    _together(transfer, shard.group)
    return received


def _gather(tensor: Tensor, group: Any) -> list[Tensor]:
    """The tensors of all ranks, of one shape."""
    parts = [torch.empty_like(tensor) for _ in range(dist.get_world_size(group))]
    _together(lambda: dist.all_gather(parts, tensor, group=group), group)
    return parts


def _device(group: Any) -> torch.device:
    """Where tensors must be for the group to send them."""
    return torch.device("cpu" if "gloo" in dist.get_backend(group) else "cuda")


def _together(exchange: Callable[[], object], group: Any) -> None:
    """Do what all ranks of a group have to do.

    Raises:
        ConnectionError: if one of them is gone; it says which.
    """
    try:
        exchange()
    except RuntimeError as error:
        raise ConnectionError(f"{name_the_missing(group)}; start all ranks again") from error


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
