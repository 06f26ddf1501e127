"""Abstraction of a photograph to flat areas, with optional edge lines and few tones. Paper: Sec. V-D, Fig. 18.

Edges and tones after Winnemoeller, Olsen and Gooch, "Real-Time Video Abstraction", SIGGRAPH 2006 (the paper's [30]).
"""

from typing import Any

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_count, check_reach
from nlfilter_torch.operator.features import blur, blur_margin
from nlfilter_torch.photo.declared.parameters import ABSTRACT
from nlfilter_torch.photo.edits.synthesis import synthesize
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance
from nlfilter_torch.photo.picture.in_memory import edit_of
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source
from nlfilter_torch.photo.picture.viewing import fit_change, viewed_size

# The residual of the eigenvectors is multiplied by a power of W's diagonal part r, with the exponent times this factor:
# it vanishes where similar pixels exist, remains where none do, such as on a border, and is unchanged at power 0.
RESIDUAL_EXPONENT = 10
MIN_REMAINDER = 1e-4  # lower limit of r
# Difference of Gaussians on luminance from 0 to 100: scale and weight of the wider one, and steepness.
WIDER, SENSITIVITY, FALLOFF = 1.6, 0.98, 1.0
SOFT, CRISP = 5.0, 25.0  # steepness of the steps between tones in flat areas and at edges
MIN_SQUARED_GRADIENT = 1e-12  # lower limit of squared gradients; keeps the derivative of their square root finite
EDGE_GRADIENT = 2.0  # gradient of luminance from 0 to 100, per pixel of the viewing size, from which on steps are CRISP


@edit_of("image")
def abstract(
    source: Source,
    /,
    *,
    power: float | Tensor = ABSTRACT.defaults["power"],
    edges: float = ABSTRACT.defaults["edges"],
    edge_width: float | None = None,
    tones: int | None = ABSTRACT.defaults["tones"],
    viewing_size: float = ABSTRACT.defaults["viewing_size"],
    photometric_bandwidth: float | Tensor | str = ABSTRACT.defaults["photometric_bandwidth"],
    spatial_bandwidth: float | Tensor | None = None,
    patch_size: int = ABSTRACT.defaults["patch_size"],
    num_landmarks: int = ABSTRACT.defaults["num_landmarks"],
    **options: Any,
) -> Fitted:
    """Remove small detail from a photograph and keep its outlines: ``W^k y`` with a fractional k.

    Paper: Sec. V-D. The kernel compares colours and has a spatial term, so that the filter is local. Lines along edges
    and quantized luminance are optional.

    Args:
        image: (B, C, H, W) in [0, 1]; lines and tones require C = 1 or 3.
        power: k >= 0, a number or a tensor of shape () or (B,); 0 changes nothing.
        edges: darkness of the lines, 0 for none, 1 for black.
        edge_width: width of the lines in pixels, at most half the short side; None is 0.2 % of the short side, and at
            least 0.3 pixels.
        tones: number of luminance levels, from 2 to 65536; None does not quantize.
        viewing_size: in megapixels; a larger image is edited like its reduction to this size, in whose pixels patches
            and bandwidths are counted; 0 is the size of the image.
        photometric_bandwidth: h_y; larger gives larger flat areas.
        spatial_bandwidth: h_x in pixels; None is 0.15 of the short side.
        patch_size: width of the compared patches.
        num_landmarks: M; fewer give coarser pictures.
        **options: further options of :func:`nonlocal_operator`.

    Returns:
        (B, C, H, W). Differentiable in image and power; the bandwidth ``"auto"`` counts as a constant.

    Raises:
        TypeError, ValueError: if ``image`` is not a finite floating-point tensor, or an option leaves its range.

    Example:
        >>> image = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
        >>> bool(abstract(image, num_landmarks=50).std() < image.std())
        True
        >>> bool((abstract(image, power=0.0, num_landmarks=50) - image).abs().max() < 1e-5)
        True
    """
    check_count(num_landmarks, "num_landmarks")
    ABSTRACT.check(source.batch, power=power, edges=edges, edge_width=edge_width, viewing_size=viewing_size)
    width = ABSTRACT["edge_width"].pixels(edge_width, source.size)
    check_reach(width, "edge_width", source.size)
    ABSTRACT.check(tones=tones)
    if (edges > 0 or tones is not None) and source.channels not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels for edges and tones, got {source.channels}; select 1 or 3")

    def change(viewed: Source) -> Fitted:
        flat = flattened(
            viewed,
            power,
            num_landmarks=num_landmarks,
            spatial_bandwidth=spatial_bandwidth,
            photometric_bandwidth=photometric_bandwidth,
            patch_size=patch_size,
            **options,
        )
        return Fitted(lambda pixels: flat(pixels) - pixels.image)

    fitted = fit_change(source, change, lambda pixels: pixels.image, viewing_size, "none")
    if edges == 0 and tones is None:
        return fitted
    scale = source.size[0] / viewed_size(source.size, viewing_size)[0]
    return Fitted(
        fitted.pixels,
        lambda _, planes, __: draw(planes, edges, width, tones, scale),
        margin=blur_margin(WIDER * width) + 1,
    )


