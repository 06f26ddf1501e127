"""What a GPU changes in results, times and memory: ``python -m benchmarks.gpu [--quick]``.

Every result is compared with that of the CPU in float64. Times of building an operator and of filtering one channel are
printed beside the time that their matrix products and their reads of the factor take at rates measured on this GPU.
Without a GPU the program prints an error and exits with status 2.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch
from torch import Tensor

from benchmarks.harness import MIB, markdown, options, seconds
from nlfilter_torch import (
    NonlocalFilter,
    captured_energy,
    detail_layers,
    diffusion_mask,
    fit_alpha,
    nonlocal_operator,
    polynomial_filter,
    propagate_strokes,
    segment_mask,
    spectral_filter,
)
from nlfilter_torch.photo import abstract, denoise, enhance, recolor, region_mask, sharpen

MEGAPIXELS = (0.25, 1.0, 4.0, 16.0)
LANDMARKS, FEATURES = 100, 25
BUILDING_READS, FILTERING_READS = 5, 4  # of the factor: one write and four sweeps; two for each of W, W^2
SLIDERS = (3.0, 3.0, 4.0, 1.05)
BATCH, CROP, FEW = 8, 128, 48  # images, side and landmarks of the training step


@dataclass(frozen=True)
class Rates:
    """Operations per second in float32 matrix products, and bytes read and written per second by copies."""

    flops: float
    bytes: float


def picture(height: int, width: int, device: str, batch: int = 1, dtype: torch.dtype = torch.float32) -> Tensor:
    """Smooth shapes with texture, (B, 3, H, W), identical on every device."""
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(batch, 3, 9, 9, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")
    noise = torch.rand(batch, 3, height, width, generator=generator)
    return (0.9 * smooth + 0.1 * noise).to(device, dtype)


def results(device: str, side: int = 96, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """The results of the public functions on a small picture."""
    image = picture(side, side, device, dtype=dtype)
    alpha = torch.tensor(SLIDERS, device=device, dtype=dtype)
    mask = torch.zeros(1, 1, side, side, device=device, dtype=dtype)
    mask[..., side // 3 : side // 2, side // 3 : side // 2] = 1
    blue = torch.tensor([0.1, 0.2, 0.9], device=device, dtype=dtype).view(1, 3, 1, 1).expand_as(image)
    operator = nonlocal_operator(image, num_landmarks=50, spatial_bandwidth=side / 3)
    spectrum = operator.spectrum()
    edited = polynomial_filter(operator, image, alpha)
    guide = image.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(NonlocalFilter(SLIDERS, num_landmarks=50)(guide).square().mean(), guide)
    return {
        "row sums": operator.row_sums(),
        "W y": operator @ image,
        "detail layers": detail_layers(operator, image),
        "polynomial filter": edited,
        "gradient by the guide": gradient * gradient.numel(),
        "eigenvalues": spectrum.eigenvalues,
        "spectral filter": spectral_filter(spectrum, image, torch.sqrt, residual=1.0),
        "captured energy": captured_energy(spectrum, image),
        "diffusion mask": diffusion_mask(spectrum, mask),
        "segment mask": segment_mask(spectrum, torch.cat([mask, mask.flip(2)], dim=1)),
        "strokes": propagate_strokes(spectrum, blue, mask),
        "fitted sliders": fit_alpha(operator, image, edited, rounding=0.0),
        # By k-means, rounding may move a landmark, which is no fault of the device.
        "enhance": enhance(image, alpha, landmarks="uniform"),
        "sharpen": sharpen(image),
        "denoise": denoise(image),
        "abstract": abstract(image),
        "region mask": region_mask(image, mask),
        "recolor": recolor(image, blue, mask),
    }


def differences(device: str, side: int = 96) -> dict[str, float]:
    """Largest difference of each result from that of the CPU in float64."""
    expected, tensors = results("cpu", side, torch.float64), results(device, side)
    return {
        name: (tensors[name].cpu().double() - values).abs().max().item()
        if tensors[name].shape == values.shape
        else padded_difference(tensors[name].cpu().double(), values)
        for name, values in expected.items()
    }


def padded_difference(eigenvalues: Tensor, expected: Tensor) -> float:
    """Largest difference of eigenvalues (B, R), which accelerators pad with zeros."""
    count = min(eigenvalues.shape[1], expected.shape[1])
    return (eigenvalues[:, :count] - expected[:, :count]).abs().max().item()


def duration(call: Callable[[], object], device: str, repeats: int = 7) -> float:
    """Median time of a call, including all work that it starts on the device; the first call is not counted."""

    def whole() -> None:
        call()
        wait(device)

    whole()
    return median(seconds(whole) for _ in range(repeats))


def wait(device: str) -> None:
    """Wait until all work of a device is finished."""
    if device == "cuda":
        torch.cuda.synchronize()


def measured_rates(device: str, size: int) -> Rates:
    """Measure products of square matrices of side ``size`` without TF32, and copies as large as 16 such matrices."""
    square, long = torch.rand(size, size, device=device), torch.rand(16 * size * size, device=device)
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        products = duration(lambda: square @ square, device)
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before
    target = torch.empty_like(long)
    copies = duration(lambda: target.copy_(long), device)
    return Rates(2 * size**3 / products, 2 * long.numel() * 4 / copies)


def floors(pixels: int, rates: Rates) -> tuple[float, float]:
    """Lower bounds in seconds for building an operator and filtering one channel with order 2, from the rates."""
    products = 2 * pixels * LANDMARKS * (FEATURES + 2 + LANDMARKS / 2)  # distances, and half of a triangle's product
    factor = 4 * pixels * LANDMARKS
    return (
        max(products / rates.flops, BUILDING_READS * factor / rates.bytes),
        max(FILTERING_READS * 2 * pixels * LANDMARKS / rates.flops, FILTERING_READS * factor / rates.bytes),
    )


def size_row(megapixels: float, device: str, rates: Rates) -> list[str]:
    """Measure times and memory for one size, and return a row of the table."""
    side = round((megapixels * 1e6) ** 0.5)
    image = picture(side, side, device)[:, :1]
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    build = partial(nonlocal_operator, image, num_landmarks=LANDMARKS, photometric_bandwidth=0.1)
    building, operator = duration(build, device), build()
    filtering = duration(lambda: polynomial_filter(operator, image, torch.ones(3, device=device)), device)
    least = floors(side * side, rates)
    memory = f"{torch.cuda.max_memory_allocated() / MIB:.0f}" if device == "cuda" else "-"
    times = (building, least[0], filtering, least[1])
    return [f"{megapixels:g}", *(f"{1e3 * taken:.2f}" for taken in times), memory]


def training_step(device: str, batch: int = BATCH, crop: int = CROP) -> Callable[[], object]:
    """Create a function that makes one step of gradient descent through building and filtering."""
    layer = NonlocalFilter(learn=("alpha", "photometric_bandwidth"), photometric_bandwidth=0.1, num_landmarks=FEW)
    layer.to(device)
    optimizer, image = torch.optim.SGD(layer.parameters(), lr=1e-3), picture(crop, crop, device, batch)

    def step() -> None:
        optimizer.zero_grad()
        (layer(image) - 0.5).square().mean().backward()
        optimizer.step()

    return step


def report(device: str, sizes: Iterable[float], rate_size: int, *, side: int = 96, crop: int = CROP) -> None:
    """Print all tables."""
    compared = differences(device, side).items()
    rows = [[name, f"{difference:.1e}"] for name, difference in compared]
    print(markdown(["result", "largest difference from float64 on the CPU"], rows))
    rates = measured_rates(device, rate_size)
    print(f"\n{rates.flops / 1e12:.2f} TFLOP/s in products of float32, {rates.bytes / 1e9:.0f} GB/s in copies\n")
    header = ["MP", "build, ms", "at least", "filter, ms", "at least", "peak, MiB"]
    print(markdown(header, [size_row(megapixels, device, rates) for megapixels in sizes]), flush=True)
    step = duration(training_step(device, crop=crop), device)
    print(f"\ntraining step, {BATCH}x3x{crop}x{crop}, m = {FEW}: {1e3 * step:.1f} ms")


def main(arguments: list[str] | None = None) -> int:
    """Measure on the GPU, if there is one."""
    chosen = options("gpu", __doc__, "small sizes").parse_args(arguments)
    if not torch.cuda.is_available():
        print(
            "this benchmark needs a GPU that torch can use, found none; run it on a machine with CUDA", file=sys.stderr
        )
        return 2
    print(torch.cuda.get_device_name(), torch.__version__)
    if chosen.quick:
        report("cuda", MEGAPIXELS[:1], 1024, crop=32)
    else:
        report("cuda", MEGAPIXELS, 8192)
    return 0


if __name__ == "__main__":
    sys.exit(main())
