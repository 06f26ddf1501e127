"""Detail sliders for the whole image, or for everything similar to painted regions. Paper: Figs. 12, 13."""

import math
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_alpha,
    check_count,
    check_dtype,
    check_finite,
    check_image,
    check_positive,
    check_shape,
)
from nlfilter_torch.core.inner import Inner
from nlfilter_torch.operator.features import blur_margin
from nlfilter_torch.photo.declared.parameters import DETAIL, MASK
from nlfilter_torch.photo.edits.synthesis import polynomial
from nlfilter_torch.photo.picture.changes import (
    VARIANCE_SIGMA,
    activity,
    blend_changes,
    change_of_mean,
    limit_by_activity,
    split_sliders,
    sum_of,
)
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Source, luminance
from nlfilter_torch.photo.picture.viewing import fit_change
from nlfilter_torch.photo.selections.mask import select_regions


@edit_of("image")
def enhance(
    source: Source,
    /,
    alpha: Tensor,
    regions: Tensor | None = None,
    *,
    negative: Tensor | None = None,
    outside: Tensor | None = None,
    residual: float | Tensor | None = DETAIL.defaults["residual"],
    channels: str = DETAIL.defaults["channels"],
    reach: float | Tensor = DETAIL.defaults["reach"],
    mask_bandwidth: float | Tensor = DETAIL.defaults["mask_bandwidth"],
    threshold: float | Tensor = DETAIL.defaults["threshold"],
    limits: Limits = DETAIL.defaults["limits"],
    viewing_size: float = DETAIL.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = DETAIL.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = DETAIL.defaults["spatial_bandwidth"],
    num_landmarks: int = DETAIL.defaults["num_landmarks"],
    **options: Any,
) -> Fitted:
    """Apply detail sliders to a photograph, or separate sliders to everything similar to each of several regions.

    Paper: eq. (12), (13). The filter compares luminance; the masks are those of :func:`region_mask`.

    Args:
        image: (B, C, H, W) in [0, 1]; with C = 3 it is RGB, and its colours are kept.
        alpha: sliders, fine to coarse: (k+1,) or (B, k+1) without regions; with regions one row for each, (K, k+1), or
            (k+1,) for all of them.
        regions: (B, K, H, W) in [0, 1], above 0 on part or all of each of K regions, like the scribbles of
            :func:`region_mask`; None edits the whole image.
        negative: (B, 1 or K, H, W) in [0, 1], above 0 on part of the background of all regions, or of each region.
        outside: sliders (k+1,) outside all regions; None leaves these pixels unchanged.
        residual: weight of the residual of the eigenvectors, see :func:`polynomial_filter`.
        channels: ``"luminance"`` keeps the colours, ``"all"`` edits red, green and blue alike.
        reach: reach of the masks, in [0, 1); larger includes less similar pixels.
        mask_bandwidth: photometric bandwidth of the masks, in hundredths of Lab.
        threshold: standard deviation of luminance around a pixel at which detail gets half the amplification of the
            sliders; where the deviation is smaller, detail gets less. 0 amplifies all detail alike.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is and lets them
            clip.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y of the filter, or ``"auto"``.
        spatial_bandwidth: h_x of the filter in pixels; None is a twelfth of the short side, ``"none"`` compares pixels
            regardless of their distance, so that shading counts as detail, too.
        num_landmarks: M of the filter; a spatial term needs more. The masks use as many, but at most 100.
        **options: further options of :func:`nonlocal_operator` for the filter; ``generator`` also applies to the masks.

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
    check_alpha(alpha)
    check_count(num_landmarks, "num_landmarks")
    if regions is not None and source.whole:  # otherwise they are checked when they are read
        check_image(regions, "regions", batch=source.batch)
    DETAIL.check(source.batch, channels=channels, limits=limits, viewing_size=viewing_size, threshold=threshold)
    DETAIL.check(source.batch, residual=residual)
    if regions is None and (negative is not None or outside is not None):
        name = "outside" if negative is None else "negative"
        raise ValueError(f"{name} must be given together with regions, got no regions; mark the regions to edit")
    if outside is not None:
        check_shape(outside, (alpha.shape[-1],), "outside", "give as many sliders as alpha has")
        check_dtype(outside, "outside", "write 1.0 instead of 1")
        check_finite(outside, "outside")
    planes = (lambda pixels: pixels.image) if channels == "all" else luminance
    order = (alpha.shape[1] if alpha.ndim == 4 else alpha.shape[-1]) - 1
    sliders = alpha - 1  # so that sliders of 1 change nothing, bit for bit

    if regions is not None:
        check_positive(mask_bandwidth, "mask_bandwidth", source.batch)
        count = regions.shape[1] if source.whole else 1 if len(regions.shape) == 2 else regions.shape[2]
        if alpha.ndim == 1:
            sliders = sliders.expand(count, -1)
        elif alpha.ndim != 2 or len(alpha) != count:
            raise ValueError(
                f"alpha must have shape ({count}, k+1), a row of sliders for each of the regions, or (k+1,), got "
                f"{tuple(alpha.shape)}; reshape it"
            )

    elif alpha.ndim == 2 and len(alpha) not in (1, source.batch):
        raise ValueError(
            f"alpha must have shape (k+1,), or ({source.batch}, k+1) for a row per image, got {tuple(alpha.shape)}; "
            "select the rows"
        )

    def change(viewed: Source) -> Fitted:
        nearness = DETAIL["spatial_bandwidth"].distance(spatial_bandwidth, viewed.size)
        filter_options = options | {
            "photometric_bandwidth": photometric_bandwidth,
            "spatial_bandwidth": nearness,
            "num_landmarks": min(num_landmarks, math.prod(viewed.size)),
        }
        fewer = min(num_landmarks, MASK.defaults["num_landmarks"])
        compared: dict[str, Any] = {"photometric_bandwidth": mask_bandwidth, "reach": reach, "num_landmarks": fewer}
        if isinstance(options.get("generator"), torch.Generator):  # both filters draw from the same state
            compared["generator"] = options["generator"].clone_state()
        operator = viewed.operator(Guide(filter_options, exact=residual is not None))
        changed = polynomial(operator, planes, order, None if residual is None else residual - 1)

        def added_and_rest(pixels: Pixels, moved: Tensor) -> Tensor:
            halves = zip(split_sliders(moved), (0.0, None), strict=True)
            return torch.cat([changed(pixels, half, weight) for half, weight in halves], dim=1)

        def limited(image: Tensor, found: Tensor, _: Inner) -> Tensor:
            return limit_by_activity(found, activity(image), threshold)

        if regions is None:
            if not isinstance(threshold, Tensor) and threshold == 0:
                return Fitted(lambda pixels: sum_of(added_and_rest(pixels, sliders)))
            return Fitted(lambda pixels: added_and_rest(pixels, sliders), limited, blur_margin(VARIANCE_SIGMA))

        def weights(of: Any, name: str) -> Any:
            return of if of is None or viewed.size == source.size else source.resized_weights(of, viewed.size, name)

        marked = weights(regions, "regions"), weights(negative, "negative")
        masks = select_regions(viewed, *marked, names=("regions", "negative"), **compared)
        elsewhere = torch.zeros_like(sliders[0]) if outside is None else outside - 1
        rows = [*sliders, elsewhere]

        def blended(pixels: Pixels) -> Tensor:
            changes = torch.cat([added_and_rest(pixels, row) for row in rows], dim=1)
            return blend_changes(changes, masks.masks(pixels))

        return Fitted(blended, limited, blur_margin(VARIANCE_SIGMA))

    brighter: Tensor | None = None
    if regions is not None:
        brighter = None if outside is None else change_of_mean(torch.cat([sliders, outside[None] - 1]))
    elif alpha.ndim != 4:
        brighter = sliders[..., -1].reshape(-1, 1, 1, 1)
    brighter = None if brighter is None else brighter.to(source.dtype)
    return fit_change(source, change, planes, viewing_size, limits, brighter=brighter)
