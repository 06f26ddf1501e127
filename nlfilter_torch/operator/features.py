"""Features of a guide image: weighted patches and coordinates, scaled by the bandwidths. Paper: eq. (1), (18).

Also the estimate of the photometric bandwidth. Paper: Appendix A, eq. (20).
"""

import math
from dataclasses import dataclass
from functools import reduce
from itertools import product
from types import EllipsisType
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.blocks import for_planes
from nlfilter_torch.core.checks import (
    LARGEST_PATCH,
    check_choice,
    check_finite,
    check_image,
    check_patch_size,
    check_pixel_weights,
    check_tensor,
)
from nlfilter_torch.core.communicator import Communicator, all_gather_shapes
from nlfilter_torch.core.kernels.columns import large_empty
from nlfilter_torch.core.precision import Gradients, full_precision, once_differentiable, per_image, working_dtype
from nlfilter_torch.core.torch_internals import cached_constants, for_each_gradient, is_hidden
from nlfilter_torch.operator.hidden import fill_hidden
from nlfilter_torch.operator.options import FilterOptions, GuideChannels, SpatialBandwidth, bandwidths_of
from nlfilter_torch.operator.orientation import Layout

LUMINANCE = (0.299, 0.587, 0.114)  # shares of red, green and blue
FAINT_WEIGHT = 1e-12  # in place of patch weights of 0
FOLDED = 1 << 14  # pixels up to which the gradient of patches is computed in one call


@cached_constants
def patch_window(patch_size: int, axes: int = 2) -> Tensor:
    """Gaussian patch weights of unit sum, (p, p) for images and (p, p, p) for volumes, with sigma = p / 4.

    Because of the unit sum, the photometric bandwidth is in grey levels of the guide for any patch size.
    """
    profile = torch.signal.windows.gaussian(patch_size, std=patch_size / 4, dtype=torch.float64)
    window = profile
    for _ in range(axes - 1):
        window = window.unsqueeze(-1) * profile
    return window / window.sum()


def unit_window(patch_size: int, patch_weights: Tensor | None, axes: int = 2) -> Tensor:
    """Patch weights (p, p) or (p, p, p) scaled to unit sum; the Gaussian window of so many axes if none are given."""
    check_patch_size(patch_size)
    if patch_weights is None:
        return patch_window(patch_size, axes)
    check_tensor(patch_weights, "patch_weights")
    if patch_weights.dtype.is_complex or patch_weights.dtype == torch.bool:
        raise TypeError(f"patch_weights must be real numbers, got {patch_weights.dtype}; convert them")
    if patch_weights.ndim not in (2, 3) or len(set(patch_weights.shape)) > 1 or patch_weights.shape[0] % 2 == 0:
        raise ValueError(
            "patch_weights must have shape (p, p) with odd p, or (p, p, p) for volumes, got "
            f"{tuple(patch_weights.shape)}; crop or pad them"
        )
    if len(patch_weights) > LARGEST_PATCH:
        raise ValueError(
            f"patch_weights must have at most {LARGEST_PATCH} rows, got {len(patch_weights)}; "
            "downscale the image instead"
        )
    check_finite(patch_weights, "patch_weights")
    if not is_hidden(patch_weights) and not bool((patch_weights >= 0).all() & (patch_weights.sum() > 0)):
        raise ValueError(
            "patch_weights must be non-negative with a positive sum, got other values; take their softmax or square"
        )
    weights = patch_weights.to(working_dtype(patch_weights))
    weights = weights / weights.detach().max()  # so that the sum does not overflow
    return weights / weights.sum()


def reduce_channels(guide: Tensor, guide_channels: GuideChannels) -> Tensor:
    """Reduce three channels to luminance (B, 1, ...) unless ``guide_channels`` is ``"all"``; keep other guides."""
    if guide_channels == "luminance" and guide.shape[1] == 3:
        red, green, blue = guide.unbind(1)
        return (LUMINANCE[0] * red).add(green, alpha=LUMINANCE[1]).add(blue, alpha=LUMINANCE[2]).unsqueeze(1)
    return guide


