"""A scan of a brain beside 3-D nonlocal means, and diffusion coordinates of points beside SpectralEmbedding.

The parameters of both denoisers are chosen on the lower slices of the template of nilearn (MNI152, T1), and the figures
are those of the upper ones, with other noise. Points are Swiss rolls of scikit-learn with seeds that nothing was chosen
on.
"""

import math
import time
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.denoising.cases import psnr
from benchmarks.harness import Figure, forget_peak, resident
from nlfilter_torch import NonlocalOperator, fit_alpha, nonlocal_operator, operator_from_features, polynomial_filter

NOISE = 0.08
BANDWIDTH = 4.0  # of the Swiss roll, whose turns are about 6 apart
COORDINATES = 3
Points = NDArray[np.float64]


def measure(quick: bool) -> Iterator[Figure]:
    """Figures of points, then of a volume."""
    yield from cloud(quick)  # first, as memory that the process keeps would not count
    yield from volume(quick)


def timed(call: Callable[[], Tensor], repeats: int = 1) -> tuple[Tensor, float]:
    """Result and least seconds of some calls."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - start)
    return result, min(seconds)


def volume(quick: bool) -> Iterator[Figure]:
    """PSNR and time of denoising a scan."""
    from nilearn.datasets import load_mni152_template

    template = torch.from_numpy(load_mni152_template(resolution=4 if quick else 2).get_fdata()).float()
    height, width, depth = (int(0.2 * length) for length in template.shape)
    inner = template[height:-height, width:-width][None, None]
    chosen, clean = inner[..., depth : 2 * depth + depth // 2], inner[..., 2 * depth + depth // 2 : 4 * depth]
    before, noisy = (
        planes + NOISE * torch.randn(planes.shape, generator=torch.Generator().manual_seed(seed))
        for seed, planes in ((1, chosen), (2, clean))
    )
    ours = best(before, chosen, sliders, product((1.1, 1.5), (100, 200)))
    theirs = best(before, chosen, nonlocal_means, product((3, 5), (3,) if quick else (3, 5), (0.4, 0.6, 0.8)))
    alpha = fit_alpha(operator(before, *ours), before, chosen)
    polynomial_filter(operator(noisy[..., :4], *ours), noisy[..., :4], alpha)  # imports and first calls
    result, seconds = timed(lambda: polynomial_filter(operator(noisy, *ours), noisy, alpha), 3)
    peer, peer_seconds = timed(lambda: nonlocal_means(noisy, clean, *theirs), 3)
    name = f"scan of {'x'.join(map(str, clean.shape[2:]))} voxels, noise {NOISE}"
    yield Figure(f"{name}: before", psnr(noisy, clean), None, "dB")
    yield Figure(f"{name}: 3-D nonlocal means of scikit-image", psnr(peer, clean), None, "dB")
    limit = None if quick else psnr(peer, clean)
    yield Figure(f"{name}: operator and sliders", psnr(result, clean), limit, "dB", at_most=False)
    yield Figure(f"{name}: time of scikit-image", peer_seconds, None, "s")
    yield Figure(f"{name}: time of operator and sliders", seconds, None if quick else peer_seconds, "s")


def best(
    noisy: Tensor, clean: Tensor, denoise: Callable[..., Tensor], candidates: Iterator[tuple[Any, ...]]
) -> tuple[Any, ...]:
    """The parameters with which a volume is denoised best."""
    return max(candidates, key=lambda parameters: psnr(denoise(noisy, clean, *parameters), clean))


def operator(noisy: Tensor, bandwidth: float, landmarks: int) -> NonlocalOperator:
    """The filter of a volume, with the bandwidth in units of the noise."""
    return nonlocal_operator(noisy, patch_size=3, photometric_bandwidth=bandwidth * NOISE, num_landmarks=landmarks)


def sliders(noisy: Tensor, clean: Tensor, bandwidth: float, landmarks: int) -> Tensor:
    """Denoise with the sliders that suit a volume best."""
    w = operator(noisy, bandwidth, landmarks)
    return polynomial_filter(w, noisy, fit_alpha(w, noisy, clean))


def nonlocal_means(noisy: Tensor, _: Tensor, patch: int, distance: int, bandwidth: float) -> Tensor:
    """Denoise by scikit-image, which is told the noise."""
    from skimage.restoration import denoise_nl_means

    result = denoise_nl_means(
        noisy[0, 0].numpy(), patch_size=patch, patch_distance=distance, h=bandwidth * NOISE, sigma=NOISE
    )
    return torch.from_numpy(result)[None, None]


def cloud(quick: bool) -> Iterator[Figure]:
    """Time, memory and angles of the coordinates of points."""
    from sklearn.manifold import SpectralEmbedding

    count = 600 if quick else 5000
    points = roll(count, seed=3)
    embedding = SpectralEmbedding(COORDINATES, affinity="rbf", gamma=BANDWIDTH**-2, random_state=0)
    embedding.fit_transform(points[:100])  # imports, whose memory does not count
    coordinates(points[:300], 50)
    (_, seconds), memory = peak(lambda: timed(lambda: coordinates(points, 200)))
    (peer, peer_seconds), peer_memory = peak(lambda: timed(lambda: torch.from_numpy(embedding.fit_transform(points))))
    yield Figure(f"{count} points: time of SpectralEmbedding", peer_seconds, None, "s")
    yield Figure(f"{count} points: time of operator and eigenvectors", seconds, None if quick else peer_seconds, "s")
    yield Figure(f"{count} points: memory of SpectralEmbedding", peer_memory, None, "MiB")
    limit = None if quick else peer_memory
    yield Figure(f"{count} points: memory of operator and eigenvectors", memory, limit, "MiB")
    yield Figure(
        f"{count} points: angle between the two subspaces", angle(coordinates(points, 200), peer), None, "degrees"
    )
    yield from angles(300 if quick else 2000)
    if not quick:
        many = roll(200_000, seed=5)
        (_, seconds), memory = peak(lambda: timed(lambda: coordinates(many, 200)))
        yield Figure("200000 points: time of operator and eigenvectors", seconds, None, "s")
        yield Figure("200000 points: memory of operator and eigenvectors", memory, None, "MiB")


def angles(count: int) -> Iterator[Figure]:
    """Angles to the exact eigenvectors of the dense W of the same points, and of points that are added."""
    points, seen = roll(count, seed=4), 4 * count // 5
    exact = dense_eigenvectors(points)
    limit = 1.0 if count >= 2000 else None
    yield Figure(
        f"{count} points: angle to the exact subspace", angle(coordinates(points, 200), exact), limit, "degrees"
    )
    w = operator_from_features(features(points[:seen]), size=(seen,), num_landmarks=200)
    extended = w.spectrum(rank=COORDINATES + 1).eigenvectors_at(w.at(features(points[seen:])))[0, 1:].mT
    name = f"{count - seen} points that are added to {seen}: angle to the exact subspace of all"
    yield Figure(name, angle(extended, exact[seen:]), None, "degrees")


def roll(count: int, seed: int) -> Points:
    """Points (N, 3) of a Swiss roll."""
    from sklearn.datasets import make_swiss_roll

    return make_swiss_roll(count, random_state=seed)[0]


def features(points: Points) -> Tensor:
    """Points (N, 3), divided by the bandwidth: (1, 3, N)."""
    return torch.from_numpy(points.T[None]) / BANDWIDTH


def coordinates(points: Points, landmarks: int) -> Tensor:
    """The leading eigenvectors (N, K) of W, without the constant one."""
    w = operator_from_features(features(points), size=(len(points),), num_landmarks=landmarks)
    return w.spectrum(rank=COORDINATES + 1).eigenvectors[0, 1:].flatten(1).mT


def dense_eigenvectors(points: Points) -> Tensor:
    """The leading eigenvectors (N, K) of the dense W, balanced to rounding, without the constant one."""
    x = features(points)[0].mT
    kernel = (-torch.cdist(x, x).square()).exp()
    scaling = kernel.sum(1).rsqrt()
    for _ in range(200):
        scaling = (scaling / (kernel @ scaling)).sqrt()
    vectors = torch.linalg.eigh(scaling[:, None] * kernel * scaling).eigenvectors
    return vectors.flip(1)[:, 1 : COORDINATES + 1]


def angle(first: Tensor, second: Tensor) -> float:
    """The largest angle between the spans of the columns of two matrices, in degrees."""
    bases = (torch.linalg.qr(matrix.double()).Q for matrix in (first, second))
    left, right = bases
    return math.degrees(math.asin(min(1.0, float(torch.linalg.matrix_norm(right - left @ (left.mT @ right), 2)))))


def peak(call: Callable[[], tuple[Tensor, float]]) -> tuple[tuple[Tensor, float], float]:
    """Result of a call, and the memory in MiB that it takes at its peak."""
    start = resident("VmRSS")
    forget_peak()
    result = call()
    return result, resident("VmHWM") - start
