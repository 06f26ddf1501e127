"""What sharpening costs in halos and noise, beside other methods: ``python -m benchmarks.sharpening``.

Four photographs in grey at 256x256, without noise and with white noise of 10 and 20 grey levels. The strength of every
method is set so that the gradient on strong edges (the steepest 4 % of pixels, measured along the clean photograph's
gradient) becomes 1.5 times as large. The measurements are

halo    mean overshoot near these edges: how far the result leaves the range of the clean photograph within 5 pixels,
        in grey levels;
noise   amplification of noise in flat regions; for clean photographs, of grain finer than 1.5 pixels.

With noise there are four realisations: edges and halo are measured on their mean, and noise is the deviation from it.
The bilateral and the guided filter have their best settings for this test, which leave edges in their detail: with
settings that preserve edges better they never reach the gain.

A second table shows the default and a strong amount as shipped, on these photographs or those of a folder reduced to a
short side of ``--side`` pixels, beside an unsharp mask (sigma 1.5) set to the same gain on each picture; with noise
there are two realisations. Overshoot is the 99th percentile near edges, and farther than 15 pixels from them are
measured

change  root mean square of the change, in grey levels;
coarse  growth of contrast at 4 to 12 pixels.
"""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.enhancers import SHARPENERS, band, gaussian
from benchmarks.harness import options, row, strength_of
from benchmarks.photographs import luminance, photograph, pictures
from nlfilter_torch import detail_layers, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo import sharpen

PICTURES = ("astronaut", "camera", "chelsea", "coffee")
NOISES = (0, 10, 20)  # grey levels
SIDE = 256
GAIN = 1.5
STRONG = 0.04  # share of pixels on strong edges
REACH = 5  # pixels around strong edges where halos are measured
FAR = 15  # distance in pixels from strong edges beyond which nothing should change
SHIPPED_NOISES = (0, 2, 5, 10)
AMOUNTS = (4.0, 8.0)  # the default, and a strong one
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
    def of(image: Tensor, noise: float, realisations: int = REALISATIONS) -> "Scene":
        """Create a scene from a photograph, with ``noise`` in grey levels."""
        clean = luminance(image)
        generator = torch.Generator().manual_seed(0)
        copies = torch.randn(realisations, 1, *clean.shape[2:], generator=generator)
        steepness = _gradient(gaussian(clean, 1.0)).norm(dim=1, keepdim=True)
        edges = steepness >= steepness.flatten().quantile(1 - STRONG)
        far = F.max_pool2d(edges.float(), 2 * REACH + 5, 1, REACH + 2) == 0
        activity = gaussian(clean.square(), 2.0) - gaussian(clean, 2.0).square()
        flat = far & (activity <= activity[far].median())
        return Scene(clean, clean + noise / 255 * copies if noise else clean, edges, flat)

    def edge_gain(self, result: Tensor) -> float:
        """Gradient on strong edges, relative to that of the clean photograph."""
        reference = _gradient(self.clean)
        direction = reference / reference.norm(dim=1, keepdim=True).clamp(min=1e-6)

        def slope(image: Tensor) -> Tensor:
            return (_gradient(image.mean(0, keepdim=True)) * direction).sum(1, keepdim=True)[self.edges].mean()

        return float(slope(result) / slope(self.clean))

    def overshoot(self, result: Tensor) -> Tensor:
        """Overshoot in grey levels at the pixels near strong edges."""
        window = (2 * REACH + 1, 1, REACH)
        highest, lowest = F.max_pool2d(self.clean, *window), -F.max_pool2d(-self.clean, *window)
        near = F.max_pool2d(self.edges.float(), *window) > 0
        mean = result.mean(0, keepdim=True)
        return 255 * torch.maximum(mean - highest, lowest - mean).clamp(min=0)[near]

    def far(self, result: Tensor) -> tuple[float, float]:
        """Change in grey levels, and growth of coarse contrast, far from strong edges; NaN if nothing is far."""
        far = F.max_pool2d(self.edges.float(), 2 * FAR + 1, 1, FAR) == 0
        if not far.any():
            return float("nan"), float("nan")
        before, after = self.noisy.mean(0, keepdim=True), result.mean(0, keepdim=True)
        contrast = [band(image, 4.0, 12.0)[far].square().mean().sqrt() for image in (before, after)]
        return float(255 * (after - before)[far].square().mean().sqrt()), float(contrast[1] / contrast[0])

    def noise_gain(self, result: Tensor) -> float:
        """Amplification of noise in flat regions."""
        return self._noise(result) / self._noise(self.noisy)

    def _noise(self, images: Tensor) -> float:
        if len(images) > 1:
            return float((images - images.mean(0))[self.flat.expand_as(images)].std())
        return float((images - gaussian(images, 1.5))[self.flat].std())


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
    masked = sharpen(noisy, amount=2.0, limits="none") - noisy  # linear in the amount, like all methods here
    added = {
        OURS: masked,
        "sliders a,a,a,1": held[0],
        "the same, residual 1": held[1],
        "sliders 1,a,a,1": layers[:, 1] + layers[:, 2],
        **{name: detail(noisy) for name, detail in SHARPENERS.items()},
    }
    return {name: lambda amount, detail=detail: noisy + amount * detail for name, detail in added.items()}


