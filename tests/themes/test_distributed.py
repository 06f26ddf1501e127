"""Data-parallel training: two processes with half of a batch each learn what one process learns from all of it."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from nlfilter_torch import NonlocalFilter
from tests.problems import noise
from tests.ranks import run_ranks

PROCESSES = 2
STEPS = 3


class Network(nn.Module):
    """A convolution that computes the guide, and a filter with all parameters learned."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.guide = nn.Conv2d(1, 4, 3, padding=1)
        self.filter = NonlocalFilter(
            learn=("alpha", "residual", "photometric_bandwidth", "spatial_bandwidth", "patch_weights"),
            photometric_bandwidth=0.5,
            spatial_bandwidth=9.0,
            num_landmarks=12,
        )

    def forward(self, image: Tensor) -> Tensor:
        filtered: Tensor = self.filter(image, self.guide(image))
        return filtered


def train(network: nn.Module, image: Tensor, target: Tensor) -> None:
    optimizer = torch.optim.SGD(network.parameters(), lr=0.5)
    for _ in range(STEPS):
        optimizer.zero_grad()
        (network(image) - target).square().mean().backward()
        optimizer.step()


def data() -> tuple[Tensor, Tensor]:
    return noise(4, 1, 14, 13, dtype=torch.float32), noise(4, 1, 14, 13, seed=1, dtype=torch.float32)


def work(rank: int, folder: str) -> None:
    """One of the processes."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=PROCESSES)
    try:
        network = Network()
        image, target = (part.chunk(PROCESSES)[rank] for part in data())
        train(DistributedDataParallel(network), image, target)
        torch.save(network.state_dict(), f"{folder}/{rank}.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.client("`DistributedDataParallel`", "yes")
@pytest.mark.slow
@pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo")
def test_two_processes_learn_what_one_learns(tmp_path: Path) -> None:
    run_ranks(work, (str(tmp_path),), PROCESSES)
    states = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(PROCESSES)]
    alone, start = Network(), Network().state_dict()
    train(alone, *data())
    for name, expected in alone.state_dict().items():
        torch.testing.assert_close(states[0][name], states[1][name], atol=0, rtol=0)
        torch.testing.assert_close(states[0][name], expected, atol=1e-5, rtol=1e-4)
        if name != "guide.bias":  # a constant added to the guide does not change the filter
            assert not torch.allclose(expected, start[name], atol=1e-4), f"{name} did not learn"
