"""A photograph as if taken with a wide aperture: sharp where one chooses, blurred elsewhere. Paper: Sec. V-C."""

import math
from functools import cached_property
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_image,
    check_photograph,
    check_reach,
    check_same_size,
)
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.edits.colour import nearby
from nlfilter_torch.edits.components import Pixels, Spots, find_spots
from nlfilter_torch.edits.parameters import DEFOCUS
from nlfilter_torch.filtering.scribbles import check_painted
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.spectrum import Spectrum

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
        focus_region: (B, 1, H, W) in [0, 1], above 0 on some or all of what is to stay sharp; several spots may differ
            in colour, and each stands for what most of it covers.
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
    if image.shape[1] not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels, got {image.shape[1]}; select some")
    DEFOCUS["aperture"].check_argument(aperture)
    DEFOCUS["radius"].check_argument(radius)
    size = (image.shape[-2], image.shape[-1])
    reach = DEFOCUS["radius"].pixels(radius, size)
    check_reach(reach, "radius", size)
    held = Defocusing(
        image,
        photometric_bandwidth=photometric_bandwidth,
        spatial_bandwidth=spatial_bandwidth,
        patch_size=patch_size,
        **options,
    )
    return held.blur(held.focus(focus_region), float(reach), aperture)


class Defocusing:
    """An image, held with the filter that finds likes in it, so that another region or blur needs no other filter.

    Args:
        image: of :func:`defocus`.
        **options: of its filter; those left out are its defaults.
    """

    def __init__(self, image: Tensor, **options: Any) -> None:
        self._image = image
        options = {name: DEFOCUS.defaults[name] for name in ("photometric_bandwidth", "patch_size")} | options
        nearness = nearby(options.get("spatial_bandwidth"), DEFOCUS["spatial_bandwidth"].share, image.shape[-2:])
        self._options = {**options, "spatial_bandwidth": nearness}

    @cached_property
    def _spectrum(self) -> Spectrum:
        """Of the filter, which is made when a region has passed its checks."""
        guide = self._image.to(working_dtype(self._image))
        return nonlocal_operator(guide, guide_channels="all", **self._options).spectrum()

    @full_precision
    def focus(self, focus_region: Tensor) -> Tensor:
        """How much every pixel is in focus, (B, 1, H, W) in [0, 1]; errors are those of :func:`defocus`."""
        image = self._image
        check_image(focus_region, "focus_region", channels=1, batch=image.shape[0])
        check_same_size(focus_region, (image.shape[-2], image.shape[-1]), "focus_region", "image")
        check_painted(focus_region, "focus_region")
        pixels = image.to(working_dtype(image))
        return focus_map(self._spectrum, pixels, focus_region.to(pixels))

    @full_precision
    def blur(self, focus: Tensor, radius: float, aperture: Aperture = DEFOCUS.defaults["aperture"]) -> Tensor:
        """The image (B, C, H, W), blurred by ``radius`` where it is not in ``focus``."""
        pixels = self._image.to(working_dtype(self._image))
        return blur_by(pixels, 1 - focus, radius, aperture).to(self._image.dtype)


def focus_map(spectrum: Spectrum, image: Tensor, focus_region: Tensor) -> Tensor:
    """How much every pixel belongs to what is in focus, (B, 1, H, W) in [0, 1]; the paper's mask, for many spots.

    A pixel is in focus if it correlates with any spot of the region. Gaps are closed, and borders follow the image's.
    """
    from kornia.filters import guided_blur  # kornia takes half a second to import: only who needs it waits

    painted = focus_region.to(spectrum.factor).expand(image.shape[0], -1, -1, -1)
    best = [_best(*found) for found in find_spots(spectrum, painted, REACH)]  # B times (N,)
    likeness = torch.stack(best).unflatten(1, spectrum.size).unsqueeze(1).to(focus_region)
    share = ((likeness - BLURRED) / (SHARP - BLURRED)).clamp(0.0, 1.0)
    focus = torch.maximum(share * share * (3 - 2 * share), focus_region)
    short = min(image.shape[-2:])
    reach = math.ceil(CLOSING * short)
    # One pixel less back than forth: a patch across a border is like neither side, and would cost the subject its rim.
    closed = -largest_within(-largest_within(focus, reach), reach - 1)
    reach = math.ceil(SMOOTHING * short)
    if reach < short:  # reflection needs as many pixels
        every = max(1, reach // GUIDED)
        window = 2 * (reach // every) * every + 1
        closed = guided_blur(image, closed, window, eps=1e-4, subsample=every, separable=True)
    return torch.maximum(closed.clamp(0.0, 1.0), focus_region)


def largest_within(planes: Tensor, reach: int) -> Tensor:
    """The largest value (B, 1, H, W) within ``reach`` pixels along both axes."""
    rows = F.max_pool2d(planes, (1, 2 * reach + 1), stride=1, padding=(0, reach))
    return F.max_pool2d(rows, (2 * reach + 1, 1), stride=1, padding=(reach, 0))


def _best(spots: Spots, pixels: Pixels) -> Tensor:
    """Largest correlation (N,) of every pixel with a spot, few spots at a time."""
    return torch.stack([pixels.along(few).amax(0) for few in spots.means.split(8)]).amax(0)


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


def _kernel(radius: float, aperture: Aperture) -> Tensor:
    """A square kernel of unit sum: a disc with a soft rim, or a Gaussian of the same variance."""
    reach = math.ceil(radius + 0.5) if aperture == "disc" else math.ceil(1.5 * radius)  # three standard deviations
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