OURS = "sharpen"


def compare_shipped(images: dict[str, Tensor]) -> None:
    """Print what the amounts as shipped do, beside an unsharp mask of the same gain; means over photographs."""
    names = ("gain, mean", "least", "largest", "change", "coarse", "overshoot", "noise")
    print("\n" + row(f"as shipped, {len(images)} photographs", names, 11, 33))
    for noise in SHIPPED_NOISES:
        rows: dict[str, list[tuple[float, ...]]] = {}
        for image in images.values():
            scene = Scene.of(image, noise, realisations=2)
            detail = scene.noisy - gaussian(scene.noisy, 1.5)
            for amount in AMOUNTS:
                sharp = sharpen(scene.noisy, amount=amount)
                gain = scene.edge_gain(sharp)
                # The gain is linear in the picture.
                strength = (gain - scene.edge_gain(scene.noisy)) / scene.edge_gain(detail)
                masked = scene.noisy + strength * detail
                for name, result in ((f"sharpen, amount {amount:g}", sharp), (f"unsharp like {amount:g}", masked)):
                    overshoot = float(scene.overshoot(result).quantile(0.99))
                    rows.setdefault(name, []).append(
                        (scene.edge_gain(result), *scene.far(result), overshoot, scene.noise_gain(result))
                    )
        for name, values in rows.items():
            table = torch.tensor(values)
            gains = table[:, 0]
            cells = [gains.mean(), gains.amin(), gains.amax(), *table[:, 1:].nanmean(0)]
            print(row(f"noise {noise:2}: {name}", (f"{float(cell):.2f}" for cell in cells), 11, 33), flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Print a table for each noise level, and a summary."""
    parser = options("sharpening", __doc__, "two photographs at 64x64")
    parser.add_argument("--pictures", type=Path, help="folder of photographs; prints the table of amounts only")
    parser.add_argument("--side", type=int, default=SIDE, help="short side in pixels to which they are reduced")
    chosen = parser.parse_args(arguments)
    if chosen.pictures is not None:
        compare_shipped(pictures(chosen.pictures, chosen.side, ()))
        return
    names, side = (PICTURES[:2], 64) if chosen.quick else (PICTURES, SIDE)
    images = {name: photograph(name, side, side) for name in names}
    print(f"gradient on strong edges times {GAIN}, {side}x{side}: halo in grey levels / noise gain")
    for noise in NOISES:
        figures: dict[str, list[tuple[float, float] | None]] = {}
        for image in images.values():
            scene = Scene.of(image, noise)
            for method, strength in methods(scene).items():
                reached = strength_of(lambda amount: scene.edge_gain(strength(amount)), GAIN, STRONGEST)  # noqa: B023
                result = None if reached is None else strength(reached)
                figure = None if result is None else (float(scene.overshoot(result).mean()), scene.noise_gain(result))
                figures.setdefault(method, []).append(figure)
        print("\n" + row(f"noise of {noise} levels" if noise else "as they are", (*names, "mean"), 15))
        for method, told in figures.items():
            known = [cell for cell in told if cell is not None]
            means = [tuple(map(statistics.mean, zip(*known, strict=True)))] if len(known) == len(told) else []
            cells = ["not reached" if cell is None else f"{cell[0]:.1f} / {cell[1]:.2f}" for cell in (*told, *means)]
            print(row(method, cells, 15), flush=True)
        if not chosen.quick:
            print(verdict(figures, names))
    compare_shipped(images)


def verdict(figures: dict[str, list[tuple[float, float] | None]], names: tuple[str, ...]) -> str:
    """Count where the library's sharpening has the lowest noise gain, and list where a peer is better in both."""
    least, beaten = 0, []
    for i, name in enumerate(names):
        own = figures[OURS][i]
        peers = {method: figures[method][i] for method in SHARPENERS}
        if own is None:
            beaten.append(name)
            continue
        reached = {method: peer for method, peer in peers.items() if peer is not None}
        least += all(own[1] < peer[1] for peer in reached.values())
        beaten += [f"{method} on {name}" for method, peer in reached.items() if peer[0] < own[0] and peer[1] < own[1]]
    return (
        f"{OURS}: less noise gain than every peer on {least} of {len(names)}; "
        f"better in halo and noise at once: {', '.join(beaten) or 'none'}"
    )


if __name__ == "__main__":
    main()
