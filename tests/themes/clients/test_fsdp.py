"""FSDP2: parameters sharded over two processes learn what one process learns."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard

from tests.ranks import run_ranks
from tests.themes.test_distributed import PROCESSES, Network, data, train


def work(rank: int, folder: str) -> None:
    """One of the processes."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=PROCESSES)
    try:
        network = Network()
        fully_shard(network.filter, mesh=init_device_mesh("cpu", (PROCESSES,)))
        fully_shard(network, mesh=init_device_mesh("cpu", (PROCESSES,)))
        image, target = (part.chunk(PROCESSES)[rank] for part in data())
        train(network, image, target)
        whole = get_model_state_dict(network, options=StateDictOptions(full_state_dict=True))
        if rank == 0:
            torch.save(whole, f"{folder}/sharded.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.client("FSDP2 (`fully_shard`)", "yes")
@pytest.mark.slow
@pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="this torch has no gloo")
def test_two_shards_learn_what_one_process_learns(tmp_path: Path) -> None:
    run_ranks(work, (str(tmp_path),), PROCESSES)
    sharded = torch.load(tmp_path / "sharded.pt", weights_only=True)
    alone = Network()
    train(alone, *data())
    assert sharded.keys() == alone.state_dict().keys()
    for name, expected in alone.state_dict().items():
        torch.testing.assert_close(sharded[name], expected, atol=1e-5, rtol=1e-4)
    alone.load_state_dict(sharded)
