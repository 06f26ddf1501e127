"""A look: sliders of the filter, of blurs and of texture, tone curves, colours, levels and local contrast, added up.

Each part gives a change of the image, and the result is the image plus all changes, so that it is linear in every
parameter but the image: looks are fitted to edits by least squares.
"""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_image, check_tensor
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.filtering.local_tone import STRENGTHS, LocalCurves, mean_ramps
from nlfilter_torch.filtering.stretch import KINDS, Stretch, ends_of, tones
from nlfilter_torch.operator.features import pad_border, reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator

BLURS = 6  # each twice as wide as the one before
BAND_MARGIN = 2 * (2**BLURS - 1)  # pixels around a pixel that the widest depends on
FLAT = 0.15  # standard deviation of luminance around a pixel at which half of a band counts as texture
DARKEST = 1 / 255  # that has a saturation
NAMES = ("alpha", "bands", "texture", "curves", "matrix", "saturation", "stretch", "local")
#: Of one image.
DIMENSIONS = {name: 2 if name in ("curves", "matrix") else 1 for name in NAMES}


def filter_look(
    image: Tensor,
    *,
    alpha: Tensor | None = None,
    bands: Tensor | None = None,
    texture: Tensor | None = None,
    curves: Tensor | None = None,
    matrix: Tensor | None = None,
    saturation: Tensor | None = None,
    stretch: Tensor | None = None,
    local: Tensor | None = None,
    operator: NonlocalOperator | None = None,
) -> Tensor:
    """An image under a look, each part of which may be left out.

    Args:
        image: (B, 3, H, W) in [0, 1].
        alpha: sliders (k+1,) or (B, k+1) of the filter's layers of luminance. Paper: eq. (12).
        bands: gains (7,) or (B, 7) of what six blurs, each twice as wide, take away one after the other, fine to
            coarse, and last of what they leave, around the picture's mean luminance: 1 changes nothing.
        texture: gains (6,) or (B, 6) of what the six blurs take away from luminance, the less of it the more luminance
            varies around a pixel, so that edges have little: 1 changes nothing.
        curves: (3, K) or (B, 3, K), what red, green and blue become at K equal steps from 0 to 1.
        matrix: (3, 3) or (B, 3, 3) that colours are multiplied by; its change, like that of the curves, is that of the
            image itself.
        saturation: (K,) or (B, K), how many times as far each channel is to be from the largest one of its pixel, for
            colours whose saturation in HSV is at K equal steps from 0 to 1.
        stretch: (3,) or (B, 3), how much of the change that stretches brightness from the darkest to the lightest pixel
            to the range from 0 to 1 is added: of luminance, for all channels alike; of the largest channel, for colours
            in proportion; and of each channel for itself.
        local: (8,) or (B, 8), how much of the change that equalises histograms of the surroundings is added, under four
            limits of contrast, :data:`~nlfilter_torch.filtering.local_tone.LIMITS`: of luminance, for all channels
            alike, and then of the largest channel, for colours in proportion.
        operator: W, which ``alpha`` needs.

    Returns:
        (B, 3, H, W); values may leave [0, 1]. Differentiable in everything.

    Raises:
        TypeError, ValueError: if a part does not have its shape, or ``alpha`` comes without an operator.

    Example:
        >>> image = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
        >>> darker = filter_look(image, curves=torch.tensor([0.0, 0.4, 1.0]).expand(3, 3))
        >>> bool(darker.mean() < image.mean())
        True
    """
    check_image(image, "image", channels=3)
    parts = dict(zip(NAMES, (alpha, bands, texture, curves, matrix, saturation, stretch, local), strict=True))
    given = {name: value for name, value in parts.items() if value is not None}
    for name, value in given.items():
        check_part(value, name, image.shape[0])
    result = pointwise(image, curves, matrix, saturation)
    if bands is not None:
        mean = reduce_channels(image, "luminance").mean((2, 3), keepdim=True)
        result = result + band_change(image, bands, mean)
    if texture is not None:
        result = result + texture_change(image, texture)
    if stretch is not None:
        result = result + range_of(image).change(image, stretch)
    if local is not None:
        result = result + local_curves(image, range_of(image)).weighed(local).rectangle(image, (0, 0)).sum(1)
    if alpha is not None:
        if operator is None:
            raise ValueError("operator must be given where alpha is, got None; make it with nonlocal_operator")
        result = result + polynomial_filter(operator, reduce_channels(image, "luminance"), alpha - 1)
    return result


def check_part(value: Tensor, name: str, batch: int) -> None:
    """Raise unless a part of a look has its shape."""
    check_tensor(value, name)
    shapes = {
        "alpha": "(k+1,)",
        "bands": f"({BLURS + 1},)",
        "texture": f"({BLURS},)",
        "curves": "(3, K)",
        "matrix": "(3, 3)",
        "saturation": "(K,)",
        "stretch": f"({KINDS},)",
        "local": f"({STRENGTHS},)",
    }
    shape, one = tuple(value.shape), DIMENSIONS[name]
    last = shape[-one:]
    fits = {
        "alpha": lambda: last[0] >= 2,
        "bands": lambda: last == (BLURS + 1,),
        "texture": lambda: last == (BLURS,),
        "curves": lambda: last[0] == 3 and last[1] >= 2,
        "matrix": lambda: last == (3, 3),
        "saturation": lambda: last[0] >= 2,
        "stretch": lambda: last == (KINDS,),
        "local": lambda: last == (STRENGTHS,),
    }
    if len(shape) not in (one, one + 1) or (len(shape) > one and shape[0] not in (1, batch)) or not fits[name]():
        each = f", or that for each of {batch} images" if batch > 1 else ""
        raise ValueError(f"{name} must have the shape {shapes[name]}{each}, got {shape}; reshape it, or add values")


