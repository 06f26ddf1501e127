"""What ranks that share one image send to each other: ``python -m benchmarks.distributed [--ranks 3]``.

Counts the bytes of every tensor that a rank passes to ``torch.distributed`` in one forward and one backward pass, for
images of several heights. A ring all-reduce over n ranks sends each such byte 2 (n - 1) / n times; protocol overhead is
not counted. The ranks are processes on this machine, or, under ``torchrun -m benchmarks.distributed``, those that it
starts, with NCCL if there are GPUs.
"""

import argparse
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
import torch.distributed as dist
from torch import Tensor
from torch.multiprocessing.spawn import spawn

from benchmarks.harness import options, row
from benchmarks.photographs import retina
from nlfilter_torch import nonlocal_operator, polynomial_filter

ALPHA = (3.0, 3.0, 4.0, 1.05)


@dataclass
class Traffic:
    """Tensors that this rank passed to ``torch.distributed``.

    Attributes:
        sent: bytes of ``sums`` (and maxima) over the ranks, of ``choices`` that the first rank broadcasts, of ``halo``
            rows for neighbours, and of ``shapes`` in all-gathers.
        calls: total number of calls.
    """

    sent: Counter[str] = field(default_factory=Counter)
    calls: int = 0

    def add(self, kind: str, *tensors: Tensor) -> None:
        """Count a call."""
        self.sent[kind] += sum(tensor.numel() * tensor.element_size() for tensor in tensors)
        self.calls += 1


@contextmanager
def watched() -> Iterator[Traffic]:
    """Count the tensors sent inside the block."""
    traffic = Traffic()
    reduce, broadcast, gather, swap = dist.all_reduce, dist.broadcast, dist.all_gather, dist.batch_isend_irecv

    def all_reduce(tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
        traffic.add("sums", tensor)
        return reduce(tensor, *args, **kwargs)

    def all_gather(parts: list[Tensor], tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
        traffic.add("shapes", tensor)
        return gather(parts, tensor, *args, **kwargs)

    def first_rank_tells(tensor: Tensor, *args: Any, **kwargs: Any) -> Any:
        traffic.add("choices", tensor)
        return broadcast(tensor, *args, **kwargs)

    def exchange(transfers: list[dist.P2POp]) -> Any:
        traffic.add("halo", *(t.tensor for t in transfers if t.op is dist.isend))
        return swap(transfers)

    with mock.patch.multiple(
        dist, all_reduce=all_reduce, all_gather=all_gather, broadcast=first_rank_tells, batch_isend_irecv=exchange
    ):
        yield traffic


def share(image: Tensor, rank: int, ranks: int) -> Tensor:
    """The rows of an image that a rank holds."""
    return image.tensor_split(ranks, dim=2)[rank]


def measure(side: int, height: int, landmarks: int, device: torch.device) -> list[str]:
    """Measure one case on this rank, and return a row of the table."""
    rank, ranks = dist.get_rank(), dist.get_world_size()
    whole = retina(side).repeat(1, 1, -(-height // side), 1)[:, :, :height]
    rows = share(whole, rank, ranks).to(device).requires_grad_()
    alpha = torch.tensor(ALPHA, device=device, requires_grad=True)
    start = time.perf_counter()
    with watched() as forward:
        operator = nonlocal_operator(rows, num_landmarks=landmarks, group=dist.group.WORLD)
        filtered = polynomial_filter(operator, rows, alpha)
    middle = time.perf_counter()
    with watched() as backward:
        (filtered.square().sum() / whole.numel()).backward()
    end = time.perf_counter()
    kinds = [f"{forward.sent[kind]:,}" for kind in ("sums", "choices", "halo", "shapes")]
    return [
        f"{side}x{height}",
        f"{landmarks}",
        f"{ranks}",
        f"{operator.balancing_steps}",
        *kinds,
        f"{forward.calls}",
        f"{sum(backward.sent.values()):,}",
        f"{backward.calls}",
        f"{middle - start:.2f}",
        f"{end - middle:.2f}",
    ]


HEAD = ["picture", "m", "ranks", "sweeps", "sums", "choices", "halo", "shapes", "calls"]
HEAD += ["backward", "calls", "forward s", "backward s"]


def work(options: argparse.Namespace) -> None:
    """Measure all cases on every rank; the first rank prints the table."""
    device = torch.device("cpu")
    if dist.get_backend() == "nccl":
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(device)
    cases = [(width, tall * width, m) for width in options.widths for tall in (1, 2, 4) for m in options.landmarks]
    rows = [measure(*case, device) for case in cases]
    if dist.get_rank() == 0:
        print("\n".join(row(cells[0], cells[1:], 11, 10) for cells in (HEAD, *rows)), flush=True)


def _work_here(rank: int, options: argparse.Namespace, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=options.ranks)
    try:
        work(options)
    finally:
        dist.destroy_process_group()


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = options("distributed", __doc__)
    parser.add_argument("--ranks", type=int, default=3, help="processes on this machine; ignored under torchrun")
    parser.add_argument("--widths", type=int, nargs="+", default=[128, 256], help="widths of the pictures")
    parser.add_argument("--landmarks", type=int, nargs="+", default=[50, 100], help="numbers of landmarks m")
    chosen = parser.parse_args(arguments)
    if "RANK" in os.environ:
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        try:
            work(chosen)
        finally:
            dist.destroy_process_group()
        return
    with tempfile.TemporaryDirectory() as folder:
        spawn(_work_here, (chosen, folder), nprocs=chosen.ranks)


if __name__ == "__main__":
    main()
