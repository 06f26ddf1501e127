"""Standard errors of the pixels of any denoiser, by its errors on its own result with noise added to it again."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_shape, check_tensor
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.filtering.noise import NoiseModel, drawn, sampled, variance_of
from nlfilter_torch.filtering.sure import STEP
from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.operator.features import blur, pad_border

TRAINED = Path(__file__).with_name("error.safetensors")

NORMAL = 1.645  # standard errors to either side that hold 90 % of a normal distribution
DRAWS = 2  # of noise that is added to the result
FLOOR = 1e-3  # of variances in units of the noise, before the logarithm
NOISELESS = 1e-3 / 255  # deviation below which there is no noise
AGAIN, SLOPES, REST, STEIN = (0.7, 1.5, 3.0, 8.0), (0.7, 2.0, 5.0), (1.5, 4.0, 8.0), (4.0, 10.0)  # widths of averages
OWN_WIDTH = 1.5  # width of the average of a channel by itself
MOST, LARGEST_DIFFERENCE = 10.0, 1e6  # of squares, and of differences before they are squared, in units of the noise
RATIOS, LEAST_RATIO = (-5.0, 20.0), 0.2  # of Stein's estimate to the errors on the result: limits, and what is added
ERROR_INPUTS = len(AGAIN) + len(SLOPES) + len(REST) + len(STEIN) + 6
WIDTH = 24  # of both hidden layers
KINDS = ("known", "profile")  # of noise: white noise of a known level, and a profile, which is estimated as a rule
ERROR_LAYERS = {
    "first": (WIDTH, ERROR_INPUTS),
    "second": (WIDTH, WIDTH),
    "last": (1, WIDTH),
}
SHAPES = {
    f"{kind}.{name}": shape
    for kind in KINDS
    for name, shape in {
        "mean": (ERROR_INPUTS,),
        "scale": (ERROR_INPUTS,),
        **{f"{layer}.weight": size for layer, size in ERROR_LAYERS.items()},
        **{f"{layer}.bias": size[:1] for layer, size in ERROR_LAYERS.items()},
    }.items()
}
STRIP = 1 << 18  # values whose standard errors are computed together


@torch.no_grad()
@full_precision
def standard_error(
    function: Callable[[Tensor], Tensor],
    image: Tensor,
    noise: float | Tensor | NoiseModel,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Estimate the standard error of each pixel of a denoised image, from its variance and its bias.

    The denoiser is called with its own result to which noise was added again: its errors there are known. They are too
    small where texture was lost, of which the rest ``image - function(image)`` and Stein's estimate tell (see
    :func:`sure`). Averages of all these over neighbourhoods, in units of the noise, are what a small network is told.
    It is trained on photographs, with white noise of known level and with the noise of simulated and real cameras as
    :func:`noise_profile` estimates it.

    Args:
        function: the denoiser: takes an image (B, C, H, W) and returns one of its shape, each from its own image alone.
            It is called four times.
        image: (B, C, H, W), noisy, in [0, 1] apart from the noise.
        noise: standard deviation of white noise in units of the image: a number, (B,), or a map (B, 1 or C, H, W); or a
            :class:`NoiseProfile`.
        generator: of the noise that is added; None draws the same in every call.

    Returns:
        (B, C, H, W), not negative, in the units and dtype of the image. The range of 1.645 times it to either side of
        ``function(image)`` is meant to hold the true value of 90 % of the pixels, among flat and textured ones alike.
        Tails are heavier than those of a normal distribution. 0 where there is no noise. No gradient is propagated.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point (B, C, H, W) tensor, ``noise`` is negative or
            of another shape, or the result of ``function`` has another shape than its argument.

    Example:
        >>> from nlfilter_torch import NonlocalDenoiser
        >>> clean = torch.linspace(0, 1, 48).expand(1, 1, 48, 48)
        >>> noisy = clean + 0.1 * torch.randn(1, 1, 48, 48, generator=torch.Generator().manual_seed(0))
        >>> denoiser = NonlocalDenoiser.trained()
        >>> error = standard_error(lambda y: denoiser(y, 0.1), noisy, 0.1)
        >>> with torch.no_grad():
        ...     inside = (denoiser(noisy, 0.1) - clean).abs() <= 1.645 * error
        >>> bool(inside.float().mean() > 0.8)
        True
    """
    check_image(image, "image")
    if not callable(function):
        raise TypeError(f"function must be a function of an image, got {type(function).__name__}; pass a denoiser")
    inputs, rows = error_inputs(function, image.to(working_dtype(image)), noise, generator), []
    weights = _trained(inputs.deviation.device, inputs.deviation.dtype, KINDS[isinstance(noise, NoiseModel)])
    step = max(1, STRIP // (image.numel() // image.shape[2]))
    for first in range(0, image.shape[2], step):
        rows.append(log_ratio(weights, inputs.table(slice(first, first + step))).exp())
    errors = inputs.deviation * torch.cat(rows, dim=2)
    errors = torch.where(inputs.deviation > NOISELESS, errors, 0.0)
    return errors.clamp(max=torch.finfo(image.dtype).max).to(image.dtype)


@dataclass(frozen=True)
class Inputs:
    """What the network is told of each value of an image.

    Attributes:
        shared: (B, ERROR_INPUTS - 2, H, W), the same for all channels of a pixel.
        own: (B, C, H, W), logarithm of a channel's share in the errors nearby.
        deviation: (B, C, H, W), of the noise.
    """

    shared: Tensor
    own: Tensor
    deviation: Tensor

    def table(self, rows: slice) -> Tensor:
        """The inputs (B, C, h, W, ERROR_INPUTS) of some rows."""
        own, deviation = self.own[:, :, rows], self.deviation[:, :, rows]
        shared = self.shared[:, :, rows].movedim(1, -1).unsqueeze(1).expand(*own.shape, -1)
        return torch.cat([shared, own.unsqueeze(-1), deviation.log().unsqueeze(-1)], dim=-1)


def error_inputs(
    function: Callable[[Tensor], Tensor],
    image: Tensor,
    noise: float | Tensor | NoiseModel,
    generator: torch.Generator | None,
) -> Inputs:
    """Call the denoiser, and average its errors in neighbourhoods, in units of the noise."""
    random = torch.Generator().manual_seed(0) if generator is None else generator
    deviation = variance_of(noise, image).sqrt().to(image).clamp(min=NOISELESS).expand_as(image)
    result = _called(function, image)

    def in_units(difference: Tensor) -> Tensor:
        return (difference / deviation).clamp(-LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)

    added = [sampled(noise, result, random) for _ in range(DRAWS)]
    again = torch.stack([in_units(_called(function, result + field) - result).square() for field in added]).mean(0)
    probe = drawn(noise, image, random)
    derivative = in_units(probe) * in_units(_called(function, image + STEP * probe) - result) / STEP
    rest = in_units(image - result).square()
    stein = (rest - 1 + 2 * derivative).clamp(-MOST, MOST).mean(1, keepdim=True)
    rest = rest.clamp(max=MOST).mean(1, keepdim=True)
    slopes = torch.stack([in_units(slope).square() for slope in _slopes(result)]).sum(0).mean(1, keepdim=True) / 4
    coarse = torch.stack([blur(in_units(field), OWN_WIDTH).square().mean((1, 2, 3)) for field in added]).mean(0)
    shared = again.mean(1, keepdim=True)
    mean, estimated = shared.mean((2, 3), keepdim=True) + FLOOR, stein.mean((2, 3), keepdim=True)
    trust = mean / (mean + math.sqrt(2 / image[0].numel()))  # the deviation of the estimate, for normal noise
    overall = [
        mean.log(),
        (torch.lerp(torch.ones_like(mean), estimated / mean, trust).clamp(0.0, RATIOS[1]) + LEAST_RATIO).log(),
        (coarse.view(-1, 1, 1, 1) + FLOOR).log(),
        torch.full_like(shared[..., :1, :1], float(image.shape[1] > 1)),
    ]
    planes = [
        *((blur(shared, width) + FLOOR).log() for width in AGAIN),
        *((blur(slopes, width) + FLOOR).log() for width in SLOPES),
        *(blur(rest, width) for width in REST),
        *(_relative(blur(stein, width), blur(shared, near)) for width, near in zip(STEIN, AGAIN[-2:], strict=True)),
        *(number.expand_as(shared) for number in overall),
    ]
    own = ((blur(again, OWN_WIDTH) + FLOOR) / (blur(shared, OWN_WIDTH) + FLOOR)).log()
    return Inputs(torch.cat(planes, dim=1), own, deviation)


def log_ratio(weights: dict[str, Tensor], inputs: Tensor) -> Tensor:
    """The network: logarithm of the standard error in deviations of the noise, of ``inputs`` (..., ERROR_INPUTS)."""
    features = (inputs - weights["mean"]) / weights["scale"]
    for name in ("first", "second"):
        features = F.silu(F.linear(features, weights[f"{name}.weight"], weights[f"{name}.bias"]))
    return F.linear(features, weights["last.weight"], weights["last.bias"]).squeeze(-1)


def _relative(stein: Tensor, again: Tensor) -> Tensor:
    """Stein's estimate over the errors on the result, nearly linear near 0 and logarithmic where it is large."""
    return (stein / (again + FLOOR)).clamp(*RATIOS).asinh()


def _called(function: Callable[[Tensor], Tensor], image: Tensor) -> Tensor:
    output = function(image)
    check_tensor(output, "function", "return a tensor")
    check_shape(output, tuple(image.shape), "the result of function", "return an image of the same shape")
    return output.to(image)


def _slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    """Differences of the pixels on both sides of each, across and down."""
    padded = pad_border(image, 1)
    across = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    return across, padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]


@cached_constants
def _trained(device: torch.device, dtype: torch.dtype, kind: str) -> dict[str, Tensor]:
    """The weights of the package for a kind of noise."""
    weights = {tuple(name.split(".", 1)): value for name, value in read_weights(TRAINED, SHAPES).items()}
    return {name: value.to(device, dtype) for (own, name), value in weights.items() if own == kind}
