"""Other methods that enhance the detail of photographs, for the benchmarks of detail and of sharpening.

Adaptive unsharp masking after Polesel, Ramponi and Mathews, "Image Enhancement via Adaptive Unsharp Masking", IEEE
Transactions on Image Processing 9(3), 2000, the paper's [12], and the local Laplacian filter after Aubry, Paris,
Hasinoff, Kautz and Durand, "Fast Local Laplacian Filters", ACM Transactions on Graphics 33(5), 2014, are implemented
here; all others are OpenCV's and kornia's.
"""

import math
from collections.abc import Callable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import bilateral_blur, gaussian_blur2d, guided_blur
from numpy.typing import NDArray
from torch import Tensor

Plane = NDArray[np.float32]
SAMPLES = 16  # brightness levels at which the local Laplacian filter is computed
CONTRAST = 0.15  # largest difference that counts as detail in the local Laplacian filter
# The adaptive method, for grey levels from 0 to 255: variances that separate flat, medium and high activity, the gains
# wanted for medium and high activity, step size of the adaptation, and forgetting factor of its correlation matrix.
ACTIVITY = (60.0, 200.0)
WANTED = (4.0, 3.0)
STEP, FORGETTING = 0.1, 0.5


def gaussian(image: Tensor, sigma: float) -> Tensor:
    """Blur (B, 1, H, W)."""
    size = 2 * math.ceil(3 * sigma) + 1
    return gaussian_blur2d(image, (size, size), (sigma, sigma))


def band(image: Tensor, fine: float, coarse: float) -> Tensor:
    """Unsharp masking without the finest grain: a difference of Gaussians."""
    return gaussian(image, fine) - gaussian(image, coarse)


#: Detail of images (B, 1, H, W) whose multiples sharpen them.
SHARPENERS: dict[str, Callable[[Tensor], Tensor]] = {
    "unsharp, sigma 1": lambda image: image - gaussian(image, 1.0),
    "unsharp, sigma 2": lambda image: image - gaussian(image, 2.0),
    "unsharp, 1.2 to 3": lambda image: band(image, 1.2, 3.0),
    "adaptive unsharp [12]": lambda image: adaptive(image),
    "bilateral, 0.2": lambda image: image - bilateral_blur(image, (11, 11), 0.2, (3.0, 3.0)),
    "guided, 0.01": lambda image: image - guided_blur(image, image, 11, 0.01),
}


def adaptive(image: Tensor) -> Tensor:
    """Second differences along rows and columns, each times a gain that is adapted recursively along the row.

    In active areas, the gains adapt until the local dynamics is a multiple of its original; in flat areas, until it is
    unchanged.
    """
    dtype, image = image.dtype, 255 * image.double()
    padded = F.pad(image, (1, 1, 1, 1), mode="reflect")
    across = 2 * image - padded[..., 1:-1, :-2] - padded[..., 1:-1, 2:]
    along = 2 * image - padded[..., :-2, 1:-1] - padded[..., 2:, 1:-1]
    dynamics, dynamics_across, dynamics_along = (_dynamics(x) for x in (image, across, along))
    variance = F.avg_pool2d(padded.square(), 3, 1) - F.avg_pool2d(padded, 3, 1).square()
    medium, high = (torch.full_like(image, gain) for gain in WANTED)
    wanted = torch.where(variance < ACTIVITY[1], medium, high)
    wanted = torch.where(variance < ACTIVITY[0], torch.ones_like(image), wanted)

    batch, _, height, width = image.shape
    gains = image.new_zeros(batch, height, 2)
    correlation = 1e-2 * torch.eye(2).to(image).expand(batch, height, 2, 2)
    columns = []
    for x in range(width):  # all rows at once
        pairs = torch.stack([dynamics_across[:, 0, :, x], dynamics_along[:, 0, :, x]], dim=-1)
        columns.append(gains)
        lack = (wanted * dynamics - dynamics)[:, 0, :, x] - (gains * pairs).sum(-1)
        correlation = (1 - FORGETTING) * correlation + FORGETTING * pairs.unsqueeze(-1) * pairs.unsqueeze(-2)
        step = torch.linalg.solve(correlation + 1e-3 * torch.eye(2).to(image), pairs)
        gains = gains + 2 * STEP * lack.unsqueeze(-1) * step
    adapted = torch.stack(columns, dim=2)  # (B, H, W, 2)
    detail = adapted[..., 0].unsqueeze(1) * across + adapted[..., 1].unsqueeze(1) * along
    return (detail / 255).to(dtype)


