"""The photometric bandwidth that suits an image. Paper: Appendix A, eq. (20)."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.checks import check_choice, check_image
from nlfilter_torch.core.communicator import Shard, meet, reduce_sum, with_halo
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.operator.features import GuideChannels, reduce_channels

# The paper's 0.6 belongs to its own patch weights, whose squares sum to 0.056; under weights of unit sum the same
# kernel has a bandwidth larger by 1 / sqrt(0.056) = 4.2, hence 2.5.
FACTOR = 2.5
SMALLEST = 1.0 / 255.0  # a flat image has no gradient; one grey level keeps the kernel defined


@full_precision
def estimate_bandwidth(guide: Tensor, *, guide_channels: GuideChannels = "luminance", group: Any = None) -> Tensor:
    """Photometric bandwidth h_y from the mean gradient magnitude: 2.5 times it, at least one grey level of 255.

    Paper: eq. (20), whose 1/n is read as the mean (outside the root it would make the bandwidth shrink with the image).

    Args:
        guide: (B, C, H, W) in [0, 1].
        guide_channels: ``"luminance"`` reduces three channels to one; ``"all"`` takes the mean over channels.
        group: of :func:`nonlocal_operator`: ``guide`` is then what this rank has of the rows.

    Returns:
        (B,), in units of the guide. Constant, as no gradient reaches the guide through it.

    Raises:
        TypeError, ValueError: if ``guide`` is not a finite floating-point (B, C, H, W) tensor.

    Example:
        >>> estimate_bandwidth(torch.linspace(0, 1, 101).expand(1, 1, 8, 101)) * 255  # a slope of 0.01 a pixel
        tensor([6.3119])
    """
    check_image(guide, "guide")
    check_choice(guide_channels, "guide_channels", ("luminance", "all"))
    with torch.no_grad():
        rows = reduce_channels(guide.to(working_dtype(guide)), guide_channels)
        shard = meet(rows, group)
        return bandwidth_of_rows(*with_halo(rows, 1, shard), shard)


def bandwidth_of_rows(guide: Tensor, halo: tuple[int, int], shard: Shard | None) -> Tensor:
    """:func:`estimate_bandwidth` from some rows of an image, and as many of their neighbours as ``halo`` tells."""
    with torch.no_grad():
        magnitude = gradients(guide, halo)
        count = magnitude[0].numel() if shard is None else guide.shape[1] * shard.pixels
        mean = reduce_sum(magnitude.sum((1, 2, 3), dtype=torch.float64), shard) / count
        return bandwidth_of_gradient(mean).clamp(max=torch.finfo(guide.dtype).max).to(guide)


def gradients(guide: Tensor, halo: tuple[int, int]) -> Tensor:
    """Magnitude of the gradient (B, C, h, W) at the rows of a guide that lie between those of its halo."""
    # Central differences by slices take a twentieth of the time of a convolution, kornia's import not counted.
    padded = F.pad(guide / 2, (1, 1, 1, 1), mode="replicate")  # halved first: no finite value overflows
    down = padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]
    right = padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]
    magnitude = (down.square() + right.square()).sqrt()
    if magnitude.device.type != "cpu" or not bool(magnitude.sum().isfinite()):
        # Cannot overflow, but on a processor the last digit may depend on the place of a pixel, and so on tiles.
        magnitude = torch.hypot(down, right)
    return magnitude[:, :, halo[0] : guide.shape[2] - halo[1]]


def bandwidth_of_gradient(mean: Tensor) -> Tensor:
    """The bandwidth for a mean magnitude of the gradient."""
    return (FACTOR * mean).clamp(min=SMALLEST)
