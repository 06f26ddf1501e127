"""A look: sliders of the filter, of blurs and of texture, tone curves, colours, levels and local contrast, added up.

For what curves, matrix and factors of saturation cannot say of colours there is a lattice, changes on a grid of them.

Each part gives a change of the image, and the result is the image plus all changes, so that it is linear in every
parameter but the image: looks are fitted to edits by least squares.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Literal, get_args

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_dtype, check_finite, check_tensor
from nlfilter_torch.core.kernels.lattice import interpolate
from nlfilter_torch.core.precision import full_precision
from nlfilter_torch.operator.features import pad_border, reduce_channels
from nlfilter_torch.photo.declared.declaration import MAX_NODES, nodes_of
from nlfilter_torch.photo.looks.histogram import (
    GREY_LEVEL,
    KINDS_OF_LEVELS,
    STRENGTHS,
    LocalCurves,
    Stretch,
    mean_ramps,
    tones,
)
from nlfilter_torch.photo.picture.pixels import ends_of

BLURS = 6  # each twice as wide as the one before
BAND_MARGIN = 2 * (2**BLURS - 1)  # pixels around a pixel that the widest depends on
EDGE_CONTRAST = 0.15  # standard deviation of luminance around a pixel at which half of a band counts as texture
LookPart = Literal["alpha", "bands", "texture", "curves", "matrix", "saturation", "stretch", "local", "lattice"]
#: Parts of a look, with their shapes for one image; a letter is any length from 2 on, the same wherever it stands.
PART_SHAPES: dict[str, tuple[int | str, ...]] = {
    "alpha": ("k+1",),
    "bands": (BLURS + 1,),
    "texture": (BLURS,),
    "curves": (3, "K"),
    "matrix": (3, 3),
    "saturation": ("K",),
    "stretch": (KINDS_OF_LEVELS,),
    "local": (STRENGTHS,),
    "lattice": (3, "n", "n", "n"),
}
LOOK_PARTS: tuple[LookPart, ...] = get_args(LookPart)
#: Values at which these parts change nothing; they are not computed then.
IDLE = {"alpha": 1.0, "bands": 1.0, "texture": 1.0, "stretch": 0.0, "local": 0.0, "lattice": 0.0}


@full_precision
def filter_look(
    image: Tensor, parts: Mapping[str, Tensor], detail: Callable[[Tensor, Tensor], Tensor] | None
) -> Tensor:
    """An image (B, 3, H, W) under a look of all :data:`LOOK_PARTS`, whose parts may differ between the images.

    Differentiable in everything. ``apply_look`` says what the parts are. ``detail`` is :func:`polynomial_filter` with
    W, a function of luminance and sliders, and needed only if ``alpha`` :func:`acts`.
    """
    acting = {name: value for name, value in parts.items() if name not in IDLE or acts(value, IDLE[name])}
    for name, value in acting.items():
        check_part(value, name, image.shape[0])
    result = pointwise(image, parts["curves"], parts["matrix"], parts["saturation"], acting.get("lattice"))
    if "bands" in acting:
        mean = reduce_channels(image, "luminance").mean((2, 3), keepdim=True)
        result = result + band_change(image, parts["bands"], mean)
    if "texture" in acting:
        result = result + texture_change(image, parts["texture"])
    if "stretch" in acting:
        result = result + stretch_of(image).change(image, parts["stretch"])
    if "local" in acting:
        curves = local_curves(image, stretch_of(image)).weighed(parts["local"])
        result = result + curves.rectangle(image, (0, 0)).sum(1)
    if "alpha" in acting:
        assert detail is not None  # for mypy
        result = result + detail(reduce_channels(image, "luminance"), parts["alpha"] - 1)
    return result


def check_part(value: Tensor, name: str, batch: int) -> None:
    """Raise unless a part of a look has its shape."""
    check_tensor(value, name)
    check_dtype(value, name, f"convert it with {name}.float()")
    check_finite(value, name)
    shape, wanted = tuple(value.shape), PART_SHAPES[name]
    own = shape[-len(wanted) :]
    fits = len(own) == len(wanted) and all(
        length >= 2 if isinstance(size, str) else length == size for length, size in zip(own, wanted, strict=True)
    )
    named_lengths = {(size, length) for size, length in zip(wanted, own, strict=False) if isinstance(size, str)}
    fits = fits and len(named_lengths) == len({size for size, _ in named_lengths})
    if not fits or shape[: -len(wanted)] not in ((), (1,), (batch,)):
        batched = f", or that for each of {batch} images" if batch > 1 else ""
        named = f"({wanted[0]},)" if len(wanted) == 1 else f"({', '.join(map(str, wanted))})"
        raise ValueError(f"{name} must have the shape {named}{batched}, got {shape}; reshape it, or add values")


def acts(gains: Tensor, idle: float = 1.0) -> bool:
    """Whether gains differ from ``idle``, at which they have no effect, or are learned."""
    return gains.requires_grad or bool((gains != idle).any())


def stretch_of(image: Tensor) -> Stretch:
    """Range of the brightness of an image (B, 3, H, W)."""
    return Stretch.of(ends_of(tones(image)))


def local_curves(image: Tensor, stretch: Stretch) -> LocalCurves:
    """Local tone curves of an image (B, 3, H, W) whose brightness has that range."""
    return LocalCurves.of((image.shape[-2], image.shape[-1]), stretch, partial(mean_ramps, image, stretch))


@full_precision
def pointwise(
    image: Tensor, curves: Tensor, matrix: Tensor, saturation: Tensor, lattice: Tensor | None = None
) -> Tensor:
    """An image (B, 3, H, W) under tone curves, matrix, saturation and lattice, whose changes are added up."""
    change = matrix - torch.eye(3).to(matrix)
    result = tone_curve(image, curves) + (change.to(image) @ image.flatten(2)).view_as(image)
    factors = (saturation.to(image) - 1).reshape(-1, saturation.shape[-1], 1, 1)
    result = result + below_largest(image) * (factors * saturation_hats(image, saturation.shape[-1])).sum(1, True)
    return result if lattice is None else result + lattice_change(image, lattice)


def below_largest(image: Tensor) -> Tensor:
    """Distance of each channel of an image (B, 3, H, W) from the largest channel of its pixel, at most 0."""
    return image - image.amax(1, keepdim=True)


def saturation_hats(image: Tensor, count: int) -> Tensor:
    """Weights (B, K, H, W) of the HSV saturation in K evenly spaced hat functions on [0, 1]."""
    largest, least = image.amax(1, keepdim=True), image.amin(1, keepdim=True)
    share = ((largest - least) / largest.clamp(min=GREY_LEVEL)).clamp(0, 1)
    steps = torch.arange(count).to(image).view(-1, 1, 1)
    return (1 - (share * (count - 1) - steps).abs()).clamp(min=0)


def tone_curve(image: Tensor, curves: Tensor) -> Tensor:
    """Piecewise linear curves (3, K) or (B, 3, K) of an image (B, 3, H, W), continued beyond [0, 1]."""
    place = image.flatten(2) * (curves.shape[-1] - 1)
    below = place.detach().floor().clamp(0, curves.shape[-1] - 2)
    values = curves.to(image).expand(image.shape[0], -1, -1)
    low, high = (values.gather(2, below.long() + step) for step in (0, 1))
    return (low + (high - low) * (place - below)).view_as(image)


def blur_bands(image: Tensor) -> Iterator[Tensor]:
    """The band that each blur removes from an image (B, C, H, W), and finally the rest."""
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
    """Blur along one axis by weights 1, 4, 6, 4, 1, ``step`` pixels apart, without 2 steps at each border."""
    a, b, c, d, e = (image.narrow(dim, i * step, image.shape[dim] - 4 * step) for i in range(5))
    return (a + e).mul_(1 / 16).add_(b, alpha=0.25).add_(d, alpha=0.25).add_(c, alpha=0.375)


def band_change(image: Tensor, gains: Tensor, mean: Tensor) -> Tensor:
    """Change of an image by gains (7,) or (B, 7) of its bands; the last band is taken about the mean (B, 1, 1, 1)."""
    change = torch.zeros_like(image)
    for number, band in enumerate(blur_bands(image)):
        gain = (gains[..., number].to(image) - 1).reshape(-1, 1, 1, 1)
        change = change + gain * (band - mean if number == BLURS else band)
    return change


def textures_of(image: Tensor) -> Iterator[Tensor]:
    """Six bands (B, 1, H, W) of an image's luminance, attenuated where it varies much around a pixel, as at edges."""
    light = reduce_channels(image, "luminance")
    low = torch.cat([light, light.square()], dim=1)
    for number, band in enumerate(blur_bands(low)):
        if number == BLURS:
            return
        low = low - band  # the blurred luminance, and its blurred square
        variance = (low[:, 1:] - low[:, :1].square()).clamp(min=0)
        yield band[:, :1] * (EDGE_CONTRAST**2 / (variance + EDGE_CONTRAST**2))


