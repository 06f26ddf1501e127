"""Evaluation of denoisers: noisy held-out photographs, other denoisers, and a table of PSNRs."""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.photographs import photograph
from nlfilter_torch.operator.features import reduce_channels

HELD_OUT = {"camera": (60, 190), "coffee": (150, 220), "chelsea": (70, 130)}  # row and column of a part to look at
PART = 160  # pixels of it
NOISE = 25 / 255
STRENGTHS = (15, 20, 25, 30)  # grey levels; the h that OpenCV's method is tried with

Method = Callable[[Tensor], Tensor]  # noisy to denoised, (1, 1, H, W) both


@dataclass(frozen=True)
class Scene:
    """A photograph in grey, (1, 1, H, W) in [0, 1], and the same with noise, which may leave that range."""

    name: str
    clean: Tensor
    noisy: Tensor

    def psnr(self, image: Tensor) -> float:
        """Peak signal to noise ratio of a result in decibels."""
        return decibels(float((image - self.clean).double().square().mean()))


def decibels(squared_error: float) -> float:
    """A mean squared error of images in [0, 1] as a PSNR."""
    return -10 * math.log10(squared_error)


def held_out_scenes(side: int | None = None) -> list[Scene]:
    """The photographs to judge on, whole or ``side`` x ``side`` pixels of them; the same noise on every call."""
    generator = torch.Generator().manual_seed(0)
    scenes = []
    for name in HELD_OUT:
        clean = reduce_channels(photograph(name), "luminance")
        clean = clean if side is None else part(name, clean, side)
        scenes.append(Scene(name, clean, clean + NOISE * torch.randn(clean.shape, generator=generator)))
    return scenes


def part(name: str, image: Tensor, side: int = PART) -> Tensor:
    """The ``side`` x ``side`` pixels of a held-out photograph that are worth a look."""
    top, left = HELD_OUT[name]
    return image[..., top : top + side, left : left + side]


def skimage_nlm(noisy: Tensor) -> Tensor:
    """Non-local means of scikit-image, told the noise level."""
    from skimage.restoration import denoise_nl_means

    result = denoise_nl_means(
        noisy[0, 0].numpy(), patch_size=5, patch_distance=6, h=0.8 * NOISE, sigma=NOISE, fast_mode=True
    )
    return torch.from_numpy(result)[None, None]


def opencv_nlm(noisy: Tensor, strength: float) -> Tensor:
    """Non-local means of OpenCV, which takes 8 bits: rounded and clipped."""
    import cv2

    pixels = (noisy[0, 0].clamp(0, 1) * 255).round().byte().numpy()
    return torch.from_numpy(cv2.fastNlMeansDenoising(pixels, None, strength, 7, 21))[None, None] / 255


def best_opencv_strength(scenes: Iterable[Scene]) -> float:
    """The h with the highest mean PSNR on these very scenes, to the peer's advantage."""
    return max(STRENGTHS, key=lambda h: sum(scene.psnr(opencv_nlm(scene.noisy, h)) for scene in scenes))


def judge(
    methods: Mapping[str, Method], scenes: Iterable[Scene]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, Tensor]]]:
    """Print a table of PSNRs, row by row as it comes.

    Returns:
        The table, by method, then by photograph and mean; and the results, by method and photograph.
    """
    scenes = list(scenes)
    table, results = {}, {}
    print(f"{'PSNR in dB':24}" + "".join(f"{name:>10}" for name in [*(scene.name for scene in scenes), "mean"]))
    for method, function in methods.items():
        results[method] = {scene.name: function(scene.noisy) for scene in scenes}
        row = {scene.name: scene.psnr(results[method][scene.name]) for scene in scenes}
        row["mean"] = statistics.mean(row.values())
        print(f"{method:24}" + "".join(f"{value:10.2f}" for value in row.values()), flush=True)
        table[method] = row
    return table, results
