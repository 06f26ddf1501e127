"""A sample of a picture's pixels for the sums that a filter consists of: rare ones first, and no gaps."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nlfilter_torch.core.blocks import CACHED
from nlfilter_torch.core.kernels.affinity import Affinity
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.newton import PixelScaling, scaling_from_moment
from nlfilter_torch.operator.spectrum import CUT
from nlfilter_torch.tiled import sampling
from nlfilter_torch.tiled.sampling import Image, Pilot, Report, Sample, patches_at, scaled_patches
from nlfilter_torch.tiled.sources import Picture
from nlfilter_torch.tiled.statistics import sum_up

SKETCHED = 16  # random projections; they tell squared lengths to a third
EVEN = 0.1  # share of a sample that is spread evenly over the picture


def sample_by_influence(
    picture: Picture, pilot: Pilot, image: Image, count: int, report: Report, *, spectral: bool
) -> list[Sample]:
    """About ``count`` pixels in several parts, rare ones more likely than common ones.

    A sum over all pixels is off most where few pixels make it up: an even sample of a million leaves the rarest patches
    of a photograph off by two grey levels and more. The influence of a pixel is its own share of what W makes of it,
    ``d^2 |u|^2``, 1 over the number of its likes; in proportion to it every kind of pixel gets as many members. What
    projects on eigenvectors (``spectral``) divides by small eigenvalues, and pixels that these depend on come in, too.
    """
    kernel, generator = pilot.kernel, np.random.default_rng(pilot.seed)
    size = kernel.patch_weights.shape[0]
    even = EVEN * count / picture.pixels
    influence = Influence.of(pilot, spectral=spectral)
    rate = _rate(influence(pilot.sample.features), float(pilot.sample.weights[0, 0]), even, count)
    recipe = (kernel.patch_weights, kernel.photometric_bandwidth, kernel.spatial_bandwidth)
    done: list[Sample] = []
    waiting: list[Sample] = []  # of single tiles, much smaller than a chunk
    for tile in picture.tiles(size // 2, picture.statistics_rows):
        report("Sampling", tile.start, picture.size[0])
        guide = reduce_channels(tile.pixels, kernel.guide_channels)
        features = kernel.features(tile.pixels, origin=tile.origin, halo=tile.halo)
        likely = (even + rate * influence(features)).clamp(max=1.0)
        chosen, counts = draw(likely, generator)
        patches, places = patches_at(guide, tile, chosen, size), chosen + tile.start * picture.size[1]
        values = image(tile.inner).flatten(2)[:, :, chosen]
        weights = (counts / likely[chosen]).to(picture.dtype)[None]
        waiting.append(Sample(scaled_patches(patches, places, picture, *recipe), values, weights))
        if sum(part.weights.numel() for part in waiting) >= sampling.CHUNK:
            done.append(Sample.together(waiting))
            waiting = []
    return [*done, Sample.together(waiting)] if waiting else done


def draw(rates: Tensor, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Draw pixels, each as often on average as its rate says, one from every stretch of pixels whose rates sum to 1.

    Pixels beside each other are alike, so that a sample without gaps and clusters has sums several times as exact as
    one of independent draws. The place within a stretch is random: a fixed one could meet the period of a texture.

    Args:
        rates: (n,) in (0, 1], float64. A pixel of rate 1 is drawn exactly once, any other twice at most.
        generator: of the places.

    Returns:
        The numbers (k,) of the drawn pixels, ascending, and how often each was drawn, (k,).

    Example:
        >>> draw(torch.tensor([1.0, 0.5, 0.5, 1.0], dtype=torch.float64), np.random.default_rng(0))
        (tensor([0, 2, 3]), tensor([1, 1, 1]))
    """
    certain = rates >= 1
    summed = (rates * ~certain).cumsum(0)
    ticks = np.arange(math.ceil(float(summed[-1])))
    places = torch.from_numpy(ticks + generator.random(len(ticks)))
    found = torch.searchsorted(summed, places[places < summed[-1]], right=True)
    counts = torch.bincount(found, minlength=len(rates)) + certain
    chosen = counts.nonzero().squeeze(1)
    return chosen, counts[chosen]


@dataclass(frozen=True)
class Influence:
    """How much single pixels matter to sums over all of them, roughly and without the whitening of every pixel.

    Lengths of M-vectors are estimated from a few random projections of them, which are projections of the affinities.

    Attributes:
        kernel: whose affinities they are.
        direction: (1, M, 1), whose product with the affinities of a pixel is ``u . t``.
        sketches: (J k, M): k random projections of u for every measure of length.
        scales: (J,): of the measures, which are added up.
    """

    kernel: Kernel
    direction: Tensor
    sketches: Tensor
    scales: Tensor

    @staticmethod
    def of(pilot: Pilot, *, spectral: bool) -> "Influence":
        """The influence on W, and as much again that on projections on its eigenvectors if they are needed."""
        kernel, generator = pilot.kernel, torch.Generator().manual_seed(pilot.seed)
        marks = kernel.landmarks.shape[2]
        measures = [torch.eye(marks, dtype=torch.float64)]
        if spectral:
            balancing = PixelScaling(pilot.balancing, kernel.completion == "diagonal")
            gram = sum_up(lambda: pilot.sample.blocks(kernel), balancing, 1).grams[0, 0]
            values, vectors = torch.linalg.eigh(gram)
            values = values + CUT[kernel.landmarks.dtype] * values[-1]  # what the pilot has not seen may well be there
            measures.append(values.rsqrt()[:, None] * vectors.mT)
        whitening = kernel.whitening[0].double()
        draws = torch.randn(SKETCHED, marks, generator=generator, dtype=torch.float64) / SKETCHED**0.5
        sketches = torch.cat([draws @ measure @ whitening for measure in measures]).to(kernel.landmarks)
        direction = (whitening.mT @ pilot.balancing).to(kernel.landmarks)  # u . t = c . direction
        influence = Influence(kernel, direction, sketches, torch.ones(len(measures)).to(sketches))
        lengths = influence.measure(pilot.sample.features)
        return replace(influence, scales=1 / lengths.mean(1))

    def __call__(self, features: Tensor) -> Tensor:
        """Of pixels with the features (1, D, n): (n,) in float64."""
        return self.scales.double() @ self.measure(features).double()

    def measure(self, features: Tensor) -> Tensor:
        """Squared lengths (J, n) of the pixels' columns of F: ``d^2 |u|^2``, and ``F^T G^-1 F`` if that is needed."""
        affinity = Affinity(self.kernel.landmarks, self.kernel.completion == "diagonal")
        found = []
        for part in features.split(CACHED, dim=2):
            near, _ = affinity(part, features.new_empty(1, self.direction.shape[1], part.shape[2]))
            lengths = (self.sketches @ near[0]).square().unflatten(0, (-1, SKETCHED)).sum(1)  # (J, n)
            scaling = scaling_from_moment(near, (1 - lengths[:1]).clamp(min=0.0), self.direction)
            found.append(scaling.square() * lengths)
        return torch.cat(found, dim=1)


def _rate(influence: Tensor, weight: float, even: float, count: int) -> float:
    """The factor of the influence at which about ``count`` pixels are drawn, from that of an even sample."""
    low, high = 0.0, 1 / max(float(influence.min()), 1e-12)
    for _ in range(60):
        middle = (low + high) / 2
        expected = weight * float((even + middle * influence).clamp(max=1.0).sum())
        low, high = (middle, high) if expected < count else (low, middle)
    return low
