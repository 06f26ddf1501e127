"""The non-local block beside the usual embedded Gaussian one: accuracy of a small task, time and memory.

The task needs the whole picture: every pixel of 24x24 has one of four colours, 30 % of the cells are marked with the
class of their colour (plus or minus, drawn anew for every picture), and all pixels are to be classified. ``directed``
asks for the class of the next colour of the ring instead, so that pixels should attend to pixels unlike themselves.
"""

import math
import time
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn

from benchmarks.harness import Figure, forget_peak, resident
from nlfilter_torch import NonlocalBlock

CHANNELS, SIDE, CELL, COLOURS, MARKED = 16, 24, 4, 4, 0.3
SEEDS = (2, 3, 4)  # learning rate and temperature were chosen on 0 and 1
RATE = 3e-3  # the best of 0.003, 0.01 and 0.03 for the usual block and for ours, on seeds 0 and 1


class UsualBlock(nn.Module):
    """The embedded Gaussian block: ``x + norm(V softmax(Q^T K))``, by the matrix or by torch's fused attention."""

    def __init__(self, channels: int, *, fused: bool = False) -> None:
        super().__init__()
        self.fused = fused
        self.queries, self.keys, self.values = (nn.Conv1d(channels, channels // 2, 1) for _ in range(3))
        self.output, self.norm = nn.Conv1d(channels // 2, channels, 1), nn.BatchNorm1d(channels)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Add what all pixels contribute to features (B, C, H, W)."""
        points = x.flatten(2)
        queries, keys, values = self.queries(points), self.keys(points), self.values(points)
        if self.fused:
            heads = (part.mT.unsqueeze(1) for part in (queries, keys, values))
            attended = nn.functional.scaled_dot_product_attention(*heads, scale=1.0).squeeze(1).mT
        else:
            attended = values @ (queries.mT @ keys).softmax(2).mT
        added: Tensor = self.norm(self.output(attended))
        return x + added.view(x.shape)


def scenes(count: int, generator: torch.Generator, *, directed: bool) -> tuple[Tensor, Tensor]:
    """Pictures (count, 3, 24, 24) of two colour channels and the marks, and the classes (count, 1, 24, 24)."""
    cells = (SIDE // CELL) ** 2
    ring = torch.rand(count, 1, generator=generator) + torch.arange(COLOURS) / COLOURS
    kinds = torch.randint(COLOURS, (count, cells), generator=generator)
    classes = torch.randint(2, (count, COLOURS), generator=generator) * 2.0 - 1
    own = classes.gather(1, kinds)
    marks = own * (torch.rand(count, cells, generator=generator) < MARKED)
    hue = 2 * math.pi * ring.gather(1, kinds)
    wanted = classes.roll(-1, 1).gather(1, kinds) if directed else own
    planes = torch.stack([hue.cos(), hue.sin(), marks, wanted], dim=1).unflatten(2, (SIDE // CELL, -1))
    planes = planes.repeat_interleave(CELL, 2).repeat_interleave(CELL, 3)
    planes[:, :2] += 0.2 * torch.randn(count, 2, SIDE, SIDE, generator=generator)
    return planes[:, :3], planes[:, 3:]


def accuracy(block: Callable[[], nn.Module], seed: int, steps: int, *, directed: bool = False) -> float:
    """Share of the pixels of new pictures that a small network with a block classifies rightly, in percent."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        convolutions = [nn.Conv2d(n, CHANNELS, 3, padding=1) for n in (3, CHANNELS, CHANNELS)]
        first, second, third = (nn.Sequential(each, nn.ReLU()) for each in convolutions)
        network = nn.Sequential(first, second, block(), third, nn.Conv2d(CHANNELS, 1, 1))
    generator = torch.Generator().manual_seed(1000 + seed)
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps)
    for _ in range(steps):
        pictures, classes = scenes(8, generator, directed=directed)
        optimizer.zero_grad()
        nn.functional.soft_margin_loss(network(pictures), classes).backward()
        optimizer.step()
        schedule.step()
    pictures, classes = scenes(64, generator, directed=directed)
    with torch.no_grad():
        return 100 * float((network.eval()(pictures) * classes > 0).float().mean())


def cost(block: nn.Module, side: int, repeats: int) -> tuple[float, float]:
    """Least seconds of a forward and backward pass for features of side x side, and its peak memory in MiB."""
    channels, times = block.values.in_channels if isinstance(block, UsualBlock) else block.channels, []
    x = torch.randn(1, channels, side, side, generator=torch.Generator().manual_seed(0)).requires_grad_()  # type: ignore[arg-type]
    block(x[:, :, :8, :8])  # memory of libraries does not count
    forget_peak()
    before = resident("VmRSS")
    for _ in range(repeats):
        start = time.perf_counter()
        block(x).square().mean().backward()
        times.append(time.perf_counter() - start)
    return min(times), resident("VmHWM") - before


def costs(quick: bool) -> Iterator[Figure]:
    """Time and memory where the usual block still fits, and of a megapixel."""
    sides = (16, 24, 32, 48) if quick else (64, 128, 256, 1024)
    small, middle, large, largest = sides
    ours, usual, fused = NonlocalBlock(CHANNELS), UsualBlock(CHANNELS), UsualBlock(CHANNELS, fused=True)
    measured = {side: cost(ours, side, 2 if side == largest else 4) for side in sides}
    peer, without_matrix = cost(usual, small, 3), cost(fused, middle, 1)
    limit = None if quick else 1.0
    yield Figure(f"{small}x{small}: time of a step, of the usual block's", measured[small][0] / peer[0], limit)
    yield Figure(f"{small}x{small}: memory of a step", measured[small][1], None, "MiB")
    yield Figure(f"{small}x{small}: memory of a step of the usual block", peer[1], None, "MiB")
    ratio = measured[middle][0] / without_matrix[0]
    yield Figure(f"{middle}x{middle}: time of a step, of the usual block's with fused attention", ratio, limit)
    growth = measured[largest][0] / measured[large][0] * (large / largest) ** 2
    name = f"{largest}x{largest}: time per pixel, of that of {large}x{large}"
    yield Figure(name, growth, None if quick else 1.5)
    yield Figure(f"{largest}x{largest}: time of a step", measured[largest][0], None, "s")
    matrix = largest**4 * 4 / 2**20
    yield Figure(f"{largest}x{largest}: memory of a step", measured[largest][1], limit and matrix / 1000, "MiB")
    yield Figure(f"{largest}x{largest}: the usual block's matrix alone would take", matrix, None, "MiB")
    projected = without_matrix[0] * (largest / middle) ** 4
    yield Figure(
        f"{largest}x{largest}: usual block, fused, projected by N^2 from {middle}x{middle}", projected, None, "s"
    )


def measure(quick: bool) -> Iterator[Figure]:
    """Costs, and the accuracy of three seeds."""
    yield from costs(quick)  # first, as memory that the process keeps would not count
    blocks: dict[str, Callable[[], nn.Module]] = {
        "NonlocalBlock": lambda: NonlocalBlock(CHANNELS),
        "the usual block": lambda: UsualBlock(CHANNELS),
        "no block": nn.Identity,
    }
    steps, seeds = (3, SEEDS[:1]) if quick else (300, SEEDS)
    mean: dict[str, float] = {}
    for directed in (False, True):
        task = "class of the next colour" if directed else "class of the same colour"
        for name, block in blocks.items():
            reached = [accuracy(block, seed, steps, directed=directed) for seed in seeds]
            mean[name] = sum(reached) / len(reached)
            shown = ", ".join(f"{value:.1f}" for value in reached)
            yield Figure(f"{task}: accuracy with {name} (seeds {shown})", mean[name], None, "%")
        if not directed:
            for name in ("NonlocalBlock", "the usual block"):
                reached = [accuracy(blocks[name], seeds[0], 4 * steps)]
                yield Figure(f"{task}: accuracy with {name}, {4 * steps} steps (a seed)", reached[0], None, "%")
            ahead = mean["NonlocalBlock"] - mean["the usual block"]
            yield Figure(f"{task}: gain over the usual block", ahead, None if quick else -1.0, "points", at_most=False)
