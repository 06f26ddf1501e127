"""A picture to the kernel of its filter and to an even sample of its pixels, reading it once, by rows."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_choice, check_count, check_positive, warn
from nlfilter_torch.operator.bandwidth import bandwidth_of_gradient, gradients
from nlfilter_torch.operator.features import GuideChannels, pad_border, reduce_channels, unit_window
from nlfilter_torch.operator.kernel import Kernel
from nlfilter_torch.operator.landmarks import Sampling, candidate_pixels, condense, stratified
from nlfilter_torch.operator.nystrom import Completion, whitener
from nlfilter_torch.tiled.sources import Picture, Tile
from nlfilter_torch.tiled.statistics import Block, start_balancing

PILOT = 1 << 17  # pixels of the first sample: their factor, 52 MB at m = 100, is balanced in memory
CHUNK = 1 << 16  # pixels of a sample whose factor is there at once

Report = Callable[[str, int, int], None]
Image = Callable[[Tensor], Tensor]  # colours (1, C, H, W) to what is filtered


@dataclass(frozen=True)
class Sample:
    """Some pixels of a picture.

    Attributes:
        features: (1, D, n).
        image: (1, C, n), what is filtered.
        weights: (1, n), how many pixels each of them stands for.
    """

    features: Tensor
    image: Tensor
    weights: Tensor

    @staticmethod
    def together(parts: list["Sample"]) -> "Sample":
        """Several samples as one."""
        features, images, weights = zip(*((part.features, part.image, part.weights) for part in parts), strict=True)
        return Sample(torch.cat(features, dim=2), torch.cat(images, dim=2), torch.cat(weights, dim=1))

    def blocks(self, kernel: Kernel) -> Iterator[Block]:
        """Factor and diagonal of the sample, a chunk at a time."""
        for features, image, weights in zip(
            self.features.split(CHUNK, dim=2),
            self.image.split(CHUNK, dim=2),
            self.weights.split(CHUNK, dim=1),
            strict=True,
        ):
            yield Block(*kernel.factor(features), image, weights)


def all_blocks(picture: Picture, kernel: Kernel, image: Image, report: Report, stage: str) -> Iterator[Block]:
    """Factor and diagonal of every pixel of a picture."""
    margin = kernel.patch_weights.shape[0] // 2
    for tile in picture.tiles(margin, picture.statistics_rows):
        columns = kernel.columns(tile.pixels, origin=tile.origin, halo=tile.halo)
        report(stage, tile.start, picture.size[0])
        yield Block(*columns, image(tile.inner).flatten(2), torch.ones_like(columns[1]))


@dataclass(frozen=True)
class Pilot:
    """A first look at a picture: its kernel, an even sample of its pixels and the balancing that they suggest.

    Attributes:
        kernel: landmarks, bandwidths and window.
        sample: even over the picture.
        balancing: the moment t (1, M, 1) of balancing, as the sample has it.
        seed: for further samples.
    """

    kernel: Kernel
    sample: Sample
    balancing: Tensor
    seed: int


def take_pilot(
    picture: Picture,
    image: Image,
    report: Report,
    *,
    patch_size: int = 5,
    photometric_bandwidth: float | Literal["auto"] = "auto",
    spatial_bandwidth: float | None = None,
    num_landmarks: int = 100,
    landmarks: Sampling = "kmeans",
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "luminance",
    generator: torch.Generator | None = None,
) -> Pilot:
    """Bandwidth, landmarks and a first balancing, in one reading of the picture.

    Bandwidth and landmarks are those of :func:`nonlocal_operator`, to rounding.
    """
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    check_choice(landmarks, "landmarks", ("kmeans", "uniform", "random"))
    check_choice(completion, "completion", ("diagonal", "none"))
    check_count(num_landmarks, "num_landmarks")
    window = unit_window(patch_size, None).to(picture.dtype)
    if isinstance(photometric_bandwidth, str):
        check_choice(photometric_bandwidth, "photometric_bandwidth", ("auto",))
    else:
        check_positive(photometric_bandwidth, "photometric_bandwidth")
    if spatial_bandwidth is not None:
        check_positive(spatial_bandwidth, "spatial_bandwidth")
    if num_landmarks > picture.pixels:
        warn(
            f"num_landmarks must be at most the number of pixels, {picture.pixels}, got {num_landmarks}; "
            "using every pixel"
        )
        num_landmarks = picture.pixels

    generator = torch.Generator().manual_seed(0) if generator is None else generator
    candidates = candidate_pixels(picture.size, num_landmarks, landmarks, generator).cpu()
    rest = torch.Generator().manual_seed(int(candidates.sum()) % 2**32)  # the landmarks need what is in the generator
    even = stratified(picture.pixels, min(PILOT, picture.pixels), rest)
    wanted = torch.cat([candidates, even])
    patches, values = [], []
    slope = 0.0
    for tile, chosen in _visit(picture, max(patch_size // 2, 1), wanted.sort().values, report, "Looking"):
        guide = reduce_channels(tile.pixels, guide_channels)
        patches.append(patches_at(guide, tile, chosen, patch_size))
        values.append(image(tile.inner).flatten(2)[:, :, chosen])
        if photometric_bandwidth == "auto":
            slope += float(gradients(guide, tile.halo).double().mean((0, 1)).sum())
    if isinstance(photometric_bandwidth, str):
        photometric_bandwidth = float(bandwidth_of_gradient(torch.tensor(slope / picture.pixels)))
    order = torch.empty_like(wanted)
    order[wanted.argsort()] = torch.arange(len(wanted))  # place of each wanted pixel among those that were read
    recipe = (window, photometric_bandwidth, spatial_bandwidth)
    features = scaled_patches(torch.cat(patches, dim=2)[:, :, order], wanted, picture, *recipe)
    points = condense(features[:, :, : len(candidates)], num_landmarks, generator)
    kernel = Kernel(*recipe, guide_channels, points, whitener(points), completion)
    weight = picture.pixels / len(even)
    sample = Sample(
        features[:, :, len(candidates) :],
        torch.cat(values, dim=2)[:, :, order[len(candidates) :]],
        torch.full((1, len(even)), weight, dtype=picture.dtype),
    )
    return Pilot(kernel, sample, start_balancing(*kernel.factor(sample.features), weight), rest.initial_seed())


def _visit(picture: Picture, margin: int, pixels: Tensor, report: Report, stage: str) -> Iterator[tuple[Tile, Tensor]]:
    """All tiles of a pass, each with those of the sorted ``pixels`` that lie in it, as counted from its first one."""
    width, rows = picture.size[1], picture.statistics_rows
    for tile in picture.tiles(margin, rows):
        report(stage, tile.start, picture.size[0])
        bounds = torch.tensor([tile.start, tile.start + tile.stored.shape[0]]) * width
        first, last = torch.searchsorted(pixels, bounds).tolist()
        yield tile, pixels[first:last] - tile.start * width


def patches_at(guide: Tensor, tile: Tile, chosen: Tensor, size: int) -> Tensor:
    """The patches (1, C p^2, n), without weights, around some pixels of a tile with the guide (1, C, H, W)."""
    padded = pad_border(guide, size // 2)[..., tile.halo[0] :, :]
    columns, stride = guide.shape[-1], padded.shape[-1]
    corners = chosen // columns * stride + chosen % columns
    offsets = torch.arange(size)
    places = (offsets[:, None] * stride + offsets).reshape(-1, 1) + corners  # (p^2, n)
    return padded[0].flatten(1)[:, places].flatten(0, 1)[None]


def scaled_patches(
    patches: Tensor,
    pixels: Tensor,
    picture: Picture,
    window: Tensor,
    photometric_bandwidth: float | Tensor,
    spatial_bandwidth: float | Tensor | None,
) -> Tensor:
    """Features (1, D, n), as :func:`extract_features` gives them, from patches (1, C p^2, n) and pixels' indices."""
    channels = patches.shape[1] // window.numel()
    scale = (window / channels).sqrt() / torch.as_tensor(photometric_bandwidth, dtype=window.dtype)
    features = patches * scale.reshape(1, 1, -1, 1).expand(1, channels, -1, 1).reshape(1, -1, 1)
    if spatial_bandwidth is None:
        return features
    places = torch.stack([pixels // picture.size[1], pixels % picture.size[1]]).to(features)
    return torch.cat([features, places[None] / torch.as_tensor(spatial_bandwidth).to(features)], dim=1)
