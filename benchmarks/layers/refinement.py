"""Refinement of coarse logits beside kornia's and OpenCV's filters and a dense CRF: mIoU, time, memory, bandwidths.

``--pictures FOLDER`` measures on other photographs. The settings of all
methods were chosen on scenes of the photographs ``benchmarks.photographs.CHOOSING``. The dense CRF is left out if
pydensecrf cannot be imported: its last release compiles once ``eigen.cpp`` and ``densecrf.cpp`` are deleted.
"""

import ctypes
import importlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import kornia.filters
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.composites import FIRST_SEED, sources
from benchmarks.harness import Figure, peak, seconds
from benchmarks.layers.refinement_scenes import CLASSES, Scene, mean_iou, opencv_guided, scene
from nlfilter_torch import NonlocalFilter, Refine, refine
from nlfilter_torch.filtering.refine import FILTER, FLOOR, MARGIN, build_operator

SIZE, QUICK_SIZE = (192, 192), (48, 48)
SCENES = 12
FACTORS = (0.1, 0.3, 3.0, 10.0)  # of the bandwidths that refine chooses
MIOU = 0.929  # of five mean-field steps, as the issue states it
Method = Callable[[Tensor, Tensor], Tensor]  # of logits and image


def dense_crf(logits: Tensor, image: Tensor) -> Tensor:
    """Five steps of pydensecrf with a Gaussian and a bilateral term."""
    model = importlib.import_module("pydensecrf.densecrf").DenseCRF2D(logits.shape[3], logits.shape[2], CLASSES)
    model.setUnaryEnergy(np.ascontiguousarray(-logits.log_softmax(1)[0].flatten(1).numpy()))
    model.addPairwiseGaussian(sxy=3, compat=3)
    pixels = (image[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    model.addPairwiseBilateral(sxy=16, srgb=13, rgbim=np.ascontiguousarray(pixels), compat=5)
    return torch.from_numpy(np.array(model.inference(5), dtype=np.float32)).view_as(logits)


def joint_bilateral(logits: Tensor, image: Tensor) -> Tensor:
    """Kornia's joint bilateral filter of the probabilities."""
    return kornia.filters.joint_bilateral_blur(logits.softmax(1), image, (31, 31), 0.07, (10.0, 10.0))


def guided(logits: Tensor, image: Tensor) -> Tensor:
    """Kornia's guided filter of the probabilities."""
    return kornia.filters.guided_blur(image, logits.softmax(1), (21, 21), 1e-4)


def filtered(layer: NonlocalFilter, logits: Tensor, image: Tensor) -> Tensor:
    """The probabilities, filtered by the layer with the image as guide."""
    return layer(logits.softmax(1), guide=image)


def methods() -> dict[str, Method]:
    """All methods by name; those of the library first."""
    layer = NonlocalFilter(
        (0.0, 0.5, 1.0, 1.0),
        learn=(),
        patch_size=1,
        photometric_bandwidth=0.06,
        spatial_bandwidth=12.0,
        num_landmarks=250,
        guide_channels="all",
    )
    known: dict[str, Method] = {
        "refine": lambda logits, image: refine(logits, image),
        "refine, 400 landmarks": lambda logits, image: refine(logits, image, num_landmarks=400),
        "NonlocalFilter on probabilities": partial(filtered, layer),
        "kornia joint bilateral 31x31": joint_bilateral,
        "kornia guided 21x21": guided,
        "OpenCV guided, radius 12": lambda logits, image: opencv_guided(logits.softmax(1), image, 12, 1e-4),
    }
    try:
        importlib.import_module("pydensecrf.densecrf")
    except ImportError:
        return known
    return known | {"pydensecrf, five steps": dense_crf}


@torch.no_grad()
def measured(method: Method, scenes: list[Scene]) -> tuple[float, float, float]:
    """Mean mIoU of scenes, milliseconds of one, and memory in MiB, after a call that is not counted."""
    results: list[Tensor] = []
    method(scenes[0].logits, scenes[0].image)
    ctypes.CDLL(None).malloc_trim(0)  # memory that was freed counts again
    memory = peak(lambda: method(scenes[0].logits, scenes[0].image))
    taken = seconds(lambda: results.extend(method(each.logits, each.image) for each in scenes))
    scores = [mean_iou(result, each.truth) for result, each in zip(results, scenes, strict=True)]
    return sum(scores) / len(scores), 1e3 * taken / len(scenes), memory


def compared(scenes: list[Scene], limit: float | None) -> Iterator[Figure]:
    """Quality, time and memory of all methods."""
    start = sum(mean_iou(each.logits, each.truth) for each in scenes) / len(scenes)
    yield Figure("mIoU of the coarse logits", start)
    for name, method in methods().items():
        score, milliseconds, memory = measured(method, scenes)
        yield Figure(f"mIoU of {name}", score, limit if name == "refine" else None, at_most=False)
        yield Figure(f"  milliseconds of {name}", milliseconds, unit="ms")
        yield Figure(f"  memory of {name}", memory, unit="MiB")


def chosen_bandwidths(each: Scene) -> tuple[float, float]:
    """The photometric and the spatial bandwidth that refine chooses for a scene."""
    scale = MARGIN / float(_margin(each.logits))
    recipe = build_operator(each.image, (scale * each.logits).log_softmax(1), None, FILTER).kernel.recipe
    spatial = recipe.spatial_bandwidth
    assert spatial is not None
    return float(recipe.photometric_bandwidth), float(spatial[0])


def _margin(logits: Tensor) -> Tensor:
    """Mean difference between the largest and the second logit."""
    highest = logits.topk(2, dim=1).values
    return (highest[:, 0] - highest[:, 1]).mean().clamp(min=FLOOR)


@torch.no_grad()
def over_bandwidths(scenes: list[Scene], limit: float | None) -> Iterator[Figure]:
    """Change of mIoU by refinement with bandwidths that are too small or too large."""
    for which in ("photometric", "spatial", "both"):
        for factor in FACTORS:
            changes, uncautious = [], []
            for each in scenes:
                photometric, spatial = chosen_bandwidths(each)
                bandwidths = {
                    "photometric_bandwidth": photometric * (1.0 if which == "spatial" else factor),
                    "spatial_bandwidth": spatial * (1.0 if which == "photometric" else factor),
                }
                before = mean_iou(each.logits, each.truth)
                changes.append(mean_iou(refine(each.logits, each.image, **bandwidths), each.truth) - before)
                plain = refine(each.logits, each.image, caution=None, **bandwidths)
                uncautious.append(mean_iou(plain, each.truth) - before)
            name = f"{which} bandwidth{'s' if which == 'both' else ''} times {factor:g}: change of mIoU"
            yield Figure(name, sum(changes) / len(changes), limit, at_most=False)
            yield Figure("  without caution", sum(uncautious) / len(uncautious))


def trained(scenes: list[Scene], held_out: list[Scene], steps: int) -> Iterator[Figure]:
    """The mIoU of the layer after learning strength, margin and bandwidths on some scenes, on others."""
    layer = Refine(
        photometric_bandwidth=0.06,
        spatial_bandwidth=12.0,
        caution=None,
        learn=("strength", "margin", "photometric_bandwidth", "spatial_bandwidth"),
    )
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.05)
    for step in range(steps):
        each = scenes[step % len(scenes)]
        loss = F.cross_entropy(layer(each.logits, each.image), each.truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        scores = [mean_iou(layer(each.logits, each.image), each.truth) for each in held_out]
    yield Figure(f"mIoU of the layer after {steps} steps on other photographs", sum(scores) / len(scores))


def measure(quick: bool, pictures: Path | None = None) -> Iterator[Figure]:
    """All figures, on scenes of the photographs of a folder or of ``benchmarks.photographs.REPORTING``."""
    images, count, size = sources(pictures, "reporting"), 1 if quick else SCENES, QUICK_SIZE if quick else SIZE
    first = FIRST_SEED["reporting"]
    scenes = [scene(seed, images, size) for seed in range(first, first + count)]
    yield from compared(scenes, MIOU if count > 1 else None)
    yield from over_bandwidths(scenes[:6], 0.0 if count > 1 else None)
    training = [scene(seed, sources(None, "choosing"), size) for seed in range(min(count, 6))]
    yield from trained(training, scenes, 30 if count > 1 else 1)
