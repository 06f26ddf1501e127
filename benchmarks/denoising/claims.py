"""What is claimed of the denoiser beside its tables: misstated noise, clean photographs, time and memory."""

import statistics
from collections.abc import Mapping

from torch import Tensor

from benchmarks.denoising.cases import NOISE, QUICK, Case, Method, judge, psnr, with_noise
from benchmarks.denoising.methods import METHODS
from benchmarks.harness import forget_peak, resident
from benchmarks.photographs import luminance, photograph
from nlfilter_torch import NonlocalDenoiser, estimate_noise
from nlfilter_torch.photo import denoise

GAINS, FLOOR = (0.002, 0.01), 2 / 255  # of noise whose variance grows with brightness, as in cameras


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
        estimated = psnr(denoise(image, grain=0), image)
        told = [psnr(denoiser(Case(name, image, image, level / 255)), image) for level in (1, 2)]
        print(f"  {name:20}{estimated:8.1f}" + "".join(f"{value:8.1f}" for value in told))
    print("\nnoise whose variance grows by 0.002 and 0.01 of the brightness: PSNR with known and with estimated noise")
    for number, (name, image) in enumerate(clean.items()):
        line = f"  {name:20}"
        for gain in GAINS:
            deviation = (gain * image + FLOOR**2).sqrt()
            noisy = with_noise(image, deviation, number)
            known = psnr(NonlocalDenoiser.trained()(noisy, deviation).detach(), image)
            line += f"{known:8.2f}{psnr(denoise(noisy, grain=0), image):8.2f}"
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
    whole = luminance(photograph("retina"))
    clean = whole[QUICK] if quick else whole[..., : whole.shape[-1] // 2]
    case = Case("retina", clean, with_noise(clean, level / 255, 0), level / 255)
    print(f"\nretina, {clean.shape[-1]}x{clean.shape[-2]} pixels, grey, noise {level:g}")
    seconds = {}
    for name in ("ours", "BM3D"):
        before = forget_peak()
        figures = judge(METHODS[name], case)
        seconds[name] = figures.seconds
        peak = resident("VmHWM") - before
        print(f"{name:22}{figures.psnr:8.2f} dB{figures.seconds:8.2f} s{peak:8.0f} MiB", flush=True)
    print(f"ours takes {seconds['ours'] / seconds['BM3D']:.3f} of the CPU time of BM3D")
