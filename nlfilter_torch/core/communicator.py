"""Sums over the pixels of an image, in one process or over the ranks of a process group of :mod:`torch.distributed`.

What connects pixels are sums over all of them (M-vectors, M x M matrices) and the patches that landmarks are made of.
If the rows of an image are spread over ranks, each rank computes these sums over its own rows and passes them to
:meth:`Communicator.sum`; rows of the neighbours that its patches reach into come from :meth:`Communicator.with_halo`.
The amount of data sent does not depend on the height of the image. In one process a communicator returns what it is
given, so the same code serves both.

Gradients: the loss is the sum of the tensors on which the ranks call ``backward``. A tensor that is equal on all ranks
(landmarks, sums) receives on each rank the gradient of that rank's rows. The backward pass of a sum over ranks adds
these gradients up, and so does that of :meth:`Communicator.copy_to_group`, to which parameters are passed.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from functools import partial
from itertools import accumulate
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from nlfilter_torch.core.torch_internals import default_store

ANSWERING = timedelta(seconds=10)  # for the remaining ranks to say that they are alive


class Communicator:
    """One process that has the whole image: every method returns what it is given.

    Attributes:
        size: number of ranks.
        first_row: row of the whole image that is the first one here.
    """

    size = 1
    first_row = 0

    def whole(self, here: tuple[int, ...]) -> tuple[int, ...]:
        """Size of the whole image, given that of the rows here."""
        return here

    def pixels(self, here: int) -> int:
        """Number of pixels of the whole image, given how many are here."""
        return here

    def sum(self, tensor: Tensor) -> Tensor:
        """The sum over the ranks, on all of them; differentiable any number of times."""
        return tensor

    def max(self, tensor: Tensor) -> Tensor:
        """The elementwise maximum over the ranks, on all of them; without a gradient."""
        return tensor

    def broadcast(self, tensor: Tensor) -> Tensor:
        """The tensor of the first rank, on all of them; without a gradient."""
        return tensor

    def copy_to_group(self, value: Any) -> Any:
        """A parameter that is equal on all ranks: its gradient is the sum over the ranks.

        Anything but a tensor is returned unchanged.
        """
        return value

    def columns(self, features: Tensor, indices: Tensor) -> Tensor:
        """Columns (B, D, S) of the features (B, D, N) of all ranks, at pixels numbered over the whole image.

        Their indices are (S,), or (B, 1, S) with a batch of 1 for all images.
        """
        # torch gathers on all cores where all planes share an index; selecting would use one core.
        return features.gather(2, indices.expand(*features.shape[:2], -1))

    def with_halo(self, rows: Tensor, margin: int) -> tuple[Tensor, tuple[int, int]]:
        """The rows (B, C, H, ...) with ``margin`` rows of the neighbours above and below, and how many were added.

        Differentiable. Fewer rows are added where the image has fewer.
        """
        return rows, (0, 0)

    def check_whole(self, what: str) -> None:
        """Raise ValueError if rows are spread over ranks, for computations that need the whole image."""


ALONE = Communicator()


class RowCommunicator(Communicator):
    """The rows of an image, or the slices of a volume, spread over the ranks of a group, from the top down.

    Attributes:
        group: the process group.
        rows: number of rows of each rank.
        width: number of pixels in a row.
        rank: number of this process in the group.
        height: of the whole image.
    """

    def __init__(self, group: Any, rows: tuple[int, ...], width: int) -> None:
        """Number the rows; every rank of the group calls this with the same arguments."""
        self.group, self.rows, self.width = group, rows, width
        self.rank, self.size, self.height = dist.get_rank(group), len(rows), sum(rows)
        self.first_row = sum(rows[: self.rank])

    def whole(self, here: tuple[int, ...]) -> tuple[int, ...]:
        """Size of the whole image."""
        return (self.height, *here[1:])

    def pixels(self, here: int) -> int:
        """Number of pixels of the whole image."""
        return self.height * self.width

    def sum(self, tensor: Tensor) -> Tensor:
        """An all-reduce; the backward pass sums the gradients of the ranks."""
        total: Tensor = _Sum.apply(tensor, self.group)  # type: ignore[no-untyped-call]
        return total

    def max(self, tensor: Tensor) -> Tensor:
        """An all-reduce."""
        largest = tensor.detach().clone(memory_format=torch.contiguous_format)
        _exchange(lambda: dist.all_reduce(largest, op=dist.ReduceOp.MAX, group=self.group), self.group)
        return largest

    def broadcast(self, tensor: Tensor) -> Tensor:
        """A broadcast from rank 0 of the group."""
        device = "cpu" if "gloo" in dist.get_backend(self.group) else "cuda"  # from which the group sends
        chosen = tensor.detach().to(device).clone(memory_format=torch.contiguous_format)
        _exchange(lambda: dist.broadcast(chosen, src=self.global_rank(0), group=self.group), self.group)
        return chosen.to(tensor.device)

    def copy_to_group(self, value: Any) -> Any:
        """The value; the backward pass sums the gradients of the ranks."""
        return _Copy.apply(value, self.group) if isinstance(value, Tensor) else value  # type: ignore[no-untyped-call]

    def columns(self, features: Tensor, indices: Tensor) -> Tensor:
        """Each rank contributes the columns of its own pixels to a sum."""
        local = indices - self.first_row * self.width
        here = (local >= 0) & (local < features.shape[2])
        columns = super().columns(features, local.clamp(0, features.shape[2] - 1))
        return self.sum(torch.where(here, columns, torch.zeros_like(columns)))

    def with_halo(self, rows: Tensor, margin: int) -> tuple[Tensor, tuple[int, int]]:
        """Rows of other ranks are sent point to point; the backward pass sends their gradients back."""
        if margin == 0:
            return rows, (0, 0)
        last = self.first_row + self.rows[self.rank]
        extended: Tensor = _Halo.apply(rows, margin, self)  # type: ignore[no-untyped-call]
        return extended, (min(margin, self.first_row), min(margin, self.height - last))

    def check_whole(self, what: str) -> None:
        """Raise ValueError."""
        raise ValueError(
            f"{what} needs the whole image on one rank, got one that is spread over {self.size}; "
            "build the operator without a group"
        )

    def global_rank(self, rank: int) -> int:
        """Number in the default group of the process with this number in the group."""
        return dist.get_global_rank(self.group, rank)


def all_gather_shapes(guide: Tensor, group: Any) -> Communicator:
    """All-gather the shapes of the ranks' rows (B, C, H, ...): the communicator of their image; ALONE without a group.

    Raises:
        TypeError: if ``group`` is no process group that this process belongs to.
        ValueError: if the guides differ in more than their number of rows.
    """
    check_group(group)
    if group is None:
        return ALONE
    batch, channels, height, *row = guide.shape
    own = torch.tensor([height, batch, channels, *row, torch.finfo(guide.dtype).bits], device=guide.device)
    parts = [torch.empty_like(own) for _ in range(dist.get_world_size(group))]
    _exchange(lambda: dist.all_gather(parts, own, group=group), group)
    shapes = [part.tolist() for part in parts]
    for rank, shape in enumerate(shapes):
        if shape[1:] != shapes[0][1:]:
            raise ValueError(
                f"guide must have the batch, channels, width and dtype of the other ranks' rows, {shapes[0][1:]} on "
                f"rank 0, got {shape[1:]} on rank {rank}; cut one image into rows"
            )
    return RowCommunicator(group, tuple(shape[0] for shape in shapes), math.prod(row))


def check_group(group: Any) -> None:
    """Raise TypeError unless ``group`` is None or a process group that this process belongs to."""
    if group is None:
        return
    if not dist.is_available() or not isinstance(group, dist.ProcessGroup):
        raise TypeError(
            f"group must be a process group of torch.distributed with this process in it, got {type(group).__name__}; "
            "pass torch.distributed.group.WORLD after torch.distributed.init_process_group"
        )


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, group: Any) -> Tensor:
        ctx.group = group
        total = tensor.clone(memory_format=torch.contiguous_format)
        _exchange(lambda: dist.all_reduce(total, group=group), group)
        return total

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Sum.apply(grad, ctx.group), None  # type: ignore[no-untyped-call]


class _Copy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, group: Any) -> Tensor:
        ctx.group = group
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Sum.apply(grad, ctx.group), None  # type: ignore[no-untyped-call]


class _Halo(torch.autograd.Function):
    """The rows of this rank and ``margin`` rows on either side, possibly of several ranks with few rows each."""

    @staticmethod
    def forward(ctx: Any, guide: Tensor, margin: int, communicator: RowCommunicator) -> Tensor:
        ctx.margin, ctx.communicator = margin, communicator
        wanted, lent = _overlaps(communicator, margin)
        first = communicator.first_row
        base = max(0, first - margin)
        height = min(communicator.height, first + guide.shape[2] + margin) - base
        extended = guide.new_empty(*guide.shape[:2], height, *guide.shape[3:])
        extended[:, :, first - base : first - base + guide.shape[2]] = guide
        sent = {peer: guide[:, :, rows.start - first : rows.stop - first] for peer, rows in lent.items()}
        shapes = {peer: rows.stop - rows.start for peer, rows in wanted.items()}
        for peer, rows in _swap(sent, shapes, guide, communicator).items():
            extended[:, :, wanted[peer].start - base : wanted[peer].stop - base] = rows
        return extended

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return _HaloAdjoint.apply(grad, ctx.margin, ctx.communicator), None, None  # type: ignore[no-untyped-call]


class _HaloAdjoint(torch.autograd.Function):
    """Every row of this rank and its copies in the halos of other ranks, added up; linear, as :class:`_Halo` is."""

    @staticmethod
    def forward(ctx: Any, extended: Tensor, margin: int, communicator: RowCommunicator) -> Tensor:
        ctx.margin, ctx.communicator = margin, communicator
        wanted, lent = _overlaps(communicator, margin)
        first = communicator.first_row
        base = max(0, first - margin)
        own = extended[:, :, first - base : first - base + communicator.rows[communicator.rank]].clone()
        sent = {peer: extended[:, :, rows.start - base : rows.stop - base] for peer, rows in wanted.items()}
        shapes = {peer: rows.stop - rows.start for peer, rows in lent.items()}
        for peer, rows in _swap(sent, shapes, extended, communicator).items():
            own[:, :, lent[peer].start - first : lent[peer].stop - first] += rows
        return own

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        return _Halo.apply(grad, ctx.margin, ctx.communicator), None, None  # type: ignore[no-untyped-call]


def _overlaps(communicator: RowCommunicator, margin: int) -> tuple[dict[int, slice], dict[int, slice]]:
    """Rows of other ranks that are needed here, and rows from here that other ranks need, by rank."""
    ends = list(accumulate(communicator.rows))
    owned = [range(end - rows, end) for end, rows in zip(ends, communicator.rows, strict=True)]
    needed = [range(max(0, rows.start - margin), min(ends[-1], rows.stop + margin)) for rows in owned]
    here = communicator.rank
    peers = [peer for peer in range(len(owned)) if peer != here]
    wanted = {peer: _intersection(needed[here], owned[peer]) for peer in peers}
    lent = {peer: _intersection(owned[here], needed[peer]) for peer in peers}
    return _without_empty(wanted), _without_empty(lent)


def _intersection(first: range, second: range) -> slice:
    return slice(max(first.start, second.start), min(first.stop, second.stop))


def _without_empty(rows: dict[int, slice]) -> dict[int, slice]:
    return {rank: part for rank, part in rows.items() if part.start < part.stop}


def _swap(
    sent: dict[int, Tensor], heights: dict[int, int], like: Tensor, communicator: RowCommunicator
) -> dict[int, Tensor]:
    """Send rows (B, C, h, ...) to some ranks and receive others, of these heights, from some."""
    received = {peer: like.new_empty(*like.shape[:2], height, *like.shape[3:]) for peer, height in heights.items()}
    transfers = [
        dist.P2POp(dist.isend, rows.contiguous(), communicator.global_rank(peer), communicator.group)
        for peer, rows in sent.items()
    ]
    transfers += [
        dist.P2POp(dist.irecv, rows, communicator.global_rank(peer), communicator.group)
        for peer, rows in received.items()
    ]

    _exchange(partial(_transfer, transfers), communicator.group)
    return received


def _transfer(transfers: list[dist.P2POp]) -> None:
    for request in dist.batch_isend_irecv(transfers) if transfers else ():
        request.wait()


def _exchange(call: Callable[[], object], group: Any) -> None:
    """Run a call of torch.distributed that all ranks of a group take part in.

    Raises:
        ConnectionError: if a rank is gone; the message names it.
    """
    try:
        call()
    except RuntimeError as error:
        raise ConnectionError(f"{_name_the_missing(group)}; start all ranks again") from error


def _name_the_missing(group: Any) -> str:
    """Name the ranks of a group that are gone, after a call between them failed; takes at most :data:`ANSWERING`.

    The call fails on all remaining ranks. Each of them sets a key in the store that connected the group.
    """
    ranks = dist.get_process_group_ranks(group)
    keys = {rank: f"nlfilter/{group.group_name}/{rank} is here" for rank in ranks}
    try:
        store = default_store()
        store.set(keys[dist.get_rank()], "")
        with suppress(RuntimeError):  # DistStoreError, where some are missing
            store.wait(list(keys.values()), ANSWERING)
        missing = [str(rank) for rank, key in keys.items() if not store.check([key])]
    except RuntimeError:  # the store ends with the process that holds it
        return "rank 0, or the process in which the ranks had met, died"
    if not missing:
        return "the connection between ranks broke, though all of them are alive"
    return f"rank{'s' * (len(missing) > 1)} {', '.join(missing)} of {len(ranks)} died or did not answer"