def flattened(
    source: Source,
    power: float | Tensor,
    *,
    num_landmarks: int,
    spatial_bandwidth: float | Tensor | None,
    **options: Any,
) -> Planes:
    """Compute ``W^k y``."""
    options = {"guide_channels": "all"} | options
    options |= {
        "num_landmarks": min(num_landmarks, source.size[0] * source.size[1]),
        "spatial_bandwidth": ABSTRACT["spatial_bandwidth"].distance(spatial_bandwidth, source.size),
    }
    operator = source.operator(Guide(options, spectral=True))
    # W preserves constants, but the span of the factor need not contain them: filter without the mean.
    mean = source.mean(lambda pixels: pixels.image)

    def varying(pixels: Pixels) -> Tensor:
        return pixels.image - mean

    exponent = torch.as_tensor(power, dtype=torch.float64, device=mean.device).reshape(-1, 1)
    coefficients = operator.coefficients(varying)
    captured = synthesize(operator, torch.ones_like, coefficients)
    smoothed = synthesize(operator, lambda eigenvalues: eigenvalues**exponent, coefficients)
    residual_exponent = RESIDUAL_EXPONENT * exponent.to(source.dtype).unsqueeze(2)
    residual_gain = operator.each(
        lambda columns: columns.remainder.clamp(MIN_REMAINDER, 1.0).unsqueeze(1) ** residual_exponent
    )
    return lambda pixels: mean + smoothed(pixels) + residual_gain(pixels) * (varying(pixels) - captured(pixels))


def draw(flat: Tensor, edges: float, width: float, tones: int | None, scale: float = 1.0) -> Tensor:
    """Quantize the luminance of an image (B, C, H, W), see :func:`quantize`, and draw lines along its edges."""
    luminance, chroma = split_luminance(flat) if flat.shape[1] == 3 else (flat, torch.zeros_like(flat))
    toned = luminance if tones is None else quantize(luminance, tones, scale)
    toned = toned * (1 - edges * (1 - edge_lines(luminance, width)))
    return merge_luminance(toned, chroma) if flat.shape[1] == 3 else toned


def edge_lines(luminance: Tensor, width: float) -> Tensor:
    """Compute lines (B, 1, H, W) from a difference of Gaussians: 1 off the lines, towards 0 in their middle."""
    near, far = blur(luminance, width), blur(luminance, WIDER * width)
    difference = 100 * (near - SENSITIVITY * far)
    return 1 + torch.tanh(FALLOFF * difference.clamp(max=0.0))


def quantize(luminance: Tensor, tones: int, scale: float = 1.0) -> Tensor:
    """Quantize luminance (B, 1, H, W) to ``tones`` levels, with soft steps in flat areas and steep ones at edges.

    Gradients are those of a picture with pixels ``scale`` times as large.
    """
    from kornia.filters import spatial_gradient  # kornia takes half a second to import

    step = 1 / (tones - 1)
    nearest = (luminance / step).round() * step
    gradient = (
        100 * scale * spatial_gradient(luminance, mode="diff").square().sum(2).clamp(min=MIN_SQUARED_GRADIENT).sqrt()
    )
    steepness = SOFT + (CRISP - SOFT) * (gradient / EDGE_GRADIENT).clamp(max=1.0)
    # Steepness is relative to a step, so that transitions look alike for any number of tones.
    return nearest + step / 2 * torch.tanh(steepness * (luminance - nearest) / step)
