"""Other methods for masks from scribbles; each takes an image (1, 3, H, W) and two masks (1, 1, H, W) of scribbles."""

import os
import warnings
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import diags
from scipy.sparse.linalg import cg
from skimage.color import rgb2lab
from skimage.segmentation import random_walker
from torch import Tensor

from nlfilter_torch import diffusion_mask, nonlocal_operator, propagate_strokes
from nlfilter_torch.photo.picture.colour import colour_guide

Mask = Callable[[Tensor, Tensor, Tensor], Tensor]
COMPONENTS, FLOOR = 5, 4.0  # number of Gaussians in a mixture, and their smallest variance in squared Lab units


def _array(image: Tensor) -> NDArray[np.float64]:
    return image[0].permute(1, 2, 0).double().numpy()


def _seeds(inside: Tensor, outside: Tensor) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    return inside[0, 0].numpy() > 0, outside[0, 0].numpy() > 0


def _tensor(alpha: Any) -> Tensor:
    return torch.from_numpy(np.clip(alpha, 0, 1).astype(np.float32))[None, None]


def closed_form(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """Closed-form matting with the scribbles as the trimap."""
    front, back = _seeds(inside, outside)
    # Not estimate_alpha_cf: its preconditioner fails on trimaps with so few known pixels.
    known = np.where(front | back, 100.0, 0.0).ravel()
    # numba would let all of OpenMP have as many threads as there are cores.
    os.environ.setdefault("NUMBA_NUM_THREADS", str(torch.get_num_threads()))
    import pymatting

    system = pymatting.cf_laplacian(_array(image)) + diags(known)
    inverse = diags(1 / system.diagonal())
    solution, _ = cg(system, known * front.ravel(), rtol=1e-5, maxiter=3000, M=inverse)
    return _tensor(solution.reshape(front.shape))


def grabcut(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """GrabCut with eight iterations, initialised by the Gaussian mixtures, which improves its results."""
    front, back = _seeds(inside, outside)
    guess = gaussian_mixture(image, inside, outside)[0, 0].numpy() > 0.5
    labels = np.where(guess, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[front], labels[back] = cv2.GC_FGD, cv2.GC_BGD
    pixels = (_array(image)[..., ::-1] * 255).round().astype(np.uint8)
    cv2.setRNGSeed(0)
    cv2.grabCut(pixels, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 8, cv2.GC_INIT_WITH_MASK)
    return _tensor((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))


def _log_density(pixels: NDArray[np.float64], seeds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log density (N,) of pixels (N, 3) under a Gaussian mixture of seeds (n, 3)."""
    count = min(COMPONENTS, len(seeds))
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    _, labels, _ = cv2.kmeans(seeds.astype(np.float32), count, None, stop, 3, cv2.KMEANS_PP_CENTERS)
    total = []
    for label in range(count):
        members = seeds[labels[:, 0] == label]
        if len(members) == 0:
            continue
        covariance = (np.cov(members.T) if len(members) > 3 else np.zeros((3, 3))) + FLOOR * np.eye(3)
        away = pixels - members.mean(0)
        squared = (away @ np.linalg.inv(covariance) * away).sum(1)
        total.append(np.log(len(members) / len(seeds)) - 0.5 * (squared + np.linalg.slogdet(covariance)[1]))
    return np.logaddexp.reduce(total)


def gaussian_mixture(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """The probability of the object, from Gaussian mixtures in Lab for foreground and background."""
    front, back = _seeds(inside, outside)
    lab = rgb2lab(_array(image))
    odds = _log_density(lab.reshape(-1, 3), lab[front]) - _log_density(lab.reshape(-1, 3), lab[back])
    alpha = 1 / (1 + np.exp(-odds.clip(-50, 50))).reshape(front.shape)
    alpha[front], alpha[back] = 1, 0
    return _tensor(alpha)


def walker(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """scikit-image's random walker."""
    front, back = _seeds(inside, outside)
    labels = np.where(front, 1, np.where(back, 2, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about probabilities just outside [0, 1], which are clamped
        probabilities = random_walker(
            _array(image), labels, beta=130, mode="cg_j", channel_axis=2, return_full_prob=True
        )
    return _tensor(probabilities[0])


def diffusion(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """The paper's method, :func:`diffusion_mask`, with colours as the guide."""
    operator = nonlocal_operator(image, photometric_bandwidth=25 / 255, guide_channels="all")
    return diffusion_mask(operator.spectrum(), inside, negative=outside)


def strokes(image: Tensor, inside: Tensor, outside: Tensor) -> Tensor:
    """:func:`propagate_strokes` with the guide of recolouring."""
    operator = nonlocal_operator(colour_guide(image), patch_size=3, photometric_bandwidth=0.12, guide_channels="all")
    return propagate_strokes(operator.spectrum(), inside, torch.maximum(inside, outside)).clamp(0, 1)


PEERS: dict[str, Mask] = {
    "closed form": closed_form,
    "GrabCut": grabcut,
    "Gaussians": gaussian_mixture,
    "random walker": walker,
    "diffusion": diffusion,
    "strokes": strokes,
}
