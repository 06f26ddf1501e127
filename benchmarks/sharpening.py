"""Halo and noise of sharpening at equal gain: ``python -m benchmarks.sharpening [--quick]``.

Four photographs in grey at 256x256, without noise and with white noise of 10 and 20 grey levels. The strength of every
method is set so that the gradient on strong edges (the steepest 4 % of pixels, measured along the clean photograph's
gradient) becomes 1.5 times as large. The measurements are

halo    mean overshoot near these edges: how far the result leaves the range of the clean photograph within 5 pixels,
        in grey levels;
noise   amplification of noise in flat regions; for clean photographs, of grain finer than 1.5 pixels.

With noise there are four realisations: edges and halo are measured on their mean, and noise is the deviation from it.
The bilateral and the guided filter have their best settings for this test, which leave edges in their detail: with
settings that preserve edges better they never reach the gain.
"""

import argparse
import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks import unsharp
from benchmarks.photographs import photograph
from nlfilter_torch import detail_layers, nonlocal_operator, polynomial_filter, sharpen
from nlfilter_torch.operator.features import reduce_channels

PICTURES = ("astronaut", "camera", "chelsea", "coffee")
NOISES = (0, 10, 20)  # grey levels
SIDE = 256
GAIN = 1.5
STRONG = 0.04  # share of pixels on strong edges
REACH = 5  # pixels around strong edges where halos are measured
REALISATIONS = 4
STRONGEST = 300.0  # a method that needs more than this does not reach the gain

Strength = Callable[[float], Tensor]  # amount to the sharpened photograph; 0 leaves it unchanged


@dataclass(frozen=True)
class Scene:
    """A clean photograph, noisy copies of it, and the areas to measure in."""

    clean: Tensor
    noisy: Tensor
    edges: Tensor
    flat: Tensor

    @staticmethod
    def of(name: str, noise: float, side: int) -> "Scene":
        """Create a scene from a photograph, reduced to ``side``, with ``noise`` in grey levels."""
        clean = reduce_channels(photograph(name, side, side), "luminance")
        generator = torch.Generator().manual_seed(0)
        copies = torch.randn(REALISATIONS, 1, side, side, generator=generator)
        steepness = _gradient(unsharp.gaussian(clean, 1.0)).norm(dim=1, keepdim=True)
        edges = steepness >= steepness.flatten().quantile(1 - STRONG)
        far = F.max_pool2d(edges.float(), 2 * REACH + 5, 1, REACH + 2) == 0
        activity = unsharp.gaussian(clean.square(), 2.0) - unsharp.gaussian(clean, 2.0).square()
        flat = far & (activity <= activity[far].median())
        return Scene(clean, clean + noise / 255 * copies if noise else clean, edges, flat)

    def edge_gain(self, result: Tensor) -> float:
        """Gradient on strong edges, relative to that of the clean photograph."""
        reference = _gradient(self.clean)
        direction = reference / reference.norm(dim=1, keepdim=True).clamp(min=1e-6)

        def slope(image: Tensor) -> Tensor:
            return (_gradient(image.mean(0, keepdim=True)) * direction).sum(1, keepdim=True)[self.edges].mean()

        return float(slope(result) / slope(self.clean))

    def halo(self, result: Tensor) -> float:
        """Overshoot near strong edges in grey levels."""
        window = (2 * REACH + 1, 1, REACH)
        highest, lowest = F.max_pool2d(self.clean, *window), -F.max_pool2d(-self.clean, *window)
        near = F.max_pool2d(self.edges.float(), *window) > 0
        mean = result.mean(0, keepdim=True)
        return float(255 * torch.maximum(mean - highest, lowest - mean).clamp(min=0)[near].mean())

    def noise_gain(self, result: Tensor) -> float:
        """Amplification of noise in flat regions."""
        return self._noise(result) / self._noise(self.noisy)

    def _noise(self, images: Tensor) -> float:
        if len(images) > 1:
            return float((images - images.mean(0))[self.flat.expand_as(images)].std())
        return float((images - unsharp.gaussian(images, 1.5))[self.flat].std())


def _gradient(image: Tensor) -> Tensor:
    from kornia.filters import spatial_gradient

    return spatial_gradient(image)[:, 0]