def acts(gains: Tensor, idle: float = 1.0) -> bool:
    """Whether gains change anything, which ``idle`` ones do not, or may once they are learned."""
    return gains.requires_grad or bool((gains != idle).any())


def range_of(image: Tensor) -> Stretch:
    """Range of the brightness of an image (B, 3, H, W)."""
    return Stretch.of(ends_of(tones(image)))


def local_curves(image: Tensor, stretch: Stretch) -> LocalCurves:
    """Local tone curves of an image (B, 3, H, W) whose brightness has that range."""
    return LocalCurves.of((image.shape[-2], image.shape[-1]), stretch, partial(mean_ramps, image, stretch))


def pointwise(image: Tensor, curves: Tensor | None, matrix: Tensor | None, saturation: Tensor | None) -> Tensor:
    """The image (B, 3, H, W) plus what tone curves, matrix and saturation change."""
    result = image
    if curves is not None:
        result = tone_curve(image, curves)
    if matrix is not None:
        change = matrix - torch.eye(3).to(matrix)
        result = result + (change.to(image) @ image.flatten(2)).view_as(image)
    if saturation is not None:
        factors = (saturation.to(image) - 1).reshape(-1, saturation.shape[-1], 1, 1)
        result = result + below_largest(image) * (factors * saturation_hats(image, saturation.shape[-1])).sum(1, True)
    return result


def below_largest(image: Tensor) -> Tensor:
    """How far each channel of an image (B, 3, H, W) is from the largest one of its pixel."""
    return image - image.amax(1, keepdim=True)


def saturation_hats(image: Tensor, count: int) -> Tensor:
    """How much of each of some equal steps from 0 to 1 there is in the saturation in HSV, (B, K, H, W)."""
    largest, least = image.amax(1, keepdim=True), image.amin(1, keepdim=True)
    share = ((largest - least) / largest.clamp(min=DARKEST)).clamp(0, 1)
    steps = torch.arange(count).to(image).view(-1, 1, 1)
    return (1 - (share * (count - 1) - steps).abs()).clamp(min=0)


def tone_curve(image: Tensor, curves: Tensor) -> Tensor:
    """Piecewise linear curves (3, K) or (B, 3, K) of an image (B, 3, H, W), continued beyond [0, 1]."""
    place = image.flatten(2) * (curves.shape[-1] - 1)
    below = place.detach().floor().clamp(0, curves.shape[-1] - 2)
    values = curves.to(image).expand(image.shape[0], -1, -1)
    low, high = (values.gather(2, below.long() + step) for step in (0, 1))
    return (low + (high - low) * (place - below)).view_as(image)


def bands_of(image: Tensor) -> Iterator[Tensor]:
    """What each of the blurs takes away from an image (B, C, H, W), and last what they leave."""
    height, width = image.shape[-2:]
    left, margin = pad_border(image, BAND_MARGIN), BAND_MARGIN
    for level in range(BLURS):
        reach = 2 * 2**level
        blurred = _blur(_blur(left, 2, 2**level), 3, 2**level)
        inner = left[..., reach : left.shape[2] - reach, reach : left.shape[3] - reach]
        margin -= reach
        yield (inner - blurred)[..., margin : margin + height, margin : margin + width]
        left = blurred
    yield left


def _blur(image: Tensor, dim: int, step: int) -> Tensor:
    """Along one axis by the weights 1, 4, 6, 4, 1 of pixels ``step`` apart, which ends 2 steps inside the borders."""
    a, b, c, d, e = (image.narrow(dim, i * step, image.shape[dim] - 4 * step) for i in range(5))
    return (a + e).mul_(1 / 16).add_(b, alpha=0.25).add_(d, alpha=0.25).add_(c, alpha=0.375)


def band_change(image: Tensor, gains: Tensor, mean: Tensor) -> Tensor:
    """What gains (7,) or (B, 7) of the bands change of an image, around the mean (B, 1, 1, 1) of its luminance."""
    change = torch.zeros_like(image)
    for number, band in enumerate(bands_of(image)):
        gain = (gains[..., number].to(image) - 1).reshape(-1, 1, 1, 1)
        change = change + gain * (band - mean if number == BLURS else band)
    return change


def textures_of(image: Tensor) -> Iterator[Tensor]:
    """Six bands (B, 1, H, W) of an image's luminance, without edges: less, the more it varies around a pixel."""
    light = reduce_channels(image, "luminance")
    low = torch.cat([light, light.square()], dim=1)
    for number, band in enumerate(bands_of(low)):
        if number == BLURS:
            return
        low = low - band  # what this blur leaves, and of squares
        variance = (low[:, 1:] - low[:, :1].square()).clamp(min=0)
        yield band[:, :1] * (FLAT**2 / (variance + FLAT**2))


def texture_change(image: Tensor, gains: Tensor) -> Tensor:
    """What gains (6,) or (B, 6) of textures change of an image, (B, 1, H, W), for all channels."""
    change = torch.zeros_like(image[:, :1])
    for number, texture in enumerate(textures_of(image)):
        change = change + (gains[..., number].to(image) - 1).reshape(-1, 1, 1, 1) * texture
    return change
