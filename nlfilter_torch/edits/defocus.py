"""A photograph as if taken with a wide aperture: sharp where one chooses, blurred elsewhere. Paper: Sec. V-C."""

import math
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_photograph, check_reach
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colour import nearby
from nlfilter_torch.edits.components import Components, correlations, find_components
from nlfilter_torch.edits.parameters import DEFOCUS
from nlfilter_torch.edits.source import Fitted, Guide, Source, edited
from nlfilter_torch.filtering.scribbles import walk_basis

Aperture = Literal["disc", "gaussian"]

REACH = 0.7  # of the correlations with the spots of the focus region
CLOSING, SMOOTHING = 0.015, 0.04  # sizes, as shares of the short side, of the gaps in a focus map that are filled
GUIDED = 12  # radius of the smoothing, in pixels, from twice of which on it takes every other one and fewer
BLURRED, SHARP = 0.15, 0.45  # likeness below BLURRED gets the whole blur, above SHARP none
STEPS = (0.1, 0.25, 0.5, 1.0)  # blurs that others are mixed from, as shares of the radius


@full_precision
def defocus(
    image: Tensor,
    focus_region: Tensor,
    *,
    radius: float | None = None,
    aperture: Aperture = DEFOCUS.defaults["aperture"],
    photometric_bandwidth: float | Tensor = DEFOCUS.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = DEFOCUS.defaults["patch_size"],
    **options: Any,
) -> Tensor:
    """Blur what is unlike, or far from, a region that stays in focus.

    Paper: Sec. V-C, eq. (18), Fig. 17. The sharp part does not bleed into the blurred one: each pixel is mixed from
    pixels that are blurred as much as itself.

    Args:
        image: (B, C, H, W) in [0, 1], C = 1 or 3.
        focus_region: (B, 1, H, W) in [0, 1], above 0 on some or all of what is to stay sharp; connected components
            may differ in colour, and each stands for what most of it covers.
        radius: of the strongest blur, in pixels, at most half the short side; None is 2.5 % of it.
        aperture: ``"disc"`` turns bright dots into discs, as a lens does; ``"gaussian"`` is the paper's, of the same
            variance.
        photometric_bandwidth: h_y of eq. (18), in units of the image.
        spatial_bandwidth: h_x of eq. (18), in pixels; None is 0.2 of the short side.
        patch_size: of the patches that are compared.
        **options: further ones of :func:`nonlocal_operator`, such as ``num_landmarks`` or ``generator``.

    Returns:
        (B, C, H, W), equal to ``image`` to rounding where it is in focus, within its range. Differentiable in image and
        region.

    Raises:
        TypeError, ValueError: if a tensor has another size, leaves its range, or the region is empty.

    Example:
        >>> image = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(0)) * 0.2
        >>> image[..., 20:] += 0.6
        >>> region = torch.zeros(1, 1, 40, 40)
        >>> region[..., 10:20, 24:34] = 1
        >>> blurred = defocus(image, region, radius=3.0, num_landmarks=50)
        >>> torch.equal(blurred[..., 10:20, 24:34], image[..., 10:20, 24:34])
        True
        >>> bool(blurred[..., :18].std() < image[..., :18].std() / 2)
        True
    """
    check_photograph(image, "image")
    return edited(
        image,
        fit_defocus,
        focus_region,
        radius=radius,
        aperture=aperture,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        **options,
    )


