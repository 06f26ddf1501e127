"""Developing a picture, and its light: exposure, white balance, highlights and shadows, tones, colours.

Highlights and shadows come first. They change the brightness of areas as W^3 shows them: detail is added to the changed
areas as it is, and edges between areas stay where they are, so that neither loses contrast nor gets a halo. The areas
are computed from a small picture, and enlarged as :class:`EnlargedChange` does, so that they take as little time for a
large photograph as for a small one. What follows is a function of single pixels: factors of linear light, a curve of
tones, and factors of chroma.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_dtype, check_tensor
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.torch_internals import cached_constants
from nlfilter_torch.core.workers import divided_among, threads_for
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.options import FilterOptions
from nlfilter_torch.photo.declared.development import AUTO_BALANCE, EVEN_CURVE, NEUTRAL, Development, LightValues
from nlfilter_torch.photo.picture.colour import split_luminance
from nlfilter_torch.photo.picture.developing import develop_planes, limits_of
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.picture.limits import MAX_SATURATION_GAIN, Balance, balanced, limit
from nlfilter_torch.photo.picture.measuring import everywhere
from nlfilter_torch.photo.picture.photographs import Photograph, cut_photograph
from nlfilter_torch.photo.picture.pixels import Fitted, M, Pixels, strips_of, whole_image
from nlfilter_torch.photo.picture.source import Cache, Guide, Source, kept, luminance
from nlfilter_torch.photo.picture.viewing import Coarse, EnlargedChange, viewed_size

BLUE_TO_AMBER = 0.75  # stops that warmth 1 adds to red and takes from blue
GREEN_TO_MAGENTA = 0.5  # stops that tint 1 takes from green
#: The tone curve of sRGB: a line up to a value, and a power beyond it.
LINEAR, SLOPE, OFFSET, GAMMA = 0.04045, 12.92, 0.055, 2.4
DARK = 1e-3  # light in which nobody sees colours
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue in linear light
#: From XYZ to linear sRGB, by rows.
TO_SRGB = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
AREA_MEGAPIXELS = 0.3  # megapixels of the picture in which areas are found
LEVELS, DISTANCE = 40 / 255, 1 / 8  # how different the tones of an area are, and its size as a share of the short side
LANDMARKS = 150
ORDER = 3  # power of W whose result the areas are
NORM = 6  # exponent of the mean that finds the colour of the light: between the mean and the largest value
CLIPPED_FROM = 0.98  # value from which on a channel may be clipped, and its colour wrong
SMALLEST = 1e-9


def develop_image(image: Tensor, development: Development) -> Tensor:
    """Develop a picture.

    A picture with values outside [0, 1] keeps all values; in others they are limited to [0, 1].

    Args:
        image: (B, C, H, W), C = 1 or 3, with the tone curve of sRGB. White balance leaves grey pictures as they are.
        development: how.

    Returns:
        (B, C, h, w); the image itself if nothing changes. Differentiable.

    Raises:
        TypeError: if ``image`` is not a floating-point tensor.
        ValueError: if it has another shape, or the middle of the crop is outside the rotated picture.

    Example:
        >>> grey = torch.full((1, 1, 4, 6), 0.5)
        >>> brighter = develop_image(grey, Development(exposure=1.0, crop=(0.5, 0.0, 1.0, 1.0)))
        >>> brighter.shape, round(float(brighter.mean()), 3)
        (torch.Size([1, 1, 4, 3]), 0.686)
    """
    if development.is_idle:
        return image
    check_tensor(image, "image", "convert it with torch.as_tensor")
    check_dtype(image, "image", "divide integer pixels by the value of white, such as 255")
    if image.ndim != 4 or image.shape[1] not in (1, 3):
        raise ValueError(
            f"image must have shape (B, C, H, W) with 1 or 3 channels, got {tuple(image.shape)}; pass grey or RGB"
        )
    least, most = limits_of(image)
    framed = develop_planes(image, development.frame((image.shape[-2], image.shape[-1])))
    return in_light(framed.clamp(least, most), development, (least, most))


@dataclass(frozen=True, eq=False)
class Light:
    """A change of the light of a picture, fitted to it.

    Attributes:
        values: of light.
        limits: of the picture before, (B, 1, 1, 1) each, see :func:`limits_of`; beyond [0, 1] they are not kept.
        balance: factors (B, 3, 1, 1) of red, green and blue that make its own light white, or None.
        shading: the change of light and dark areas, or None.
    """

    values: LightValues
    limits: tuple[Tensor, Tensor]
    balance: Tensor | None = None
    shading: EnlargedChange | None = None

    def __call__(self, pixels: Pixels) -> Tensor:
        """Pixels of the picture in this light."""
        values, image = self.values, pixels.image
        if self.shading is not None:
            image = self.shading.edited(pixels)
        coloured = image.shape[1] == 3
        if values.exposes or (coloured and (values.balances or self.balance is not None)):
            gains = [torch.as_tensor(gain).to(image) for gain in gains_of(values, coloured=coloured)[: image.shape[1]]]
            factors = torch.cat([gain.reshape(-1, 1, 1, 1) for gain in gains], dim=1)
            image = _times(image, factors if self.balance is None else factors * self.balance.to(factors))
        if values.bends:
            image = bent(image, values)
        if values.colours and coloured:
            image = strengthened(image, values.saturation, values.vibrance)
        is_wide = (self.limits[0] < 0) | (self.limits[1] > 1)
        return torch.where(is_wide, image, image.clamp(0, 1))


def fit_light(source: Source[M], values: LightValues, limits: tuple[Tensor, Tensor]) -> Light:
    """Fit a change of light to a picture in the frame in which it is shown; what is kept of it serves other values."""
    balance = shading = None
    if values.temperature == AUTO_BALANCE and source.channels == 3:
        balance = kept(source, "own light", [], balance_of_light, kept(source, "small", [], small, source))
    if values.shades:
        image = kept(source, "small", [], small, source)
        shading = shading_of(source, image, kept(source, "areas", [], areas_of, image), values)
    return Light(values, limits, balance, shading)


def small(source: Source[M]) -> Tensor:
    """A picture in the size in which areas are found, (B, C, h, w)."""
    size = viewed_size(source.size, AREA_MEGAPIXELS)
    return everywhere(source if size == source.size else source.resized(size), Fitted(whole_image))


def areas_of(image: Tensor) -> Tensor:
    """The luminance (B, 1, h, w) of the areas of an image, W^3 y."""
    grey = InMemory(reduce_channels(image, "luminance").clamp(0, 1))
    options = FilterOptions(
        photometric_bandwidth=LEVELS,
        spatial_bandwidth=DISTANCE * min(grey.size),
        num_landmarks=min(LANDMARKS, grey.size[0] * grey.size[1]),
    )
    return grey.operator(Guide(options)).layers(whole_image, ORDER)(grey)[:, -1]


def shading_of(source: Source[M], image: Tensor, areas: Tensor, values: LightValues) -> EnlargedChange:
    """The change of light and dark areas of a picture, from its image and areas as :func:`small` shows it.

    Where it gets lighter, chroma grows with luminance.
    """
    grey = reduce_channels(image, "luminance")
    change, kept_chroma = balanced(image, limit(image, shaded(areas.clamp(0, 1), values)))
    _, grown = balanced(image, change, Balance(colour=1 / MAX_SATURATION_GAIN))  # as much as luminance
    saturation = None if kept_chroma is None or grown is None else torch.where(change > 0, grown, kept_chroma)
    return EnlargedChange(Coarse.of(grey, change, saturation, "soft"), luminance, source.size)


def shaded(tones: Tensor, values: LightValues) -> Tensor:
    """The change of tones in [0, 1] by highlights and shadows.

    A dark tone b is multiplied by ``exp(shadows (1 - b)^3)``, and the distance of a light one from white by
    ``exp(-highlights b^3)``. Both curves rise everywhere, alone and together.
    """
    lifted = tones * torch.expm1(values.shadows * (1 - tones) ** 3)
    return lifted - (1 - tones) * torch.expm1(-values.highlights * tones**3)


@full_precision
def in_light(
    image: Tensor, development: Development, limits: tuple[Tensor, Tensor], cache: Cache | None = None
) -> Tensor:
    """Change the light of an image (B, C, H, W), in its frame.

    ``limits`` are those of the picture before it was cut, see :func:`limits_of`; ``cache`` keeps the areas of the
    image for other values, None keeps nothing.
    """
    if not development.changes_light:
        return image
    source = InMemory(image.to(working_dtype(image)), cache)
    light = fit_light(source, development, limits)
    parts = divided_among(threads_for(image), light, strips_of(source))
    return torch.cat(list(parts), dim=2).to(image.dtype)


def develop_photograph(photograph: Photograph, development: Development) -> Photograph:
    """Develop a photograph, as :func:`develop_image` does its pixels.

    Transparency and pixels without data follow. Metadata that hold for the whole picture only, such as the place of the
    subject, are left out if it is cropped.

    Raises:
        ValueError: if the middle of the crop is outside the turned picture.
    """
    if development.is_idle:
        return photograph
    return lit_photograph(cut_photograph(photograph, development), development, photograph)


def lit_photograph(cut: Photograph, development: Development, original: Photograph) -> Photograph:
    """Change the light of a photograph that was cut from the original."""
    if not development.changes_light:
        return cut
    return replace(cut, pixels=in_light(cut.pixels, development, limits_of(original.pixels)))


def _times(image: Tensor, light: Tensor) -> Tensor:
    """Multiply the linear light of an image (B, C, H, W) by factors (B or 1, C, 1, 1).

    The power of the tone curve cancels: where light before and after is beyond its linear part, values are multiplied,
    and powers are needed for the few that go from one part to the other.
    """
    edited = torch.where(image > LINEAR, (image + OFFSET) * light ** (1 / GAMMA) - OFFSET, image * light)
    crossing = torch.nonzero((image > LINEAR) != (edited > LINEAR), as_tuple=True)
    if len(crossing[0]):
        before, factors = image[crossing].double(), light.expand_as(image)[crossing].double()  # rounded alike anywhere
        values = _linear(before) * factors
        curved = (1 + OFFSET) * values.clamp(min=LINEAR / SLOPE) ** (1 / GAMMA) - OFFSET
        edited = edited.index_put(crossing, torch.where(before > LINEAR, SLOPE * values, curved).to(edited))
    return edited


def _linear(values: Tensor) -> Tensor:
    """The linear light of values with the tone curve of sRGB."""
    return torch.where(values > LINEAR, ((values.clamp(min=LINEAR) + OFFSET) / (1 + OFFSET)) ** GAMMA, values / SLOPE)


def bent(image: Tensor, values: LightValues) -> Tensor:
    """Change the tones of an image (B, C, H, W), each channel alike; beyond [0, 1] by what is added at the ends.

    >>> grey = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]).view(1, 1, 1, 5)
    >>> bent(grey, Development(contrast=1.0)).flatten().tolist()
    [0.0, 0.15625, 0.5, 0.84375, 1.0]
    """
    inside = image.clamp(0, 1)
    tones = inside + 0.12 * (values.whites * inside**3 + values.blacks * (1 - inside) ** 3)
    tones = tones + 2 * values.contrast * (inside - 0.5) * inside * (1 - inside)
    if values.curve != EVEN_CURVE:
        tones = on_curve(tones.clamp(0, 1), values.curve)
    return image + (tones - inside)


def on_curve(values: Tensor, curve: tuple[float, ...]) -> Tensor:
    """Values in [0, 1] on a curve through evenly spaced tones that rises where these do."""
    knots, pieces = _pieces(curve)
    piece = torch.bucketize(values.detach(), knots.to(values)[1:-1], right=True)
    past = values - knots.to(values)[piece]
    result = torch.zeros_like(values)
    for power in pieces.to(values):
        result = result * past + power[piece]
    return result


@cached_constants
def _pieces(curve: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Where the pieces of a curve begin and end, and their polynomials (4, n), highest power first."""
    from scipy.interpolate import PchipInterpolator  # half a second to import

    knots = torch.linspace(0, 1, len(curve), dtype=torch.float64)
    return knots, torch.from_numpy(PchipInterpolator(knots.numpy(), curve).c)


