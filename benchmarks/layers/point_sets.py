"""Sets of points with clusters and manifolds, for :mod:`benchmarks.layers.clusters`: (N, D) in float64."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

POINTS = 4096


@dataclass(frozen=True)
class PointSet:
    """Points in units of the bandwidth, and how many landmarks they get.

    Attributes:
        name: of the set.
        landmarks: M.
        draw: draws N points (N, D).
    """

    name: str
    landmarks: int
    draw: Callable[[torch.Generator, int], Tensor]


def normal(generator: torch.Generator, *size: int) -> Tensor:
    """Normal random numbers."""
    return torch.randn(*size, generator=generator, dtype=torch.float64)


def uniform(generator: torch.Generator, count: int) -> Tensor:
    """Numbers in [0, 1)."""
    return torch.rand(count, generator=generator, dtype=torch.float64)


def clusters(
    generator: torch.Generator,
    points: int,
    *,
    number: int,
    dimensions: int,
    apart: float,
    wide: float,
    unequal: bool = False,
    uneven: bool = False,
) -> Tensor:
    """Normal clusters of a standard deviation, whose centres have another.

    Their sizes may be unequal, as 1 / rank, and their widths uneven, from half to twice ``wide``.
    """
    centres = apart * normal(generator, number, dimensions)
    shares = 1 / torch.arange(1.0, number + 1) if unequal else torch.ones(number)
    labels = torch.multinomial(shares, points, replacement=True, generator=generator)
    widths = wide * 2 ** (2 * uniform(generator, number) - 1) if uneven else torch.full((number,), wide).double()
    return centres[labels] + widths[labels].unsqueeze(1) * normal(generator, points, dimensions)


def embedded(generator: torch.Generator, points: Tensor, dimensions: int) -> Tensor:
    """The points in a space of more dimensions."""
    return points @ torch.linalg.qr(normal(generator, dimensions, points.shape[1])).Q.mT


def roll(generator: torch.Generator, points: int, *, dimensions: int, scale: float) -> Tensor:
    """A Swiss roll."""
    angle, height = 1.5 * math.pi * (1 + 2 * uniform(generator, points)), 21 * uniform(generator, points)
    flat = torch.stack([angle * angle.cos(), height, angle * angle.sin()], dim=1)
    return scale * embedded(generator, flat, dimensions)


def sphere(generator: torch.Generator, points: int, *, inner: int, dimensions: int, noise: float = 0.0) -> Tensor:
    """A sphere of radius 2 in ``inner`` dimensions, with noise in all ``dimensions``."""
    directions = torch.nn.functional.normalize(normal(generator, points, inner), dim=1)
    return 2 * (embedded(generator, directions, dimensions) + noise * normal(generator, points, dimensions))


def curve(generator: torch.Generator, points: int, *, dimensions: int) -> Tensor:
    """A closed curve, on part of which points are dense."""
    angle = 2 * math.pi * uniform(generator, points).square()
    waves = range(1, dimensions // 2 + 1)
    return torch.stack([function(wave * angle) for wave in waves for function in (torch.cos, torch.sin)], dim=1)


def mixed(generator: torch.Generator, points: int) -> Tensor:
    """A Swiss roll and 40 clusters in 64 dimensions."""
    half = points // 2
    parts = roll(generator, half, dimensions=64, scale=0.15), SIXTY(generator, points - half, number=40)
    return torch.cat(parts)


SIXTY = partial(clusters, number=60, dimensions=64, apart=1.0, wide=0.1)
ISSUE = [PointSet(f"60 clusters, 64-D, M = {count}", count, SIXTY) for count in (64, 100)]
MORE = [
    PointSet(name, count, draw)
    for name, count, draw in (
        ("40 clusters, 2-D", 60, partial(clusters, number=40, dimensions=2, apart=8.0, wide=0.3)),
        ("40 unequal, 2-D", 60, partial(clusters, number=40, dimensions=2, apart=8.0, wide=0.3, unequal=True)),
        ("80 clusters, 4-D", 100, partial(clusters, number=80, dimensions=4, apart=4.0, wide=0.3)),
        (
            "80 unequal, uneven, 4-D",
            100,
            partial(clusters, number=80, dimensions=4, apart=4.0, wide=0.3, unequal=True, uneven=True),
        ),
        ("60 clusters, 8-D", 64, partial(clusters, number=60, dimensions=8, apart=2.0, wide=0.2)),
        ("60 unequal, 8-D", 100, partial(clusters, number=60, dimensions=8, apart=2.0, wide=0.2, unequal=True)),
        ("60 clusters, 16-D", 64, partial(clusters, number=60, dimensions=16, apart=1.5, wide=0.15)),
        (
            "60 unequal, uneven, 16-D",
            100,
            partial(clusters, number=60, dimensions=16, apart=1.5, wide=0.15, unequal=True, uneven=True),
        ),
        ("30 clusters, 32-D", 32, partial(clusters, number=30, dimensions=32, apart=1.0, wide=0.1)),
        ("30 unequal, 32-D", 50, partial(clusters, number=30, dimensions=32, apart=1.0, wide=0.1, unequal=True)),
        ("60 unequal, 64-D", 100, partial(SIXTY, unequal=True)),
        ("60 uneven, 64-D", 80, partial(SIXTY, wide=0.12, uneven=True)),
        ("90 close clusters, 64-D", 100, partial(clusters, number=90, dimensions=64, apart=0.4, wide=0.1)),
        ("120 unequal, 24-D", 250, partial(clusters, number=120, dimensions=24, apart=1.0, wide=0.12, unequal=True)),
        ("Swiss roll", 100, partial(roll, dimensions=3, scale=0.2)),
        ("Swiss roll in 32-D", 64, partial(roll, dimensions=32, scale=0.1)),
        ("sphere of 3 in 16-D", 100, partial(sphere, inner=3, dimensions=16)),
        ("noisy sphere of 4 in 64-D", 150, partial(sphere, inner=4, dimensions=64, noise=0.02)),
        ("curve in 16-D", 60, partial(curve, dimensions=16)),
        ("Swiss roll and clusters, 64-D", 120, mixed),
    )
]