def fit_defocus(
    source: Source,
    focus_region: Any,
    *,
    radius: float | None = None,
    aperture: Aperture = DEFOCUS.defaults["aperture"],
    spatial_bandwidth: float | Tensor | None = None,
    **options: Any,
) -> Fitted:
    """:func:`defocus` for any source."""
    if source.channels not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels, got {source.channels}; select some")
    DEFOCUS["aperture"].check_argument(aperture)
    DEFOCUS["radius"].check_argument(radius)
    reach = float(DEFOCUS["radius"].pixels(radius, source.size))
    check_reach(reach, "radius", source.size)
    scribbles = source.scribbles(focus_region, None, "focus_region")
    options = {name: DEFOCUS.defaults[name] for name in ("photometric_bandwidth", "patch_size")} | options
    options |= {
        "spatial_bandwidth": nearby(spatial_bandwidth, DEFOCUS["spatial_bandwidth"].share, source.size),
        "guide_channels": "all",
    }
    operator = source.operator(Guide(options, spectral=True))
    basis = walk_basis(operator.pairs, REACH).to(source.dtype)
    found = find_components(scribbles, operator.at(scribbles.places), basis, source.size)
    likeness = operator.each(
        lambda columns: torch.stack([_best(*of) for of in zip(basis, found, columns.factor, strict=True)]).unsqueeze(1)
    )
    short = min(source.size)

    def finish(image: Tensor, planes: Tensor) -> Tensor:
        return blur_by(image, 1 - focus_map(image, planes[:, :1], planes[:, 1:], short), reach, aperture)

    margin, step = focus_margin(short) + _kernel_radius(reach, aperture), _every(math.ceil(SMOOTHING * short))
    return Fitted(
        lambda pixels: torch.cat([likeness(pixels), scribbles.planes(pixels)], dim=1),
        finish,
        -(-margin // step) * step,
        step,
    )


def focus_margin(short: int) -> int:
    """How many pixels around a pixel its focus depends on, in a picture whose short side has so many."""
    closing, smoothing = math.ceil(CLOSING * short), math.ceil(SMOOTHING * short)
    return 2 * closing - 1 + (2 * (smoothing + _every(smoothing)) if smoothing < short else 0)


def _every(radius: int) -> int:
    """Every how many pixels a smoothing of that radius takes one."""
    return max(1, radius // GUIDED)


def focus_map(image: Tensor, likeness: Tensor, focus_region: Tensor, short: int) -> Tensor:
    """How much every pixel belongs to what is in focus, (B, 1, H, W) in [0, 1]; the paper's mask, for many components.

    A pixel is in focus if it correlates with any component of the region. Gaps are closed, and borders follow the
    image's.

    Args:
        image: (B, C, H, W).
        likeness: largest correlation with a component of the region, (B, 1, H, W).
        focus_region: weights of the region, (B, 1, H, W).
        short: pixels of the short side of the whole picture.
    """
    from kornia.filters import guided_blur  # kornia takes half a second to import

    share = ((likeness - BLURRED) / (SHARP - BLURRED)).clamp(0.0, 1.0)
    focus = torch.maximum(share * share * (3 - 2 * share), focus_region)
    radius = math.ceil(CLOSING * short)
    # One pixel less back than forth: a patch across a border is like neither side, and would cost the subject its rim.
    closed = -largest_within(-largest_within(focus, radius), radius - 1)
    radius = math.ceil(SMOOTHING * short)
    if radius < short:  # reflection needs as many pixels
        every = _every(radius)
        window = 2 * (radius // every) * every + 1
        height, width = image.shape[-2:]
        # A multiple of the step keeps the pixels that take part evenly spaced, in tiles the same as in the whole.
        guide, rough = (F.pad(p, (0, -width % every, 0, -height % every), "replicate") for p in (image, closed))
        smooth = guided_blur(guide, rough, window, eps=1e-4, subsample=every, separable=True)
        closed = smooth[..., :height, :width]
    return torch.maximum(closed.clamp(0.0, 1.0), focus_region)


def largest_within(planes: Tensor, reach: int) -> Tensor:
    """The largest value (B, 1, H, W) within ``reach`` pixels along both axes."""
    rows = F.max_pool2d(planes, (1, 2 * reach + 1), stride=1, padding=(0, reach))
    return F.max_pool2d(rows, (2 * reach + 1, 1), stride=1, padding=(reach, 0))


def _best(basis: Tensor, components: Components, factor: Tensor) -> Tensor:
    """Largest correlation (n,) of the columns (M, n) with a component, a few components at a time."""
    return torch.stack([correlations(basis, few, factor).amax(0) for few in components.means.split(8)]).amax(0)


def blur_by(image: Tensor, amount: Tensor, radius: float, aperture: Aperture) -> Tensor:
    """Blur every pixel by ``amount`` (B, 1, H, W) in [0, 1] of the radius, from pixels that are blurred themselves."""
    result, below = image, 0.0
    for step in STEPS:
        # Sharper pixels take less part, so that the subject leaves no glow on what is behind it; the small share that
        # is left to them matters only where there is nothing else.
        weight = (amount / step).clamp(0.1, 1.0).square()
        kernel = _kernel(step * radius, aperture).to(image)
        sums = _convolve(torch.cat([image * weight, weight], dim=1), kernel)
        blurred = sums[:, :-1] / sums[:, -1:]
        result = torch.lerp(result, blurred, ((amount - below) / (step - below)).clamp(0.0, 1.0))
        below = step
    return result


def _kernel_radius(radius: float, aperture: Aperture) -> int:
    """Pixels from the middle of the kernel to its border; of a Gaussian, three standard deviations."""
    return math.ceil(radius + 0.5) if aperture == "disc" else math.ceil(1.5 * radius)


def _kernel(radius: float, aperture: Aperture) -> Tensor:
    """A square kernel of unit sum: a disc with a soft rim, or a Gaussian of the same variance."""
    reach = _kernel_radius(radius, aperture)
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64)
    squared = axis.square().unsqueeze(0) + axis.square().unsqueeze(1)
    if aperture == "disc":
        kernel = (radius + 0.5 - squared.sqrt()).clamp(0.0, 1.0)
    else:
        kernel = torch.exp(-squared / (2 * (radius / 2) ** 2))
    return kernel / kernel.sum()


def _convolve(planes: Tensor, kernel: Tensor) -> Tensor:
    """Convolve planes (B, C, H, W) with a symmetric kernel (k, k); nothing is outside the image."""
    height, width = planes.shape[-2:]
    reach = kernel.shape[0] // 2
    size = (height + 2 * reach, width + 2 * reach)
    product = torch.fft.rfft2(planes, s=size) * torch.fft.rfft2(kernel, s=size)
    return torch.fft.irfft2(product, s=size)[..., reach : reach + height, reach : reach + width]
