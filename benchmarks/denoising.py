"""Comparison of denoisers: ``python -m benchmarks.denoising [--pictures FOLDER] [--methods NAMES] [--out FILE]``.

On photographs that were not used in training, with white noise of 5, 15, 25 and 50 grey levels, in grey and in colour:
PSNR, SSIM and CPU seconds of

ours             ``nlfilter_torch.denoise``, given the noise level; the mean over four rotations; with estimated noise;
rule             ``denoise(method="rule")``: sliders by rule, nothing learned;
BM3D, CBM3D      package ``bm3d``;
scikit-image     ``denoise_nl_means``, cycle-spun wavelets, and ``denoise_tv_chambolle`` with the best of five weights
                 for each photograph;
OpenCV           ``fastNlMeansDenoising`` on 8 bits, with the best of four strengths for each photograph;
plain            the network without the filter, with ``--plain FILE`` of ``benchmarks.train_denoiser --plain``.

``--methods``, ``--noise`` and ``--kinds`` select a part of it; results are added to the file ``--out``, from which
``python -m benchmarks.denoising_tables`` makes tables. ``--weights FILE`` evaluates other weights than those of the
package, and may be given several times. Without ``--pictures``, the photographs are camera, coffee, chelsea and the
left halves of retina and page. ``--wrong`` adds noise levels misstated by a fifth, noise that depends on brightness,
and clean photographs. ``--megapixel`` measures only the CPU time and memory of ours and of BM3D at a megapixel.
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.memory import forget_peak, resident
from benchmarks.photographs import photograph, pictures
from nlfilter_torch import NonlocalDenoiser, denoise, estimate_noise
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.io.writing import open_beside

HELD_OUT = ("camera", "coffee", "chelsea", "retina", "page")
LEFT_HALVES = ("retina", "page")
NOISE = (5, 15, 25, 50)  # grey levels
OPENCV_STRENGTHS = (0.6, 0.8, 1.0, 1.2)  # times the noise level
TV_WEIGHTS = (0.5, 0.7, 0.9, 1.1, 1.4)  # times the noise level
GAINS, FLOOR = (0.002, 0.01), 2 / 255  # of noise whose variance grows with brightness, as in cameras
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
        picture = picture if kind == "colour" else reduce_channels(picture, "luminance")
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
    from benchmarks.train_denoiser import PlainDenoiser

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
    "ours, measured": lambda case: denoise(case.noisy),
    "rule": lambda case: denoise(case.noisy, method="rule", noise_level=case.noise),
    "BM3D": bm3d,
    "scikit-image NLM": nlm,
    "scikit-image TV": total_variation,
    "scikit-image wavelets": wavelets,
    "OpenCV NLM": opencv,
}


def judge(method: Method, case: Case) -> Figures:
    """Run a method on a photograph and measure the result."""
    start = time.process_time()
    estimate = method(case)
    seconds = time.process_time() - start
    return Figures(psnr(estimate, case.clean), ssim(estimate.clamp(0, 1), case.clean), seconds)


def table(methods: Mapping[str, Method], cases: Sequence[Case]) -> dict[str, dict[str, Figures]]:
    """Print the PSNR of each photograph and the means of all measurements, one row per method."""
    print(f"{'':22}" + "".join(f"{case.name[:9]:>10}" for case in cases) + f"{'mean':>10}{'SSIM':>8}{'CPU s':>8}")
    rows: dict[str, dict[str, Figures]] = {}
    for name, method in methods.items():
        rows[name] = {case.name: judge(method, case) for case in cases}
        results = list(rows[name].values())
        mean = [
            statistics.mean(getattr(figures, which) for figures in results) for which in ("psnr", "ssim", "seconds")
        ]
        line = "".join(f"{figures.psnr:10.2f}" for figures in results)
        print(f"{name:22}{line}{mean[0]:10.2f}{mean[1]:8.4f}{mean[2]:8.2f}", flush=True)
    return rows


def misstated(denoiser: Method, clean: Mapping[str, Tensor]) -> None:
    """Print results for misstated noise levels, for noise that depends on brightness, and for clean photographs."""
    print("\nmean loss in dB if the given noise level is 0.8 and 1.2 times the true one")
    for level in NOISE:
        losses = {}
        for factor in (0.8, 1.2):
            pairs = []
            for number, (name, image) in enumerate(clean.items()):
                case = Case(name, image, with_noise(image, level / 255, number), level / 255)
                wrong = Case(name, image, case.noisy, factor * case.noise)
                pairs.append(psnr(denoiser(case), image) - psnr(denoiser(wrong), image))
            losses[factor] = statistics.mean(pairs)
        print(f"  noise {level:2}: " + ", ".join(f"{factor:g} {loss:+.2f}" for factor, loss in losses.items()))
    print("\nclean photographs: PSNR with estimated noise, and with given noise of 1 and 2 grey levels")
    for name, image in clean.items():
        estimated = psnr(denoise(image), image)
        told = [psnr(denoiser(Case(name, image, image, level / 255)), image) for level in (1, 2)]
        print(f"  {name:20}{estimated:8.1f}" + "".join(f"{value:8.1f}" for value in told))
    print("\nnoise whose variance grows by 0.002 and 0.01 of the brightness: PSNR with known and with estimated noise")
    for number, (name, image) in enumerate(clean.items()):
        line = f"  {name:20}"
        for gain in GAINS:
            deviation = (gain * image + FLOOR**2).sqrt()
            noisy = with_noise(image, deviation, number)
            known = psnr(NonlocalDenoiser.trained()(noisy, deviation).detach(), image)
            line += f"{known:8.2f}{psnr(denoise(noisy), image):8.2f}"
        print(line)
    print(
        "\nestimated noise in grey levels, for true noise of 5, 15, 25 and 50; then of the same photographs in 8 bits"
    )
    for number, (name, image) in enumerate(clean.items()):
        noisy = [with_noise(image, level / 255, number) for level in NOISE]
        rounded = [(picture.clamp(0, 1) * 255).round() / 255 for picture in noisy]
        print(f"  {name:20}" + "".join(f"{255 * float(estimate_noise(picture)):8.2f}" for picture in noisy + rounded))


def megapixel(level: float, *, quick: bool) -> None:
    """Print CPU time and peak memory, above that before the call, on the left half of retina at full size, in grey."""
    whole = reduce_channels(photograph("retina"), "luminance")
    clean = whole[QUICK] if quick else whole[..., : whole.shape[-1] // 2]
    case = Case("retina", clean, with_noise(clean, level / 255, 0), level / 255)
    print(f"\nretina, {clean.shape[-1]}x{clean.shape[-2]} pixels, grey, noise {level:g}")
    seconds = {}
    for name in ("ours", "BM3D"):
        before = resident("VmRSS")
        forget_peak()
        figures = judge(METHODS[name], case)
        seconds[name] = figures.seconds
        peak = resident("VmHWM") - before
        print(f"{name:22}{figures.psnr:8.2f} dB{figures.seconds:8.2f} s{peak:8.0f} MiB", flush=True)
    print(f"ours takes {seconds['ours'] / seconds['BM3D']:.3f} of the CPU time of BM3D")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Comparison of denoisers.")
    parser.add_argument("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    parser.add_argument(
        "--noise", type=float, nargs="+", default=NOISE, help="noise levels in grey levels; default: %(default)s"
    )
    parser.add_argument("--kinds", nargs="+", choices=("grey", "colour"), default=("grey", "colour"))
    parser.add_argument(
        "--weights", type=Path, action="append", default=[], help="weights of further networks to compare"
    )
    parser.add_argument(
        "--plain", type=Path, action="append", default=[], help="weights of networks without the filter"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=tuple(METHODS), help="default: all")
    parser.add_argument(
        "--wrong", action="store_true", help="also test misstated and estimated noise, and clean photographs"
    )
    parser.add_argument(
        "--megapixel", action="store_true", help="only CPU time and memory at a megapixel, for the first noise level"
    )
    parser.add_argument("--quick", action="store_true", help="small parts of two photographs, to check that it runs")
    parser.add_argument("--out", type=Path, help="JSON file to which all measurements are added")
    options = parser.parse_args(arguments)
    if options.megapixel:
        megapixel(options.noise[0], quick=options.quick)
        return
    methods = {name: METHODS[name] for name in options.methods}
    methods |= {path.parent.name: network(path) for path in options.weights}
    methods |= {
        "plain" if path.parent.name == "plain" else f"plain, {path.parent.name}": network(path, plain=True)
        for path in options.plain
    }
    figures: dict[str, dict[str, Any]] = {}
    if options.out is not None and options.out.exists():
        figures = json.loads(options.out.read_text())
    for kind in options.kinds:
        clean = scenes(options.pictures, kind, quick=options.quick)
        for level in options.noise:
            noise = level / 255
            cases = [
                Case(name, image, with_noise(image, noise, i), noise) for i, (name, image) in enumerate(clean.items())
            ]
            print(f"\n{kind}, noise {level:g}")
            rows = table(methods, cases)
            figures.setdefault(f"{kind}, {level:g}", {}).update(
                {name: {scene: asdict(result) for scene, result in row.items()} for name, row in rows.items()}
            )
            if options.out is not None:
                with open_beside(options.out) as stream:
                    stream.write(json.dumps(figures, indent=1).encode())
        if options.wrong:
            misstated(network(None), clean)


if __name__ == "__main__":
    main()