def strengthened(image: Tensor, saturation: float | Tensor, vibrance: float | Tensor) -> Tensor:
    """Multiply the chroma of an RGB image (B, 3, H, W), without change of luminance and hue.

    It grows only as far as the channels stay within [0, 1].
    """
    grey, chroma = split_luminance(image)
    pale = 1 - (image.amax(1, keepdim=True) - image.amin(1, keepdim=True)).clamp(0, 1)
    factor = (1 + saturation) * (1 + vibrance * pale**2)
    room = torch.where(chroma > 0, 1 - grey, grey) / chroma.abs().clamp(min=SMALLEST)
    return grey + chroma * torch.minimum(factor, room.amin(1, keepdim=True).clamp(min=1))


def gains_of(values: LightValues, *, coloured: bool = True) -> list[float | Tensor]:
    """What red, green and blue are multiplied by in linear light; white balance keeps the luminance of grey.

    What ``temperature="auto"`` adds depends on the picture, and is left out.

    >>> gains_of(Development(exposure=1.0)), gains_of(Development(tint=1.0), coloured=False)
    ([2.0, 2.0, 2.0], [1.0, 1.0, 1.0])
    """
    warmer, redder = (values.warmth, values.tint) if coloured else (0.0, 0.0)
    gains = [2.0 ** (BLUE_TO_AMBER * warmer), 2.0 ** (-GREEN_TO_MAGENTA * redder), 2.0 ** (-BLUE_TO_AMBER * warmer)]
    if coloured and isinstance(values.temperature, int | float):
        ratios = zip(light_of(NEUTRAL), light_of(values.temperature), strict=True)
        gains = [gain * white / light for gain, (white, light) in zip(gains, ratios, strict=True)]
    brightness = sum(weight * gain for weight, gain in zip(LUMINANCE, gains, strict=True))
    light = 2.0**values.exposure
    return [light * gain / brightness if coloured else light for gain in gains]


