"""Contrast and local contrast by the last two sliders, around the mean. Paper: Figs. 6(a), 7(b) to 10(b)."""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_order, check_photograph
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.edits.colour import edit_luminance
from nlfilter_torch.edits.parameters import TONE
from nlfilter_torch.edits.source import Fitted, Guide, Source, edited, luminance, polynomial


@full_precision
def adjust_tone(
    image: Tensor,
    *,
    contrast: float | Tensor = TONE["contrast"].idle,
    clarity: float | Tensor = TONE["clarity"].idle,
    order: int = 3,
    **options: Any,
) -> Tensor:
    """Raise or lower the contrast of large shapes, and of the coarsest detail on them, with the mean held.

    Paper: eq. (12) with alpha_{k+1} = contrast and alpha_k = clarity. Since W keeps constants, the mean takes no part:
    the paper's own form would brighten the image by alpha_{k+1}.

    Args:
        image: (B, C, H, W); with C = 3 it is RGB, and its colours are kept.
        contrast: alpha_{k+1}, a number or a tensor of shape () or (B,); 1 changes nothing, 1.4 is strong.
        clarity: alpha_k, likewise; bears larger values.
        order: k, at least 1.
        **options: of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W) of the same mean in every channel; values may leave [0, 1]. Differentiable in image, contrast and
        clarity.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> strong = adjust_tone(image, contrast=1.4, num_landmarks=50)
        >>> bool((strong.mean((2, 3)) - image.mean((2, 3))).abs().max() < 1e-5), bool(strong.std() > image.std())
        (True, True)
    """
    check_photograph(image, "image")
    return edited(image, fit_tone, contrast=contrast, clarity=clarity, order=order, **options)


def fit_tone(
    source: Source,
    *,
    contrast: float | Tensor = TONE["contrast"].idle,
    clarity: float | Tensor = TONE["clarity"].idle,
    order: int = 3,
    **options: Any,
) -> Fitted:
    """:func:`adjust_tone` for any source."""
    check_order(order)
    TONE["contrast"].check_argument(contrast, source.batch)
    TONE["clarity"].check_argument(clarity, source.batch)
    operator, mean = source.operator(Guide(options)), source.mean(luminance)

    def slider(value: float | Tensor) -> Tensor:
        return torch.as_tensor(value).to(mean).reshape(-1).expand(source.batch)

    fine = [torch.ones_like(slider(1.0))] * (order - 1)
    alpha = torch.stack([*fine, slider(clarity), slider(contrast)], dim=1)
    filtered = polynomial(operator, lambda pixels: luminance(pixels) - mean, order, None)
    return Fitted(lambda pixels: edit_luminance(pixels.image, lambda _: mean + filtered(pixels, alpha)))
