"""Denoisers: those of the package, and peers."""

from collections.abc import Iterable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.denoising.cases import Case, Method, as_image, psnr
from nlfilter_torch import NonlocalDenoiser
from nlfilter_torch.photo import denoise

OPENCV_STRENGTHS = (0.6, 0.8, 1.0, 1.2)  # times the noise level
TV_WEIGHTS = (0.5, 0.7, 0.9, 1.1, 1.4)  # times the noise level


def bm3d(case: Case) -> Tensor:
    """BM3D in grey, CBM3D in colour."""
    import bm3d as package

    method = package.bm3d if case.axis is None else package.bm3d_rgb
    return as_image(method(case.array, case.noise))


def nlm(case: Case) -> Tensor:
    """Non-local means of scikit-image."""
    from skimage.restoration import denoise_nl_means

    options = {"patch_size": 5, "patch_distance": 6, "h": 0.8 * case.noise, "sigma": case.noise, "fast_mode": True}
    return as_image(denoise_nl_means(case.array, **options, channel_axis=case.axis))


def wavelets(case: Case) -> Tensor:
    """Cycle-spun wavelets of scikit-image."""
    from skimage.restoration import cycle_spin, denoise_wavelet

    options = {"sigma": case.noise, "rescale_sigma": False, "channel_axis": case.axis}
    return as_image(cycle_spin(case.array, denoise_wavelet, 3, func_kw=options, channel_axis=case.axis))


def total_variation(case: Case) -> Tensor:
    """Total variation of scikit-image, with the weight that is best for this photograph."""
    from skimage.restoration import denoise_tv_chambolle

    return best(
        case,
        (as_image(denoise_tv_chambolle(case.array, weight=w * case.noise, channel_axis=case.axis)) for w in TV_WEIGHTS),
    )


def opencv(case: Case) -> Tensor:
    """Non-local means of OpenCV, which needs 8 bits, with the strength that is best for this photograph."""
    import cv2

    pixels = (case.array.clip(0, 1) * 255).round().astype(np.uint8)
    strengths = [255 * case.noise * strength for strength in OPENCV_STRENGTHS]
    if case.axis is None:
        arrays = (cv2.fastNlMeansDenoising(pixels, None, strength, 7, 21) for strength in strengths)
    else:
        arrays = (cv2.fastNlMeansDenoisingColored(pixels, None, strength, strength, 7, 21) for strength in strengths)
    return best(case, (as_image(array / 255) for array in arrays))


def best(case: Case, results: Iterable[Tensor]) -> Tensor:
    """Select the result of the highest PSNR."""
    return max(results, key=lambda result: psnr(result, case.clean))


@cache
def network(path: Path | None, *, plain: bool = False, turns: int = 1) -> Method:
    """The trained network from a file or from the package, given the noise level."""
    from benchmarks.training.training import PlainDenoiser

    kind = PlainDenoiser if plain else NonlocalDenoiser
    denoiser = kind.trained() if path is None else kind.trained(path)

    def run(case: Case) -> Tensor:
        with torch.no_grad():
            denoised: Tensor = denoiser(case.noisy, case.noise, turns=turns)
        return denoised

    return run


#: Choices of ``--methods``.
METHODS: dict[str, Method] = {
    "noisy": lambda case: case.noisy,
    "ours": lambda case: network(None)(case),
    "ours, 4 turns": lambda case: network(None, turns=4)(case),
    "ours, measured": lambda case: denoise(case.noisy, grain=0),
    "rule": lambda case: denoise(case.noisy, method="rule", noise_level=case.noise),
    "BM3D": bm3d,
    "scikit-image NLM": nlm,
    "scikit-image TV": total_variation,
    "scikit-image wavelets": wavelets,
    "OpenCV NLM": opencv,
}


def available(names: Sequence[str]) -> dict[str, Method]:
    """Methods by name; BM3D, whose licence allows non-commercial use only, is left out where it is not installed."""
    lacks = {"BM3D"} if find_spec("bm3d") is None else set()
    if lacks & set(names):
        print("BM3D is left out, for the package bm3d is not installed (its licence: for non-commercial use only)")
    return {name: METHODS[name] for name in names if name not in lacks}