def texture_change(image: Tensor, gains: Tensor) -> Tensor:
    """Change of all channels of an image, (B, 1, H, W), by gains (6,) or (B, 6) of its textures."""
    change = torch.zeros_like(image[:, :1])
    for number, texture in enumerate(textures_of(image)):
        change = change + (gains[..., number].to(image) - 1).reshape(-1, 1, 1, 1) * texture
    return change


def lattice_change(image: Tensor, lattice: Tensor) -> Tensor:
    """Changes (B, 3, H, W) of an image of that shape, by those at the nodes, (3, n, n, n) or (B, 3, n, n, n).

    The nodes are evenly spaced on [0, 1] along red, green and blue, in this order. Colours outside change as the
    nearest inside. Differentiable in both.
    """
    lattices = lattice.to(image).view(-1, *lattice.shape[-4:])
    return interpolate(image.flatten(2), lattices).view_as(image)


def lattice_from_numbers(numbers: Tensor) -> Tensor:
    """A lattice (..., 3, n, n, n) from its numbers in a row, (..., 3 n^3)."""
    nodes = nodes_of(numbers.shape[-1])
    if nodes is None:
        raise ValueError(
            f"lattice must have the shape (3, n, n, n), n from 2 to {MAX_NODES}, or be as many numbers, "
            f"got {numbers.shape[-1]}; add or drop some"
        )
    return numbers.unflatten(-1, (3, nodes, nodes, nodes))


def colours_of_nodes(nodes: int) -> Tensor:
    """Colours (3, n, n, n) of the nodes, in float64."""
    steps = torch.arange(nodes, dtype=torch.float64) / (nodes - 1)
    return torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"))


def resampled(lattice: Tensor, nodes: int) -> Tensor:
    """A lattice (..., 3, n, n, n) with another number of nodes, (..., 3, m, m, m)."""
    lattices = lattice.double().view(-1, *lattice.shape[-4:])
    colours = colours_of_nodes(nodes).flatten(1)[None, :, None].expand(len(lattices), -1, -1, -1)
    return lattice_change(colours, lattices).view(*lattice.shape[:-3], nodes, nodes, nodes)
