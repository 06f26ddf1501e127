"""One image over processes that torchrun starts, and over GPUs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch.multiprocessing.spawn import spawn

from nlfilter_torch import nonlocal_operator, polynomial_filter
from tests.problems import picture

pytestmark = pytest.mark.slow

HEIGHT, WIDTH = 24, 17


@pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo")
def test_started_by_torchrun() -> None:
    """The benchmark, as a program that torchrun starts: the same bytes for every height."""
    arguments = ["--standalone", "--nproc-per-node", "2", "-m", "benchmarks.distributed", "--widths", "32"]
    run = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", *arguments, "--landmarks", "10"],
        cwd=Path(__file__).parents[2],
        env=os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    head, *rows = (line.split() for line in run.stdout.splitlines())
    assert [row[:3] for row in rows] == [[size, "10", "2"] for size in ("32x32", "32x64", "32x128")]
    choices, halo = head.index("choices"), head.index("halo")
    assert len({(row[choices], row[halo]) for row in rows}) == 1


def work_on_a_gpu(rank: int, folder: str, processes: int) -> None:
    """One of the processes, each with a GPU of its own."""
    torch.cuda.set_device(rank)
    dist.init_process_group("nccl", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=processes)
    rows = picture("astronaut", HEIGHT, WIDTH).tensor_split(processes, 2)[rank].cuda().requires_grad_()
    operator = nonlocal_operator(rows, photometric_bandwidth=0.2, num_landmarks=15, group=dist.group.WORLD)
    alpha = torch.tensor([3.0, 1.0], dtype=torch.float64, device="cuda", requires_grad=True)
    filtered = polynomial_filter(operator, rows, alpha)
    filtered.pow(2).sum().backward()
    assert rows.grad is not None
    assert alpha.grad is not None
    torch.save([filtered.detach().cpu(), rows.grad.cpu(), alpha.grad.cpu()], f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.skipif(not torch.cuda.is_available() or not dist.is_nccl_available(), reason="no GPU, or no NCCL")
def test_every_gpu_gets_what_one_process_gets(tmp_path: Path) -> None:
    processes = torch.cuda.device_count()
    spawn(work_on_a_gpu, (str(tmp_path), processes), nprocs=processes)
    parts = [torch.load(tmp_path / f"{rank}.pt") for rank in range(processes)]
    image = picture("astronaut", HEIGHT, WIDTH).requires_grad_()
    operator = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=15)
    alpha = torch.tensor([3.0, 1.0], dtype=torch.float64, requires_grad=True)
    filtered = polynomial_filter(operator, image, alpha)
    filtered.pow(2).sum().backward()
    torch.testing.assert_close(torch.cat([part[0] for part in parts], dim=2), filtered.detach(), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.cat([part[1] for part in parts], dim=2), image.grad, atol=1e-5, rtol=0)
    for part in parts:
        torch.testing.assert_close(part[2], alpha.grad, atol=0, rtol=1e-6)
