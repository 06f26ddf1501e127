"""Contrast and local contrast around the mean by the last two sliders. Paper: Figs. 6(a), 7(b) to 10(b)."""

import math
from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_order
from nlfilter_torch.photo.declared.parameters import TONE
from nlfilter_torch.photo.edits.synthesis import polynomial
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.limits import Limits
from nlfilter_torch.photo.picture.source import Fitted, Guide, Source, luminance
from nlfilter_torch.photo.picture.viewing import fit_change


@edit_of("image")
def adjust_tone(
    source: Source,
    /,
    *,
    contrast: float | Tensor = TONE["contrast"].idle,
    clarity: float | Tensor = TONE["clarity"].idle,
    order: int = 3,
    limits: Limits = TONE.defaults["limits"],
    viewing_size: float = TONE.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = TONE.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | str | None = TONE.defaults["spatial_bandwidth"],
    num_landmarks: int = TONE.defaults["num_landmarks"],
    **options: Any,
) -> Fitted:
    """Change the contrast of large shapes, and of the coarsest detail on them, without changing the mean.

    Paper: eq. (12) with alpha_{k+1} = contrast and alpha_k = clarity, applied to the image less its mean: since W
    preserves constants, the paper's own form would multiply the mean by alpha_{k+1}.

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, and its colours are kept.
        contrast: alpha_{k+1}, a number or a tensor of shape () or (B,); 1 changes nothing, 1.4 is strong.
        clarity: alpha_k, a number or a tensor of shape () or (B,); larger values than for ``contrast`` are usable.
        order: k, at least 1.
        limits: ``"soft"`` keeps detail in highlights and shadows, ``"none"`` adds the change as it is, lets them clip,
            and preserves the mean exactly.
        viewing_size: in megapixels; larger images are edited like their reduction to this size, with patches and
            bandwidths in its pixels; 0 is the size of the image.
        photometric_bandwidth: h_y, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; None is a twelfth of the short side, ``"none"`` compares pixels regardless of
            their distance.
        num_landmarks: M.
        **options: further options of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W) with nearly the same mean brightness; with ``limits="none"``, exactly the same mean in every
        channel, and values that may leave [0, 1]. Differentiable in image, contrast
        and clarity.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> strong = adjust_tone(image, contrast=1.4, limits="none", num_landmarks=50)
        >>> bool((strong.mean((2, 3)) - image.mean((2, 3))).abs().max() < 1e-5), bool(strong.std() > image.std())
        (True, True)
    """
    check_order(order)
    check_count(num_landmarks, "num_landmarks")
    TONE.check(source.batch, contrast=contrast, limits=limits, viewing_size=viewing_size, clarity=clarity)

    def slider(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value, dtype=source.dtype).reshape(-1).expand(source.batch)

    fine = [torch.zeros_like(slider(1.0))] * (order - 1)
    # Less 1, so that the filter gives the change.
    sliders = torch.stack([*fine, slider(clarity) - 1, slider(contrast) - 1], dim=1)

    def change(viewed: Source) -> Fitted:
        filter_options = options | {
            "photometric_bandwidth": photometric_bandwidth,
            "spatial_bandwidth": TONE["spatial_bandwidth"].distance(spatial_bandwidth, viewed.size),
            "num_landmarks": min(num_landmarks, math.prod(viewed.size)),
        }
        operator, mean = viewed.operator(Guide(filter_options)), viewed.mean(luminance)
        changed = polynomial(operator, lambda pixels: luminance(pixels) - mean, order, None)
        return Fitted(lambda pixels: changed(pixels, sliders))

    return fit_change(source, change, luminance, viewing_size, limits)