@dataclass(frozen=True, eq=False)
class GuideFeatures:
    """Features that define the kernel by their squared distances: ``K_ij = exp(-||x_i - x_j||^2)``.

    Paper: eq. (1), with the mean over channels if the guide has several, and eq. (18).

    Attributes:
        patch_weights: (p, p), or (p, p, p) for volumes, non-negative, of unit sum; differentiable.
        photometric_bandwidth: h_y in units of the guide, a number or a tensor of shape () or (B,).
        spatial_bandwidth: h_x in pixels, a number or a tensor of shape () or (B,), or one of them for each axis; None
            leaves out the coordinates.
        guide_channels: ``"luminance"`` or ``"all"``.
    """

    patch_weights: Tensor
    photometric_bandwidth: float | Tensor
    spatial_bandwidth: SpatialBandwidth | None
    guide_channels: GuideChannels

    @staticmethod
    def of(
        options: FilterOptions, bandwidth: float | Tensor, dtype: torch.dtype, device: torch.device | None = None
    ) -> "GuideFeatures":
        """The features by options that were checked, with the Gaussian window and this photometric bandwidth."""
        window = unit_window(options.patch_size, None).to(device, dtype)
        spatial = cast(SpatialBandwidth | None, options.spatial_bandwidth)  # words were refused
        return GuideFeatures(window, bandwidth, spatial, options.guide_channels)

    @property
    def layout(self) -> Layout | None:
        """Which features belong to which place of a patch; None for volumes."""
        return (
            None
            if self.patch_weights.ndim > 2
            else Layout(self.patch_weights.shape[0], self.spatial_bandwidth is not None)
        )

    def __call__(
        self,
        guide: Tensor,
        *,
        origin: tuple[int, ...] = (0, 0),
        halo: tuple[int, int] = (0, 0),
        stride: int = 1,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Compute the features of a guide, or of a tile of it.

        Args:
            guide: (B, C, H, W) or (B, C, D, H, W), with the channels of the guide from which the landmarks come.
            origin: coordinates (row, column) of the first pixel in that guide; 0 along axes that are left out.
            halo: numbers of rows at the top and at the bottom that are read by patches but get no features themselves:
                half a patch, or less at the border of the whole guide.
            stride: n, to use only the pixel in the middle of each complete square of n x n pixels; for images only.
            counts: (B or 1, 1, H, W), true where a pixel counts, for a guide without a halo. Patches read what counts
                alone, and are continued elsewhere by :func:`fill_hidden`. None means that all pixels do.

        Returns:
            (B, D, N) with D = C p^2, or C p^3 for volumes, plus 2 or 3 with coordinates; N counts the pixels outside
            the halo. Pixels come last: each feature is a plane.
        """
        guide = reduce_channels(guide.to(self.patch_weights.dtype), self.guide_channels)
        batch, channels, height, *row = guide.shape
        scale = self._patch_scale(channels, guide)
        margin = scale.shape[-1] // 2
        padded = pad_border(guide, margin) if counts is None else fill_hidden(guide, counts, margin)
        # Halo rows replace reflected ones; a halo shorter than the margin ends at the border of the image.
        padded = padded[:, :, halo[0] : padded.shape[2] - halo[1]]
        features: Tensor = (
            _ScaledPatches.apply(padded, scale)  # type: ignore[no-untyped-call]
            if stride == 1
            else _strided_patches(padded, scale, stride)
        )
        if self.spatial_bandwidth is None:
            return features
        starts = (origin[0] + halo[0], *origin[1:], 0)  # the last is that of a third axis
        axes = [
            start + stride * torch.arange(length // stride, dtype=guide.dtype, device=guide.device)
            for start, length in zip(starts, (height - halo[0] - halo[1], *row), strict=False)
        ]
        grid = torch.stack(torch.meshgrid(*axes, indexing="ij")).flatten(1)  # (2 or 3, N)
        return torch.cat([features, self.coordinates(grid).expand(batch, -1, -1)], dim=1)

    def _patch_scale(self, channels: int, like: Tensor) -> Tensor:
        """Factors (1 or B, p, p) or (1 or B, p, p, p) of the pixels of a patch, in the format of ``like``."""
        weights = self.patch_weights.to(like).div(channels)
        # The derivative of the root is infinite at 0, but that of squared distances is not.
        weights = weights + FAINT_WEIGHT * (weights == 0).to(weights)
        return weights.sqrt() / per_image(self.photometric_bandwidth, like, 1 + weights.ndim)

    def scales(self, like: Tensor) -> Tensor:
        """Factors (1 or B, D, 1) from pixels and coordinates to features like those of ``like``, (B, D, n)."""
        located, axes = self.spatial_bandwidth is not None, self.patch_weights.ndim
        channels = max((like.shape[1] - axes * located) // self.patch_weights.numel(), 1)
        patch = self._patch_scale(channels, like).flatten(1).repeat(1, channels).unsqueeze(2)
        if not located:
            return patch
        places = self.coordinates(like.new_ones(axes, 1))
        batch = max(patch.shape[0], places.shape[0])
        return torch.cat([patch.expand(batch, -1, -1), places.expand(batch, -1, -1)], dim=1)

    def coordinates(self, places: Tensor) -> Tensor:
        """Features (1 or B, 2, N) of rows and columns (2, N) of pixels, or (1 or B, 3, N) of voxels (3, N).

        There must be a spatial bandwidth.
        """
        bandwidths = [per_image(bandwidth, places, 2) for bandwidth in bandwidths_of(self.spatial_bandwidth)]
        return places / torch.stack(torch.broadcast_tensors(*bandwidths), dim=1)


def _strided_patches(padded: Tensor, scale: Tensor, stride: int) -> Tensor:
    """Weighted patches (B, C p^2, n) of every ``stride``-th pixel of a padded image, along both axes."""
    size, first = scale.shape[-1], (stride - 1) // 2
    height, width = ((length - size + 1) // stride for length in padded.shape[-2:])
    patches = padded.unfold(2, size, 1).unfold(3, size, 1)[:, :, first::stride, first::stride]
    patches = patches[:, :, :height, :width].permute(0, 1, 4, 5, 2, 3)  # (B, C, p, p, h, w)
    return (patches * scale[:, None, :, :, None, None]).flatten(4).flatten(1, 3)


class _ScaledPatches(torch.autograd.Function):
    """One plane per patch offset: the image shifted by the offset, times the weight of the offset.

    Images (B, C, H, W) with a scale (1 or B, p, p), or volumes (B, C, D, H, W) with a scale (1 or B, p, p, p).
    """

    @staticmethod
    def forward(ctx: Any, padded: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(padded, scale)
        size, last, shifted = _inner_size(padded, scale), padded.ndim - 1, padded
        # (B, C, p, p, H, W): views, not copies. The windows are patches, since their size must be known in a program.
        for axis in range(2, padded.ndim):
            shifted = shifted.unfold(axis, scale.shape[-1], 1)
        shifted = shifted.permute(0, 1, *range(padded.ndim, shifted.ndim), *range(2, padded.ndim))
        scales = for_planes(scale.unsqueeze(1), len(size))
        if torch.compiler.is_compiling():
            return (shifted * scales).flatten(last + 1).flatten(1, last)
        features = large_empty((*padded.shape[:2], *scale.shape[1:], *size), padded)
        torch.mul(shifted, scales, out=features)
        return features.flatten(last + 1).flatten(1, last)

    @staticmethod
    @for_each_gradient
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        padded, scale = ctx.saved_tensors
        size, (of_padded, of_scale) = _inner_size(padded, scale), ctx.needs_input_grad
        axes = len(size)
        grad_padded = torch.zeros_like(padded) if of_padded else None
        grad_scale = torch.zeros_like(scale) if of_scale else None
        planes = grad.unflatten(2, size).unflatten(1, (padded.shape[1], *scale.shape[1:]))  # (B, C, p, p, H, W)
        if of_padded and not of_scale and axes == 2 and grad[0, 0].numel() <= FOLDED:
            weighted = planes * for_planes(scale.unsqueeze(1), axes)
            return F.fold(weighted.flatten(4).flatten(1, 3), padded.shape[2:], scale.shape[1:]), None
        # A row of the patch at a time: a number of planes that stays in the cache.
        for place in product(*map(range, scale.shape[1:-1])):
            rows = [slice(start, start + length) for start, length in zip(place, size, strict=False)]
            window: tuple[EllipsisType | slice, ...] = (..., *rows, slice(None))
            row: tuple[int | slice, ...] = (slice(None), *place)
            moved, factors = planes[(slice(None), *row)], scale[row]  # (B, C, p, H, W), (1 or B, p)
            if grad_padded is not None:
                weighted = moved * for_planes(factors.unsqueeze(1), axes)
                for start, part in enumerate(weighted.unbind(2)):
                    grad_padded[window].narrow(-1, start, size[-1]).add_(part)
            if grad_scale is not None:
                shifted = padded[window].unfold(-1, scale.shape[-1], 1).movedim(-1, 2)
                totals = (moved * shifted).flatten(3).sum(3).sum(1)  # (B, p)
                grad_scale[row] = totals if len(scale) == len(totals) else totals.sum(0)
        return grad_padded, grad_scale


def _inner_size(padded: Tensor, scale: Tensor) -> tuple[int, ...]:
    """Size of the image that was padded for patches with this scale, (1 or B, p, ...)."""
    return tuple(length - side + 1 for length, side in zip(padded.shape[2:], scale.shape[1:], strict=True))


def pad_border(image: Tensor, margin: int) -> Tensor:
    """Pad by reflection, or by replication along an axis that is too short for reflection."""
    axes = image.ndim - 2
    for axis in range(axes):  # from the last one, as in the argument of F.pad
        pad = [0] * 2 * axes
        pad[2 * axis : 2 * axis + 2] = margin, margin
        image = F.pad(image, pad, mode="reflect" if image.shape[-1 - axis] > margin else "replicate")
    return image


def blur_margin(sigma: float) -> int:
    """Radius, in pixels, of the neighbourhood that :func:`blur` reads."""
    return math.ceil(3 * sigma)


def blur(planes: Tensor, sigma: float) -> Tensor:
    """Blur planes (B, C, H, W) by a Gaussian of ``sigma`` pixels, with reflection at the border."""
    from kornia.filters import gaussian_blur2d  # importing kornia takes half a second

    margin = blur_margin(sigma)
    size = 2 * margin + 1
    blurred = gaussian_blur2d(pad_border(planes, margin), (size, size), (sigma, sigma))
    return blurred[..., margin:-margin, margin:-margin]


# The paper's 0.6 applies to its own patch weights, whose squares sum to 0.056; with weights of unit sum the same kernel
# has a bandwidth larger by a factor of 1 / sqrt(0.056) = 4.2, hence 2.5.
FACTOR = 2.5
SMALLEST = 1.0 / 255.0  # one grey level; keeps the kernel defined for a constant image, whose gradient is zero


@full_precision
def estimate_bandwidth(
    guide: Tensor,
    *,
    guide_channels: GuideChannels = "luminance",
    weights: Tensor | None = None,
    group: Any = None,
) -> Tensor:
    """Estimate the photometric bandwidth h_y: 2.5 times the mean gradient magnitude, at least 1 / 255.

    Paper: eq. (20), with 1/n read as a mean (outside the root the bandwidth would decrease with image size).

    Args:
        guide: (B, C, H, W) in [0, 1], or a volume (B, C, D, H, W).
        guide_channels: ``"luminance"`` reduces three channels to one; ``"all"`` takes the mean over channels.
        weights: as for :func:`nonlocal_operator`: how much each pixel counts in the mean.
        group: as for :func:`nonlocal_operator`; ``guide`` then holds the rows of this rank.

    Returns:
        (B,), in units of the guide, without a gradient.

    Raises:
        TypeError, ValueError: if ``guide`` is not a finite floating-point tensor of such a shape, or ``weights`` do not
            fit it.

    Example:
        >>> estimate_bandwidth(torch.linspace(0, 1, 101).expand(1, 1, 8, 101)) * 255  # a slope of 0.01 per pixel
        tensor([6.3119])
    """
    check_image(guide, "guide", empty=True, dimensions=(4, 5))
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    with torch.no_grad():
        rows = reduce_channels(guide.to(working_dtype(guide)), guide_channels)
        if weights is not None:
            weights = check_pixel_weights(weights, rows, group)
            return bandwidth_of_weighted(rows, weights, weights > 0)
        communicator = all_gather_shapes(rows, group)
        return bandwidth_of_rows(*communicator.with_halo(rows, 1), communicator)


def bandwidth_of_weighted(guide: Tensor, weights: Tensor, counts: Tensor | None) -> Tensor:
    """:func:`estimate_bandwidth` of a whole image whose pixels have weights (B, 1, H, W).

    Hidden pixels are filled where ``counts`` is not true; with None, gradients are :func:`gradients_within`.
    """
    with torch.no_grad():
        if counts is None:
            magnitude = gradients_within(guide, weights > 0)
        else:
            magnitude = _magnitude(fill_hidden(guide / 2, counts, 1, mirrored=False))
        magnitude = magnitude.mean(1, keepdim=True).double()
        mean = (magnitude * weights).flatten(1).sum(1) / weights.double().flatten(1).sum(1)
        return bandwidth_of_gradient(mean).clamp(max=torch.finfo(guide.dtype).max).to(guide)


def bandwidth_of_rows(guide: Tensor, halo: tuple[int, int], communicator: Communicator) -> Tensor:
    """:func:`estimate_bandwidth` from part of the rows of an image, given with a halo of neighbouring rows."""
    with torch.no_grad():
        magnitude = gradients(guide, halo)
        planes = magnitude.flatten(2)  # (B, C, N)
        count = planes.shape[1] * communicator.pixels(planes.shape[2])
        mean = communicator.sum(planes.sum((1, 2), dtype=torch.float64)) / count
        return bandwidth_of_gradient(mean).clamp(max=torch.finfo(guide.dtype).max).to(guide)


def gradients(guide: Tensor, halo: tuple[int, int]) -> Tensor:
    """Gradient magnitude (B, C, h, ...) of the rows of a guide, without those of the halo."""
    # Central differences by slicing take a twentieth of the time of a convolution, not counting the import of kornia.
    padded = F.pad(guide / 2, (1, 1) * (guide.ndim - 2), mode="replicate")  # halved, so that no finite value overflows
    return _magnitude(padded)[:, :, halo[0] : guide.shape[2] - halo[1]]


def gradients_within(guide: Tensor, counts: Tensor) -> Tensor:
    """Gradient magnitude (B, C, H, W) of a guide, with a pixel itself in place of neighbours that do not count."""
    half, squares = guide / 2, torch.zeros((), dtype=guide.dtype, device=guide.device)
    for axis in (2, 3):
        length, slope = guide.shape[axis], torch.zeros_like(guide)
        if length > 1:
            first, last = half.narrow(axis, 0, length - 1), half.narrow(axis, 1, length - 1)
            slope.narrow(axis, 0, length - 1).add_((last - first) * counts.narrow(axis, 1, length - 1))
            slope.narrow(axis, 1, length - 1).add_((last - first) * counts.narrow(axis, 0, length - 1))
        squares = squares + slope.square()
    return squares.sqrt()


def _magnitude(padded: Tensor) -> Tensor:
    """Gradient magnitude (B, C, H, ...) of half an image that is padded by a pixel on all sides."""
    slopes = []
    for axis in range(2, padded.ndim):
        lines = padded
        for other in range(2, padded.ndim):
            lines = lines if other == axis else lines.narrow(other, 1, padded.shape[other] - 2)
        length = padded.shape[axis] - 2
        slopes.append(lines.narrow(axis, 2, length) - lines.narrow(axis, 0, length))
    squares = (slope.square() for slope in slopes)
    magnitude = reduce(torch.add, squares).sqrt()
    if is_hidden(magnitude) or not math.isfinite(float(magnitude.sum())):
        # hypot cannot overflow, but on CPUs its last digit depends on the position in memory, and therefore on tiling.
        magnitude = reduce(torch.hypot, slopes)
    return magnitude


def bandwidth_of_gradient(mean: Tensor) -> Tensor:
    """Photometric bandwidth for a mean gradient magnitude."""
    return (FACTOR * mean).clamp(min=SMALLEST)
