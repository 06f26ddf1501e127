"""Photographs with white noise, and how near a result comes to the clean photograph."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import row
from benchmarks.photographs import luminance, photograph, pictures

HELD_OUT = ("camera", "coffee", "chelsea", "retina", "page")
LEFT_HALVES = ("retina", "page")
NOISE = (5, 15, 25, 50)  # grey levels
QUICK = (..., slice(40, 88), slice(40, 88))  # part of a photograph, to check that the benchmark runs
LONGEST = 512  # pixels of the longer side; larger photographs are reduced


@dataclass(frozen=True)
class Case:
    """A photograph (1, 1 or 3, H, W) in [0, 1], its noisy version, not clipped, and the noise level."""

    name: str
    clean: Tensor
    noisy: Tensor
    noise: float

    @property
    def array(self) -> np.ndarray:
        """The noisy photograph as (H, W) or (H, W, 3)."""
        return as_array(self.noisy)

    @property
    def axis(self) -> int | None:
        """The axis of colours in :attr:`array`, if any."""
        return None if self.noisy.shape[1] == 1 else -1


Method = Callable[[Case], Tensor]


@dataclass(frozen=True)
class Figures:
    """Measurements of a method on one photograph."""

    psnr: float
    ssim: float
    seconds: float  # of CPU


def scenes(folder: Path | None, kind: str, *, quick: bool) -> dict[str, Tensor]:
    """Photographs (1, 1 or 3, H, W) by name, in ``"grey"`` or ``"colour"``; grey ones are left out of the latter."""
    if folder is not None:
        photographs = pictures(folder, 320, ())
    else:
        photographs = {name: photograph(name) for name in HELD_OUT}
        photographs |= {name: photographs[name][..., : photographs[name].shape[-1] // 2] for name in LEFT_HALVES}
    cut = {}
    for name, picture in photographs.items():
        if kind == "colour" and picture.shape[1] == 1:
            continue
        scale = LONGEST / max(picture.shape[-2:])
        if scale < 1:
            size = [round(length * scale) for length in picture.shape[-2:]]
            picture = torch.nn.functional.interpolate(picture, size, mode="bicubic", antialias=True).clamp(0, 1)
        picture = picture if kind == "colour" else luminance(picture)
        cut[name] = picture[QUICK] if quick else picture
    return dict(list(cut.items())[:2]) if quick else cut


def with_noise(clean: Tensor, noise: float | Tensor, number: int) -> Tensor:
    """Add noise of seed ``number`` to a photograph, without clipping."""
    generator = torch.Generator().manual_seed(1000 + number)
    return clean + noise * torch.randn(clean.shape, generator=generator)


def decibels(squared_error: float) -> float:
    """Convert a mean squared error of images in [0, 1] to a PSNR."""
    return -10 * math.log10(max(squared_error, 1e-12))


def psnr(image: Tensor, clean: Tensor) -> float:
    """Peak signal-to-noise ratio in decibels."""
    return decibels(float((image - clean).double().square().mean()))


def ssim(image: Tensor, clean: Tensor) -> float:
    """Structural similarity, with the Gaussian window of its original paper."""
    from skimage.metrics import structural_similarity

    arrays = [picture[0].permute(1, 2, 0).double().numpy() for picture in (image, clean)]
    value = structural_similarity(
        *arrays, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return float(value)


def as_array(image: Tensor) -> np.ndarray:
    """Convert (1, C, H, W) to (H, W) or (H, W, 3)."""
    return image[0].permute(1, 2, 0).squeeze(2).double().numpy()


def as_image(array: np.ndarray) -> Tensor:
    """Invert :func:`as_array`."""
    tensor = torch.from_numpy(np.ascontiguousarray(array)).float()
    return (tensor[..., None] if tensor.ndim == 2 else tensor).permute(2, 0, 1)[None]


def judge(method: Method, case: Case) -> Figures:
    """Run a method on a photograph and measure the result."""
    start = time.process_time()
    estimate = method(case)
    seconds = time.process_time() - start
    return Figures(psnr(estimate, case.clean), ssim(estimate.clamp(0, 1), case.clean), seconds)


def table(methods: Mapping[str, Method], cases: Sequence[Case]) -> dict[str, dict[str, Figures]]:
    """Print the PSNR of each photograph and the means of all measurements, one row per method."""
    print(row("", [*(case.name[:9] for case in cases), "mean", "SSIM", "CPU s"], 10, 22))
    rows: dict[str, dict[str, Figures]] = {}
    for name, method in methods.items():
        rows[name] = {case.name: judge(method, case) for case in cases}
        figures = list(rows[name].values())
        cells = [*(f"{each.psnr:.2f}" for each in figures), f"{mean(each.psnr for each in figures):.2f}"]
        cells += [f"{mean(each.ssim for each in figures):.4f}", f"{mean(each.seconds for each in figures):.2f}"]
        print(row(name, cells, 10, 22), flush=True)
    return rows
