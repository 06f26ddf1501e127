"""Guide image to features: weighted patches and coordinates, scaled by the bandwidths. Paper: eq. (1), (18).

Also the photometric bandwidth that suits an image. Paper: Appendix A, eq. (20).
"""

import math
from itertools import product
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.autograd import Gradients, once_differentiable
from nlfilter_torch.core.blocks import large_empty
from nlfilter_torch.core.checks import (
    LARGEST_PATCH,
    check_choice,
    check_finite,
    check_image,
    check_patch_size,
    check_tensor,
)
from nlfilter_torch.core.communicator import Communicator, all_gather_shapes
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.values import is_hidden

GuideChannels = Literal["luminance", "all"]
Bandwidth = float | Tensor | None


def patch_window(patch_size: int) -> Tensor:
    """Gaussian patch weights of unit sum, (patch_size, patch_size), sigma = patch_size / 4.

    With unit sum the photometric bandwidth is in grey levels of the guide whatever the patch size.
    """
    profile = torch.signal.windows.gaussian(patch_size, std=patch_size / 4, dtype=torch.float64)
    window = torch.outer(profile, profile)
    return window / window.sum()


def unit_window(patch_size: int, patch_weights: Tensor | None) -> Tensor:
    """The weights of the patch (p, p), of unit sum."""
    check_patch_size(patch_size)
    if patch_weights is None:
        return patch_window(patch_size)
    check_tensor(patch_weights, "patch_weights")
    if patch_weights.dtype.is_complex or patch_weights.dtype == torch.bool:
        raise TypeError(f"patch_weights must be real numbers, got {patch_weights.dtype}; convert them")
    if patch_weights.ndim != 2 or patch_weights.shape[0] != patch_weights.shape[1] or patch_weights.shape[0] % 2 == 0:
        raise ValueError(
            f"patch_weights must have shape (p, p) with odd p, got {tuple(patch_weights.shape)}; crop or pad them"
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
    return patch_weights / patch_weights.sum()


def reduce_channels(guide: Tensor, guide_channels: GuideChannels) -> Tensor:
    """(B, 3, H, W) to luminance (B, 1, H, W) unless ``guide_channels`` is ``"all"``; other guides are taken whole."""
    if guide_channels == "luminance" and guide.shape[1] == 3:
        from kornia.color import rgb_to_grayscale  # importing kornia takes half a second

        return rgb_to_grayscale(guide)
    return guide


def extract_features(
    guide: Tensor,
    *,
    patch_weights: Tensor,
    photometric_bandwidth: float | Tensor,
    spatial_bandwidth: Bandwidth = None,
    origin: tuple[int, int] = (0, 0),
    halo: tuple[int, int] = (0, 0),
    stride: int = 1,
) -> Tensor:
    """Features whose squared distance is the exponent of the kernel: ``K_ij = exp(-||x_i - x_j||^2)``.

    Paper: eq. (1), with the mean over channels where the guide has several, and eq. (18).

    Args:
        guide: (B, C, H, W), already reduced to the channels that are compared.
        patch_weights: (p, p), non-negative, of unit sum; differentiable.
        photometric_bandwidth: h_y in units of the guide, a number or a tensor of shape () or (B,).
        spatial_bandwidth: h_x in pixels, likewise; None leaves the coordinates out.
        origin: coordinates (row, column) of the first pixel.
        halo: rows at the top and at the bottom that patches reach into, but that get no features themselves.
        stride: n, to take only the pixel in the middle of each whole square of n x n pixels.

    Returns:
        (B, D, N) with D = C p^2, plus 2 with coordinates, N pixels in the rows without the halo. Pixels come last: each
        feature is a plane.
    """
    batch, channels, height, width = guide.shape
    size = patch_weights.shape[0]
    scale = patch_weights.to(guide).div(channels).sqrt() / _per_image(photometric_bandwidth, guide).view(-1, 1, 1)
    padded = pad_border(guide, size // 2)
    # Rows of the halo replace reflected ones; a halo shorter than the margin ends at the border of the image.
    padded = padded[..., halo[0] : padded.shape[-2] - halo[1], :]
    features: Tensor = (
        _ScaledPatches.apply(padded, scale)  # type: ignore[no-untyped-call]
        if stride == 1
        else _strided_patches(padded, scale, stride)
    )
    if spatial_bandwidth is None:
        return features
    height, width = (height - halo[0] - halo[1]) // stride, width // stride
    rows = origin[0] + halo[0] + stride * torch.arange(height, dtype=guide.dtype, device=guide.device)
    columns = origin[1] + stride * torch.arange(width, dtype=guide.dtype, device=guide.device)
    grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij")).flatten(1)  # (2, N)
    coordinates = grid / _per_image(spatial_bandwidth, guide).view(-1, 1, 1)
    return torch.cat([features, coordinates.expand(batch, -1, -1)], dim=1)


def _strided_patches(padded: Tensor, scale: Tensor, stride: int) -> Tensor:
    """Weighted patches (B, C p^2, n) of every ``stride``-th pixel of a padded image."""
    size, first = scale.shape[-1], (stride - 1) // 2
    height, width = ((length - size + 1) // stride for length in padded.shape[-2:])
    patches = padded.unfold(2, size, 1).unfold(3, size, 1)[:, :, first::stride, first::stride]
    patches = patches[:, :, :height, :width].permute(0, 1, 4, 5, 2, 3)  # (B, C, p, p, h, w)
    return (patches * scale[:, None, :, :, None, None]).flatten(4).flatten(1, 3)


class _ScaledPatches(torch.autograd.Function):
    """A plane for each offset of the patch: a shifted copy of the image times the weight of that offset."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(padded, scale)
        height, width = (padded.shape[-2] - scale.shape[-2] + 1, padded.shape[-1] - scale.shape[-1] + 1)
        batch, channels = padded.shape[:2]
        shifted = padded.unfold(2, height, 1).unfold(3, width, 1)  # (B, C, p, p, H, W): views, not copies
        if torch.compiler.is_compiling():
            return (shifted * scale[:, None, :, :, None, None]).flatten(4).flatten(1, 3)
        features = large_empty((batch, channels, *scale.shape[1:], height, width), padded)
        torch.mul(shifted, scale[:, None, :, :, None, None], out=features)
        return features.flatten(4).flatten(1, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Gradients:
        padded, scale = ctx.saved_tensors
        height, width = (padded.shape[-2] - scale.shape[-2] + 1, padded.shape[-1] - scale.shape[-1] + 1)
        grad_padded, grad_scale = torch.zeros_like(padded), torch.zeros_like(scale)
        planes = grad.unflatten(2, (height, width))
        offsets = product(*map(range, (padded.shape[1], *scale.shape[1:])))  # channel, row and column of each plane
        for plane, (channel, y, x) in enumerate(offsets):
            window = (slice(None), channel, slice(y, y + height), slice(x, x + width))
            grad_padded[window] += planes[:, plane] * scale[:, y, x, None, None]
            moved = (planes[:, plane] * padded[window]).sum((1, 2))  # (B,)
            grad_scale[:, y, x] += moved if scale.shape[0] == moved.shape[0] else moved.sum()
        return grad_padded, grad_scale


def pad_border(image: Tensor, margin: int) -> Tensor:
    """Pad by reflection; an axis that is too short to be reflected is replicated."""
    height, width = image.shape[-2:]
    for pad, length in (((margin, margin, 0, 0), width), ((0, 0, margin, margin), height)):
        image = F.pad(image, pad, mode="reflect" if length > margin else "replicate")
    return image


def blur_margin(sigma: float) -> int:
    """How many pixels around a pixel :func:`blur` reads."""
    return math.ceil(3 * sigma)


def blur(planes: Tensor, sigma: float) -> Tensor:
    """Planes (B, C, H, W) under a Gaussian of that many pixels, reflected at the border."""
    from kornia.filters import gaussian_blur2d  # kornia takes half a second to import

    margin = blur_margin(sigma)
    size = 2 * margin + 1
    blurred = gaussian_blur2d(pad_border(planes, margin), (size, size), (sigma, sigma))
    return blurred[..., margin:-margin, margin:-margin]


def _per_image(value: float | Tensor, like: Tensor) -> Tensor:
    """A bandwidth as a tensor of shape (1,) or (B,) in the dtype and on the device of ``like``."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).reshape(-1)


# The paper's 0.6 belongs to its own patch weights, whose squares sum to 0.056; under weights of unit sum the same
# kernel has a bandwidth larger by 1 / sqrt(0.056) = 4.2, hence 2.5.
FACTOR = 2.5
SMALLEST = 1.0 / 255.0  # a flat image has no gradient; one grey level keeps the kernel defined


@full_precision
def estimate_bandwidth(guide: Tensor, *, guide_channels: GuideChannels = "luminance", group: Any = None) -> Tensor:
    """Photometric bandwidth h_y: 2.5 times the mean gradient magnitude, at least one grey level of 255.

    Paper: eq. (20), whose 1/n is read as the mean (outside the root it would make the bandwidth shrink with the image).

    Args:
        guide: (B, C, H, W) in [0, 1].
        guide_channels: ``"luminance"`` reduces three channels to one; ``"all"`` takes the mean over channels.
        group: as of :func:`nonlocal_operator`: ``guide`` is then the rows of this rank.

    Returns:
        (B,), in units of the guide, without a gradient.

    Raises:
        TypeError, ValueError: if ``guide`` is not a finite floating-point (B, C, H, W) tensor.

    Example:
        >>> estimate_bandwidth(torch.linspace(0, 1, 101).expand(1, 1, 8, 101)) * 255  # a slope of 0.01 a pixel
        tensor([6.3119])
    """
    check_image(guide, "guide", empty=True)
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    with torch.no_grad():
        rows = reduce_channels(guide.to(working_dtype(guide)), guide_channels)
        among = all_gather_shapes(rows, group)
        return bandwidth_of_rows(*among.with_halo(rows, 1), among)


def bandwidth_of_rows(guide: Tensor, halo: tuple[int, int], among: Communicator) -> Tensor:
    """:func:`estimate_bandwidth` from some rows of an image with a halo of neighbouring rows."""
    with torch.no_grad():
        magnitude = gradients(guide, halo)
        count = magnitude.shape[1] * among.pixels(magnitude.shape[2] * magnitude.shape[3])
        mean = among.sum(magnitude.sum((1, 2, 3), dtype=torch.float64)) / count
        return bandwidth_of_gradient(mean).clamp(max=torch.finfo(guide.dtype).max).to(guide)


def gradients(guide: Tensor, halo: tuple[int, int]) -> Tensor:
    """Magnitude of the gradient (B, C, h, W) at the rows of a guide that lie between those of its halo."""
    # Central differences by slices take a twentieth of the time of a convolution, kornia's import not counted.
    padded = F.pad(guide / 2, (1, 1, 1, 1), mode="replicate")  # halved first: no finite value overflows
    down = padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    right = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    magnitude = (down.square() + right.square()).sqrt()
    if is_hidden(magnitude) or not bool(magnitude.sum().isfinite()):
        # hypot cannot overflow, but on processors its last digit depends on the position in memory, and so on tiles.
        magnitude = torch.hypot(down, right)
    return magnitude[:, :, halo[0] : guide.shape[2] - halo[1]]


def bandwidth_of_gradient(mean: Tensor) -> Tensor:
    """The bandwidth for a mean magnitude of the gradient."""
    return (FACTOR * mean).clamp(min=SMALLEST)
