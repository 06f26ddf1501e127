"""Filters of other libraries, on the same image.

They are different operators for the same tasks: smoothing an image while keeping its edges, or enhancing its detail.
Each is called with its fastest memory layout and data type, and with the parameters of its documentation's examples
if those suit photographs.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from benchmarks.speed.cases import Case, colour
from benchmarks.speed.timing import Call, discard
from nlfilter_torch import estimate_bandwidth
from nlfilter_torch.operator.features import GuideFeatures, patch_window

PACKAGE = "nlfilter-torch"


@dataclass(frozen=True)
class Peer:
    """A filter for comparison.

    Attributes:
        name: in tables.
        does: what it computes, in a few words.
        extra: of this package that installs the filter; None if the package itself requires it.
        prepare: returns a call without arguments that filters the image of a case.
    """

    name: str
    does: str
    extra: str | None
    prepare: Callable[[Case], Call]


def skimage_nlm(patch: int, distance: int) -> Callable[[Case], Call]:
    """Non-local means of scikit-image, fast mode, on float32."""

    def prepare(case: Case) -> Call:
        from skimage.restoration import denoise_nl_means

        image = case.image()[0, 0].cpu().numpy()
        return lambda: denoise_nl_means(image, patch_size=patch, patch_distance=distance, h=0.04, fast_mode=True)

    return prepare


def opencv_nlm(case: Case) -> Call:
    """Non-local means of OpenCV on 8 bits, with its default 7x7 patches and 21x21 windows."""
    import cv2

    cv2.setNumThreads(case.used_threads)
    image = (case.image()[0, 0].cpu().numpy() * 255).round().astype(np.uint8)
    return lambda: cv2.fastNlMeansDenoising(image, None, 10, 7, 21)


def opencv_detail(case: Case) -> Call:
    """Detail enhancement of OpenCV (domain transform), which takes 8-bit colour only."""
    import cv2

    cv2.setNumThreads(case.used_threads)
    image = (colour(case.picture, case.height, case.width) * 255).round().astype(np.uint8)
    return lambda: cv2.detailEnhance(image, sigma_s=10, sigma_r=0.15)


def kornia_bilateral(case: Case) -> Call:
    """Bilateral filter of kornia, 11x11."""
    from kornia.filters import bilateral_blur

    return discard(bilateral_blur, case.image(), (11, 11), 0.1, (3.0, 3.0))


def kornia_guided(case: Case) -> Call:
    """Guided filter of kornia, 11x11, guided by the image itself."""
    from kornia.filters import guided_blur

    image = case.image()
    return discard(guided_blur, image, image, (11, 11), 0.01)


def dense_attention(case: Case) -> Call:
    """The dense filter of eq. (2), between all pairs of pixels, as attention.

    With queries ``[2 x, 1]`` and keys ``[x, -|x|^2]`` the softmax is ``K / K 1``: -|x_i|^2, which is constant along
    a row, cancels. Values are padded to the width of the keys, as torch's fused kernel requires; that kernel never
    forms the N x N matrix.
    """
    from torch.nn.attention import SDPBackend, sdpa_kernel

    image = case.image()
    window = patch_window(case.patch_size).to(image)
    features = GuideFeatures(window, estimate_bandwidth(image), None, "all")(image).mT  # (1, N, D)
    features = features - features.mean(1, keepdim=True)
    queries = torch.cat([2 * features, torch.ones_like(features[..., :1])], dim=2).unsqueeze(1)
    keys = torch.cat([features, -features.square().sum(2, keepdim=True)], dim=2).unsqueeze(1)
    values = F.pad(image.flatten(2).mT, (0, features.shape[2])).unsqueeze(1)

    def filtered() -> torch.Tensor:
        with sdpa_kernel(SDPBackend.FLASH_ATTENTION), torch.no_grad():
            return F.scaled_dot_product_attention(queries, keys, values, scale=1.0)[..., :1]

    return filtered


NLM_5_6 = Peer("scikit-image NLM 5/6", "local patches, window 13x13, one core", None, skimage_nlm(5, 6))
NLM_7_11 = Peer("scikit-image NLM 7/11", "local patches, window 23x23, one core", None, skimage_nlm(7, 11))
OPENCV_NLM = Peer("OpenCV fastNlMeans 7/21", "local patches, window 21x21, 8 bits", "bench", opencv_nlm)
OPENCV_DETAIL = Peer("OpenCV detailEnhance", "edge-aware smoothing, colour, 8 bits", "bench", opencv_detail)
BILATERAL = Peer("kornia bilateral 11x11", "local pixels, differentiable", None, kornia_bilateral)
GUIDED = Peer("kornia guided 11x11", "local linear model, differentiable", None, kornia_guided)
DENSE = Peer("dense filter by attention", "eq. (2) without landmarks or balancing", None, dense_attention)

QUICK_PEERS = (OPENCV_NLM, OPENCV_DETAIL, NLM_5_6, BILATERAL, GUIDED)


def prepare_all(peers: tuple[Peer, ...], case: Case) -> tuple[dict[str, Call], dict[str, str]]:
    """Calls of the peers that are installed, and installation hints for the others, both by name."""
    calls, missing = {}, {}
    for peer in peers:
        try:
            calls[peer.name] = peer.prepare(case)
        except ImportError as error:
            remedy = f"pip install '{PACKAGE}[{peer.extra}]'" if peer.extra else f"pip install {PACKAGE}"
            missing[peer.name] = f"{peer.name} is skipped: {error.name or error} is not installed; {remedy}"
    return calls, missing