def methods(scene: Scene) -> dict[str, Strength]:
    """All methods that are compared, as functions of their strength."""
    noisy = scene.noisy
    operator = nonlocal_operator(noisy)
    layers = detail_layers(operator, noisy)
    held = [
        polynomial_filter(operator, noisy, torch.tensor([2.0, 2.0, 2.0, 1.0]), residual=r) - noisy for r in (None, 1.0)
    ]
    middle = sharpen(noisy, amount=2.0, limits="none") - noisy  # linear in the amount, like all methods here
    added = {
        "sharpen (softened guide)": middle,
        "sliders a,a,a,1": held[0],
        "the same, residual 1": held[1],
        "sliders 1,a,a,1": layers[:, 1] + layers[:, 2],
        "unsharp, sigma 1": unsharp.unsharp(noisy, 1.0),
        "unsharp, sigma 2": unsharp.unsharp(noisy, 2.0),
        "unsharp, 1.2 to 3": unsharp.band(noisy, 1.2, 3.0),
        "adaptive unsharp [12]": unsharp.adaptive(noisy),
        "bilateral, 0.2": unsharp.bilateral(noisy, 0.2),
        "guided, 0.01": unsharp.guided(noisy, 0.01),
    }
    return {name: lambda amount, detail=detail: noisy + amount * detail for name, detail in added.items()}


PEERS = (
    "unsharp, sigma 1",
    "unsharp, sigma 2",
    "unsharp, 1.2 to 3",
    "adaptive unsharp [12]",
    "bilateral, 0.2",
    "guided, 0.01",
)
OURS = "sharpen (softened guide)"


def reach_gain(scene: Scene, strength: Strength) -> Tensor | None:
    """Find the result with the gain on strong edges, or None if the method does not reach it."""
    low, high = 0.0, 1.0
    while scene.edge_gain(strength(high)) < GAIN:
        low, high = high, 2 * high
        if high > STRONGEST:
            return None
    for _ in range(16):
        middle = (low + high) / 2
        low, high = (middle, high) if scene.edge_gain(strength(middle)) < GAIN else (low, middle)
    return strength(high)


def main(arguments: list[str] | None = None) -> None:
    """Print a table for each noise level, and a summary."""
    parser = argparse.ArgumentParser(description="Halo and noise of sharpening to one gain.")
    parser.add_argument("--quick", action="store_true", help="two photographs at 64x64, to check that it runs")
    options = parser.parse_args(arguments)
    pictures, side = (PICTURES[:2], 64) if options.quick else (PICTURES, SIDE)
    print(f"gradient on strong edges times {GAIN}, {side}x{side}: halo in grey levels / noise gain")
    for noise in NOISES:
        figures: dict[str, list[tuple[float, float] | None]] = {}
        for name in pictures:
            scene = Scene.of(name, noise, side)
            for method, strength in methods(scene).items():
                result = reach_gain(scene, strength)
                figure = None if result is None else (scene.halo(result), scene.noise_gain(result))
                figures.setdefault(method, []).append(figure)
        title = f"noise of {noise} levels" if noise else "as they are"
        print(f"\n{title:26}" + "".join(f"{name:>15}" for name in pictures) + f"{'mean':>15}")
        for method, row in figures.items():
            cells = ["not reached" if cell is None else f"{cell[0]:.1f} / {cell[1]:.2f}" for cell in row]
            known = [cell for cell in row if cell is not None]
            means = [statistics.mean(column) for column in zip(*known, strict=True)] if len(known) == len(row) else None
            cells.append("" if means is None else f"{means[0]:.1f} / {means[1]:.2f}")
            print(f"{method:26}" + "".join(f"{cell:>15}" for cell in cells), flush=True)
        if not options.quick:
            print(verdict(figures, pictures))


def verdict(figures: dict[str, list[tuple[float, float] | None]], pictures: tuple[str, ...]) -> str:
    """Count where the library's sharpening has the lowest noise gain, and list where a peer is better in both."""
    least, beaten = 0, []
    for i, name in enumerate(pictures):
        own = figures[OURS][i]
        peers = {method: figures[method][i] for method in PEERS}
        if own is None:
            beaten.append(name)
            continue
        reached = {method: peer for method, peer in peers.items() if peer is not None}
        least += all(own[1] < peer[1] for peer in reached.values())
        beaten += [f"{method} on {name}" for method, peer in reached.items() if peer[0] < own[0] and peer[1] < own[1]]
    return (
        f"{OURS}: less noise gain than every peer on {least} of {len(pictures)}; "
        f"better in halo and noise at once: {', '.join(beaten) or 'none'}"
    )


if __name__ == "__main__":
    main()
