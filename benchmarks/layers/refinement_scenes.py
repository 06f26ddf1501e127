"""Composites of several classes, with the coarse logits that a network of stride 8 might give, and their scores."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.composites import blob, crop

CLASSES, STRIDE = 5, 8
SMALLEST = 0.01  # area of an object, as a share of the image
WRONG, BY = 4, 2.5  # number of cells of 2x2 coarse pixels with a wrong class, and how much is added to its logit


@dataclass(frozen=True)
class Scene:
    """An image with four objects from other photographs on a background.

    Attributes:
        image: (1, 3, H, W).
        truth: labels, (1, H, W).
        logits: (1, 5, H, W), coarse, shifted, noisy, and wrong in places.
    """

    image: Tensor
    truth: Tensor
    logits: Tensor


def scene(seed: int, images: dict[str, Tensor], size: tuple[int, int]) -> Scene:
    """A scene from photographs (1, 3, H, W), reproducible from its seed."""
    random, names = np.random.default_rng(seed), sorted(images)
    order = random.choice(len(names), CLASSES, replace=len(names) < CLASSES)
    image = crop(images[names[order[0]]], (0.6, 1.0), random, size)
    truth = torch.zeros(size, dtype=torch.long)
    for label in range(1, CLASSES):
        alpha = torch.zeros(size)
        while (alpha > 0.5).float().mean() <= SMALLEST:
            middle = (size[0] * random.uniform(0.15, 0.85), size[1] * random.uniform(0.15, 0.85))
            alpha = torch.from_numpy(blob(random, size, size[0] * random.uniform(0.12, 0.24), middle))
        image = alpha * crop(images[names[order[label]]], (0.3, 0.7), random, size) + (1 - alpha) * image
        truth[alpha > 0.5] = label
    noise = torch.from_numpy(random.normal(0, 1.5 / 255, image.shape).astype(np.float32))
    return Scene((image + noise).clamp(0, 1), truth[None], coarse_logits(truth, random))


def coarse_logits(truth: Tensor, random: np.random.Generator) -> Tensor:
    """Logits (1, 5, H, W) of labels (H, W): moved by up to 3 pixels, averaged over cells, noisy, wrong in places."""
    down, right = random.integers(-3, 4, 2)
    onehot = F.one_hot(truth, CLASSES).permute(2, 0, 1)[None].float()
    coarse = F.avg_pool2d(torch.roll(onehot, (int(down), int(right)), (2, 3)), STRIDE)
    logits = 4 * coarse + torch.from_numpy(random.normal(0, 0.7, coarse.shape).astype(np.float32))
    height, width = logits.shape[-2:]
    for _ in range(WRONG):
        top, left = random.integers(0, height - 2), random.integers(0, width - 2)
        logits[:, random.integers(CLASSES), top : top + 2, left : left + 2] += BY
    return F.interpolate(logits, tuple(truth.shape), mode="bilinear", align_corners=False)


def mean_iou(result: Tensor, truth: Tensor) -> float:
    """Mean intersection over union of logits or probabilities (1, K, H, W), over the classes that are there."""
    labels, scores = result.argmax(1), []
    for label in truth.unique():
        here, there = labels == label, truth == label
        scores.append(float((here & there).sum() / (here | there).sum()))
    return sum(scores) / len(scores)


def opencv_guided(probabilities: Tensor, image: Tensor, radius: int, epsilon: float) -> Tensor:
    """OpenCV's guided filter of each class."""
    guide = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy() * 255)
    planes = [plane.numpy() for plane in probabilities[0]]
    # In units of 255, as for 8-bit pictures.
    filtered = [cv2.ximgproc.guidedFilter(guide, plane, radius, epsilon * 255**2) for plane in planes]
    return torch.from_numpy(np.stack(filtered))[None]
