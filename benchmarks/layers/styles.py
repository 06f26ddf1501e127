"""Networks that predict a look for each photograph: weights of a few lattices beside tone curves.

The style to learn depends on the photograph and on hues: medium brightness, then greens, blues and skin are moved one
way in warm photographs and another way in cold ones. All networks are the same but for the last layer, see an average
of 4x4 pixels, and are trained end to end, for the same number of steps, on parts of four photographs of scikit-image
under changing exposure and white balance. Figures are means over parts of photographs that no network was trained on;
the number of lattices, their nodes and the steps were chosen on a fifth photograph, ``chelsea``, which is not reported.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.harness import Figure
from benchmarks.photographs import photograph, reduced_to
from nlfilter_torch.photo import Look

TRAINED = ("astronaut", "coffee", "rocket", "hubble_deep_field")
REPORTED = ("motorcycle", "immunohistochemistry", "retina", "colorwheel")
SIDE, CROP, TEST_CROP = 128, 48, 96  # pixels of photographs, and of their parts in training and in the figures
TRAINED_PARTS, TESTED_PARTS = 4, 16  # parts of each photograph in a batch, and in the figures
STEPS, QUICK_STEPS = 800, 10
RATE = 0.005
KNOTS, LATTICES, NODES = 17, 6, 9
MEDIUM = 0.45  # mean brightness of the style


def style(image: Tensor) -> Tensor:
    """The style of photographs (B, 3, H, W)."""
    mean = image.mean((1, 2, 3), keepdim=True)
    exponent = (math.log(MEDIUM) / mean.log()).clamp(0.5, 1.6)
    light = image.clamp(min=1e-3) ** exponent
    warm = torch.sigmoid(12 * (image[:, :1] - image[:, 2:]).mean((2, 3), keepdim=True))
    grey = light.mean(1, keepdim=True)
    red, green, blue = (light - grey).split(1, dim=1)
    chroma = torch.complex(red, (green - blue) / 3**0.5)
    hue = chroma.angle()
    turn = warm * 0.6 * hue.sin() + (1 - warm) * 0.6 * (2 * hue).sin()
    gain = 1 + warm * 0.5 * hue.cos() - (1 - warm) * 0.4 * (2 * hue).cos()
    moved = chroma * torch.polar(gain, turn)
    other = moved.imag * 3**0.5 / 2
    return (grey + torch.cat([moved.real, other - moved.real / 2, -other - moved.real / 2], dim=1)).clamp(0, 1)


class StyleNetwork(nn.Module):
    """Predicts a look for each photograph, and applies it.

    Args:
        curves: whether to predict tone curves.
        matrix: whether to predict a colour matrix.
        lattices: number of lattices that are learned together, and weighed for each photograph.
    """

    def __init__(self, *, curves: bool = False, matrix: bool = False, lattices: int = 0) -> None:
        super().__init__()
        self.counts = (3 * KNOTS * curves, 9 * matrix, lattices)
        self.network = nn.Sequential(
            nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(48, 64), nn.ReLU(), nn.Linear(64, sum(self.counts))
        )
        start = 0.1 * torch.randn(lattices, 3, 1, 1, 1).expand(-1, -1, NODES, NODES, NODES)
        self.lattices = nn.Parameter(start.clone())
        self.look = Look(learn=())  # the network gives the values

    def forward(self, image: Tensor) -> Tensor:
        """The photographs (B, 3, H, W) under their looks."""
        rises, matrix, weights = self.network(image - 0.5).split(self.counts, dim=1)
        parts: dict[str, Tensor] = {}
        if rises.shape[1]:
            parts["curves"] = F.softplus(rises.unflatten(1, (3, KNOTS))).cumsum(2) / 11  # that never fall
        if matrix.shape[1]:
            parts["matrix"] = torch.eye(3) + 0.1 * matrix.unflatten(1, (3, 3))
        if weights.shape[1]:
            parts["lattice"] = torch.einsum("bk,kcrst->bcrst", weights, self.lattices)
        result: Tensor = self.look(image, **parts)
        return result


@dataclass
class Crops:
    """Random parts of photographs, under random exposure and white balance.

    Attributes:
        pictures: photographs (1, 3, H, W).
        seed: of the parts.
    """

    pictures: list[Tensor]
    seed: int

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def batch(self, count: int, side: int) -> Tensor:
        """The next ``count`` parts of each photograph, (N, 3, side, side)."""
        parts = torch.cat([self._part(picture, side) for picture in self.pictures for _ in range(count)])
        exponents = (0.4 * torch.randn(len(parts), 1, 1, 1, generator=self.generator)).exp()
        gains = (0.12 * torch.randn(len(parts), 3, 1, 1, generator=self.generator)).exp()
        return (parts**exponents * gains).clamp(0, 1)

    def _part(self, picture: Tensor, side: int) -> Tensor:
        top, left = (
            int(torch.randint(length - side + 1, (), generator=self.generator)) for length in picture.shape[-2:]
        )
        return picture[..., top : top + side, left : left + side]


def trained(network: StyleNetwork, steps: int) -> StyleNetwork:
    """A network after its training."""
    crops = Crops([reduced_to(photograph(name), SIDE) for name in TRAINED], seed=2)
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        before = crops.batch(TRAINED_PARTS, CROP)
        loss = (network(before) - style(before)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def decibels(result: Tensor, expected: Tensor) -> float:
    """Mean PSNR of photographs (B, 3, H, W)."""
    errors = (result.clamp(0, 1) - expected).square().mean((1, 2, 3)).clamp(min=1e-12)
    return float(-10 * errors.log10().mean())


def measure(quick: bool) -> Iterator[Figure]:
    """PSNR on photographs not trained on, of networks with curves, curves and a matrix, lattices, and both."""
    networks = {
        "curves alone": partial(StyleNetwork, curves=True),
        "curves and a matrix": partial(StyleNetwork, curves=True, matrix=True),
        f"weights of {LATTICES} lattices": partial(StyleNetwork, lattices=LATTICES),
        f"curves and weights of {LATTICES} lattices": partial(StyleNetwork, curves=True, lattices=LATTICES),
    }
    batches = {
        name: Crops([reduced_to(photograph(name), SIDE)], seed=6).batch(TESTED_PARTS, TEST_CROP) for name in REPORTED
    }
    for name, batch in batches.items():
        yield Figure(f"unedited, {name}", decibels(batch, style(batch)), unit="dB")
    means = []
    for kind, build in networks.items():
        with torch.random.fork_rng():
            torch.manual_seed(0)
            network = build()
        network = trained(network, QUICK_STEPS if quick else STEPS)
        with torch.no_grad():
            values = [decibels(network(batch), style(batch)) for batch in batches.values()]
        for name, value in zip(batches, values, strict=True):
            yield Figure(f"{kind}, {name}", value, unit="dB")
        means.append(sum(values) / len(values))
        # Lattices must pay for their size on photographs that they were not fitted to.
        limit = means[0] if "lattices" in kind and not quick else None
        yield Figure(f"{kind}, mean", means[-1], limit, "dB", at_most=False)
