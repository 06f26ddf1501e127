"""Other methods to boost the details of a photograph: the part that a smoothing filter removes, times a gain.

The local Laplacian filter, after Aubry, Paris, Hasinoff, Kautz and Durand, "Fast Local Laplacian Filters", ACM
Transactions on Graphics 33(5), 2014, is implemented here; all others are OpenCV's.
"""

from collections.abc import Callable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

Plane = NDArray[np.float32]
SAMPLES = 16  # brightness levels at which the local Laplacian filter is computed
CONTRAST = 0.15  # largest difference that counts as detail in the local Laplacian filter


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
        "local Laplacian": lambda y: y - local_laplacian_detail(torch.from_numpy(y)[None, None])[0, 0].numpy(),
    }


def local_laplacian_detail(y: Tensor, sigma: float = CONTRAST) -> Tensor:
    """Detail that a local Laplacian filter of strength 1 adds to luminance (1, 1, H, W); it is linear in the strength.

    The picture is remapped around every sample g of brightness to ``(y - g) exp(-(y - g)^2 / 2 sigma^2)``; the level
    of the result's Laplacian pyramid is interpolated at the brightness of the picture's Gaussian pyramid.
    """
    levels = max(1, min(y.shape[-2:]).bit_length() - 3)
    gaussian = [y]
    for _ in range(levels):
        gaussian.append(_halve(gaussian[-1]))
    sums = [torch.zeros_like(level) for level in gaussian[:-1]]
    step = 1 / (SAMPLES - 1)
    for g in np.linspace(0, 1, SAMPLES):
        apart = y - float(g)
        level = apart * torch.exp(-apart.square() / (2 * sigma**2))
        for i in range(levels):
            coarser = _halve(level)
            near = (1 - (gaussian[i] - float(g)).abs() / step).clamp(min=0)
            sums[i] += near * (level - _double(coarser, level))
            level = coarser
    result = torch.zeros_like(gaussian[-1])
    for laplacian in reversed(sums):
        result = _double(result, laplacian) + laplacian
    return result


def _halve(plane: Tensor) -> Tensor:
    """The next level of a Gaussian pyramid."""
    return _blur(plane)[..., ::2, ::2]


def _double(plane: Tensor, like: Tensor) -> Tensor:
    """Enlarge a level to the size of the next finer one."""
    spread = torch.zeros_like(like)
    spread[..., ::2, ::2] = plane
    weights = torch.zeros_like(like)
    weights[..., ::2, ::2] = 1
    return _blur(spread) / _blur(weights)


def _blur(plane: Tensor) -> Tensor:
    kernel = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
    padded = F.pad(plane, (2, 2, 2, 2), mode="reflect" if min(plane.shape[-2:]) > 2 else "replicate")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 5, 1)), kernel.view(1, 1, 1, 5))


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