def light_of(kelvin: float) -> tuple[float, float, float]:
    """Linear red, green and blue of a black body of a temperature from 1000 to 15000 K, with green 1.

    By the rational approximation of its chromaticity of Krystek, 1985.

    >>> [round(value, 2) for value in light_of(3000.0)]
    [2.09, 1.0, 0.32]
    """
    t = kelvin / 1000
    u = (0.860117757 + 0.154118254 * t + 0.128641212 * t**2) / (1 + 0.842420235 * t + 0.708145163 * t**2)
    v = (0.317398726 + 0.0422806245 * t + 0.0420481691 * t**2) / (1 - 0.0289741816 * t + 0.161456053 * t**2)
    x, y = 3 * u / (2 * u - 8 * v + 4), 2 * v / (2 * u - 8 * v + 4)
    red, green, blue = (sum(a * b for a, b in zip(row, (x / y, 1, (1 - x - y) / y), strict=True)) for row in TO_SRGB)
    return red / green, 1.0, blue / green


def balance_of_light(image: Tensor) -> Tensor:
    """Factors (B, 3, 1, 1) of linear light that make the light of a picture white, as far as warmth and tint go.

    Its colour is that of a mean of power 6 over the pixels that are not clipped ("shades of grey", Finlayson and
    Trezzi, 2004). Not differentiable.
    """
    values = image.detach().double()
    counted = ((values.amax(1, keepdim=True) < CLIPPED_FROM) & (values.amin(1, keepdim=True) > 0)).double()
    light = (_linear(values).clamp(min=0) ** NORM * counted).mean((2, 3)).clamp(min=SMALLEST**NORM) ** (1 / NORM)
    gains = []
    for red, green, blue in light.log2().tolist():
        warmth, tint = _towards_grey(red, green, blue)
        gains.append(gains_of(Development(warmth=warmth, tint=tint)))
    return image.new_tensor(gains).view(-1, 3, 1, 1)