def _dynamics(image: Tensor) -> Tensor:
    """Local dynamics: difference of a pixel to its eight neighbours."""
    kernel = -torch.ones(1, 1, 3, 3, dtype=image.dtype)
    kernel[..., 1, 1] = 8
    return F.conv2d(F.pad(image, (1, 1, 1, 1), mode="reflect"), kernel)


def smoothers() -> dict[str, Callable[[Plane], Plane]]:
    """Edge-preserving filters of luminance (H, W) in [0, 1], with settings that are usual for detail."""
    ximgproc = cv2.ximgproc

    def bytes_of(y: Plane) -> NDArray[np.uint8]:
        return np.rint(y * 255).astype(np.uint8)

    return {
        "guided": lambda y: ximgproc.guidedFilter(y, y, 8, 0.01),
        "domain transform": lambda y: ximgproc.dtFilter(y, y, 20, 0.2),
        "WLS (FGS)": lambda y: ximgproc.fastGlobalSmootherFilter(bytes_of(y), y, 100.0, 8.0),
        "L0": lambda y: ximgproc.l0Smooth(np.rint(y * 65535).astype(np.uint16), None, 0.01, 2.0) / np.float32(65535),
        "rolling guidance": lambda y: ximgproc.rollingGuidanceFilter(y, None, -1, 0.1, 3.0, 4, cv2.BORDER_REFLECT),
        "bilateral": lambda y: cv2.bilateralFilter(y, 15, 0.15, 5.0, borderType=cv2.BORDER_REFLECT),
        "local Laplacian": lambda y: y - local_laplacian_detail(y),
    }


def local_laplacian_detail(y: Plane, sigma: float = CONTRAST) -> Plane:
    """Detail that a local Laplacian filter of strength 1 adds to luminance (H, W); it is linear in the strength.

    The picture is remapped around every sample g of brightness to ``(y - g) exp(-(y - g)^2 / 2 sigma^2)``; the level
    of the result's Laplacian pyramid is interpolated at the brightness of the picture's Gaussian pyramid.
    """
    levels = max(1, min(y.shape).bit_length() - 3)
    pyramid = [y]
    for _ in range(levels):
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    sums = [np.zeros_like(level) for level in pyramid[:-1]]
    for g in np.linspace(0, 1, SAMPLES, dtype=np.float32):
        level = (y - g) * np.exp(-np.square(y - g) / (2 * sigma**2))
        for i in range(levels):
            coarser = cv2.pyrDown(level)
            near = (1 - np.abs(pyramid[i] - g) * (SAMPLES - 1)).clip(min=0)
            sums[i] += near * (level - cv2.pyrUp(coarser, dstsize=level.shape[::-1]))
            level = coarser
    result = np.zeros_like(pyramid[-1])
    for laplacian in reversed(sums):
        result = cv2.pyrUp(result, dstsize=laplacian.shape[::-1]) + laplacian
    return result


def detail_enhance(image: Tensor, strength: float) -> Tensor:
    """OpenCV's detailEnhance of an RGB image (1, 3, H, W); ``sigma_r`` grows with the strength."""
    rows = np.ascontiguousarray((image[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    result = cv2.detailEnhance(rows, sigma_s=10, sigma_r=min(0.02 * strength, 1.0))
    return torch.from_numpy(result).permute(2, 0, 1)[None].float() / 255


def clahe(y: Plane, strength: float) -> Plane:
    """Contrast-limited adaptive histogram equalisation of luminance; the clip limit grows with the strength."""
    equalizer = cv2.createCLAHE(clipLimit=0.2 + strength, tileGridSize=(8, 8))
    result: Plane = equalizer.apply(np.rint(y * 65535).astype(np.uint16)).astype(np.float32) / 65535
    return result
