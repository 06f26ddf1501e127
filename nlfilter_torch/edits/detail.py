"""Detail sliders for the whole image, or for all that looks like the regions painted on it. Paper: Figs. 12, 13."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_photograph, check_positive, check_tensor
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.edits.colour import edit_luminance
from nlfilter_torch.edits.parameters import DETAIL
from nlfilter_torch.filtering.filters import blend_sliders, filter_regions, polynomial_filter
from nlfilter_torch.filtering.masks import diffusion_mask
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import reduce_channels

MASK_BANDWIDTH = 25 / 255  # of the masks, which compare colours
SHARED = ("num_landmarks", "spatial_bandwidth", "generator")  # options that the masks share with the filter


@full_precision
def enhance(
    image: Tensor,
    alpha: Tensor,
    regions: Tensor | None = None,
    *,
    negative: Tensor | None = None,
    outside: Tensor | None = None,
    residual: float | Tensor | None = DETAIL.defaults["residual"],
    channels: str = DETAIL.defaults["channels"],
    time: float | Tensor = DETAIL.defaults["time"],
    width: float | Tensor = 4.0,
    mask_bandwidth: float | Tensor = MASK_BANDWIDTH,
    **options: Any,
) -> Tensor:
    """Move the detail sliders of a photograph, each region's own sliders for all that looks like it.

    Paper: eq. (12), (13) inside the masks of eq. (17). The filter compares luminance, the masks compare colours.

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
        alpha: sliders, fine to coarse: (k+1,) or (B, k+1) without regions, one row per region, (K, k+1) or (B, K, k+1),
            with them; (k+1,) is for all regions.
        regions: (B, K, H, W), non-negative weights of the pixels of K regions; None edits the whole image.
        negative: (B, 1 or K, H, W), weights of pixels whose likes are left out, see :func:`diffusion_mask`.
        outside: sliders (k+1,) of what is in no region; None leaves it as it is.
        residual: weight of what the eigenvectors do not explain, see :func:`polynomial_filter`.
        channels: ``"luminance"`` keeps the colours, ``"all"`` edits red, green and blue alike.
        time: diffusion time of the masks; larger reaches further.
        width: squared diffusion distance at which a mask has fallen to 1/e.
        mask_bandwidth: photometric bandwidth of the masks.
        **options: of :func:`nonlocal_operator`, for the filter; ``num_landmarks``, ``spatial_bandwidth`` and
            ``generator`` hold for the masks as well.

    Returns:
        (B, C, H, W) in the image's dtype; values may leave [0, 1]. Differentiable in image, sliders and regions.

    Raises:
        TypeError, ValueError: if sizes differ, a region is empty, or ``alpha`` does not fit the regions.

    Example:
        >>> import torch
        >>> image = 0.2 * torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> region = torch.zeros(1, 1, 24, 24)
        >>> region[..., :6, :6] = 1
        >>> enhance(image, torch.tensor([3.0, 3.0, 4.0, 1.05]), region, num_landmarks=50).shape
        torch.Size([1, 3, 24, 24])
    """
    check_photograph(image, "image")
    check_tensor(alpha, "alpha")
    DETAIL["channels"].check_argument(channels)
    check_positive(mask_bandwidth, "mask_bandwidth", image.shape[0])
    pixels = image.to(working_dtype(image))
    if regions is not None:
        check_image(regions, "regions", batch=image.shape[0])
        shared = {name: value for name, value in options.items() if name in SHARED}
        if isinstance(options.get("generator"), torch.Generator):  # both filters draw from the same state
            shared["generator"] = torch.Generator(options["generator"].device)
            shared["generator"].set_state(options["generator"].get_state())
        masks = colour_masks(
            pixels, regions, negative=negative, time=time, width=width, mask_bandwidth=mask_bandwidth, **shared
        )
        sliders = alpha.expand(masks.shape[1], -1) if alpha.ndim == 1 else alpha
    elif negative is not None or outside is not None:
        name = "outside" if negative is None else "negative"
        raise ValueError(f"{name} must come with regions, got it alone; paint what is to be edited, too")
    operator = nonlocal_operator(reduce_channels(pixels, "luminance"), **options)

    def edit(planes: Tensor) -> Tensor:
        if regions is None:
            return polynomial_filter(operator, planes, alpha, residual=residual)
        if outside is None:
            return filter_regions(operator, planes, masks, sliders, residual=residual)
        return polynomial_filter(operator, planes, blend_sliders(masks, sliders, outside), residual=residual)

    return (edit(pixels) if channels == "all" else edit_luminance(pixels, edit)).to(image.dtype)


def colour_masks(
    image: Tensor,
    regions: Tensor,
    *,
    negative: Tensor | None = None,
    time: float | Tensor = DETAIL.defaults["time"],
    width: float | Tensor = 4.0,
    mask_bandwidth: float | Tensor = MASK_BANDWIDTH,
    **options: Any,
) -> Tensor:
    """Diffusion masks (B, K, H, W) by colour, as :func:`enhance` uses them, with its arguments."""
    operator = nonlocal_operator(image, photometric_bandwidth=mask_bandwidth, guide_channels="all", **options)
    return diffusion_mask(operator.spectrum(), regions.to(image), time=time, width=width, negative=negative)