def _towards_grey(red: float, green: float, blue: float) -> tuple[float, float]:
    """Warmth and tint that make light of a colour, in stops, white, as far as their ranges go."""
    warmth, tint = (blue - red) / (2 * BLUE_TO_AMBER), (green - (red + blue) / 2) / GREEN_TO_MAGENTA
    return round(min(max(warmth, -1.0), 1.0), 3), round(min(max(tint, -1.0), 1.0), 3)


def balance_of(part: Tensor) -> tuple[float, float]:
    """The warmth and tint that make a part (1, C, h, w) of a picture grey, on average, within their ranges.

    Raises:
        ValueError: if the picture has no colours, or the part no light in one of them.

    Example:
        >>> ends = torch.zeros(1), torch.ones(1)
        >>> balance_of(in_light(torch.full((1, 3, 1, 1), 0.5), Development(warmth=-0.4, tint=0.2), ends))
        (0.4, -0.2)
    """
    if part.shape[1] != 3 or part.numel() == 0:
        raise ValueError("the photograph must have colours to balance, got a grey one; choose another")
    light = _linear(part.double()).mean((0, 2, 3))
    if float(light.min()) < DARK:
        raise ValueError(
            "a grey point must have red, green and blue light, got one that is nearly black; choose another"
        )
    return _towards_grey(*light.log2().tolist())
