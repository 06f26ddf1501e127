"""A look: sliders of the filter, of blurs and of texture, tone curves, colours, levels and local contrast, added up.

For what curves, matrix and factors of saturation cannot say of colours there is a lattice, changes on a grid of them.

Each part gives a change of the image, and the result is the image plus all changes, so that it is linear in every
parameter but the image: looks are fitted to edits by least squares.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_count, check_dtype, check_finite, check_image, check_tensor
from nlfilter_torch.core.kernels.lattice import interpolate
from nlfilter_torch.core.precision import full_precision, working_dtype
from nlfilter_torch.core.torch_internals import in_format_of
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.features import pad_border, reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import (
    AUTO,
    SAMPLING,
    Completion,
    FilterOptions,
    GuideChannels,
    Sampling,
    SpatialBandwidth,
)
from nlfilter_torch.photo.declared.declaration import MAX_NODES, nodes_of
from nlfilter_torch.photo.declared.shared_parameters import (
    CURVE_KNOTS,
    LOOK,
    SHADING_DISTANCE,
    SHADING_LANDMARKS,
    SHADING_LEVELS,
)
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
COLOUR_PARTS = ("curves", "matrix", "saturation")  # functions of the colour, which are always computed
DETAIL_PARTS = ("alpha", "bands", "texture")  # gains without effect at 1; stretch, local and lattice have none at 0


@full_precision
def filter_look(
    image: Tensor, parts: Mapping[str, Tensor], detail: Callable[[Tensor, Tensor], Tensor] | None
) -> Tensor:
    """An image (B, 3, H, W) under a look of all :data:`LOOK_PARTS`, whose parts may differ between the images.

    Differentiable in everything. ``apply_look`` says what the parts are. ``detail`` is :func:`polynomial_filter` with
    W, a function of luminance and sliders, and needed only if ``alpha`` :func:`acts`.
    """
    acting = {
        name: value for name, value in parts.items() if name in COLOUR_PARTS or acts(value, float(name in DETAIL_PARTS))
    }
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


class Look(nn.Module):
    """Layer that applies a look to an image: the sum of the changes by its parts, from sliders to a colour matrix.

    Paper: eq. (12) for the sliders. Starts from the identity, or from the result of :func:`fit_look`.

    Args:
        parts: initial values by name: ``alpha`` (k+1,), ``bands`` (7,), ``texture`` (6,), ``curves`` (3, K),
            ``matrix`` (3, 3), ``saturation`` (K,), ``stretch`` (3,), ``local`` (8,) and ``lattice`` (3, n, n, n), as
            from :meth:`FittedLook.tensors`. Omitted parts start from the identity.
        learn: names of the parts to learn; the others are buffers.
        knots: K, for curves that start from the identity.
        patch_size: option of :func:`nonlocal_operator`, for the filter of ``alpha``, like the following ones.
        photometric_bandwidth: h_y in units of the luminance, or ``"auto"``.
        spatial_bandwidth: h_x in pixels; ``"auto"`` is a twelfth of the short side, None compares pixels regardless of
            their distance.
        num_landmarks: M.
        landmarks: as for :func:`nonlocal_operator`.
        completion: as for :func:`nonlocal_operator`.
        guide_channels: as for :func:`nonlocal_operator`.
        patch_weights: as for :func:`nonlocal_operator`.
        tolerance: as for :func:`nonlocal_operator`.
        generator: as for :func:`nonlocal_operator`.
        group: as for :func:`nonlocal_operator`.

    Raises:
        TypeError, ValueError: if a part has the wrong shape or an unknown name.

    Example:
        >>> layer = Look(learn=("curves", "matrix"))
        >>> image = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
        >>> torch.equal(layer(image), image), [name for name, _ in layer.named_parameters()]
        (True, ['curves', 'matrix'])
    """

    alpha: Tensor
    bands: Tensor
    texture: Tensor
    curves: Tensor
    matrix: Tensor
    saturation: Tensor
    stretch: Tensor
    local: Tensor
    lattice: Tensor

    def __init__(
        self,
        parts: Mapping[str, Tensor] | None = None,
        *,
        learn: LookPart | Collection[LookPart] = LOOK_PARTS,
        knots: int = CURVE_KNOTS,
        patch_size: int = FilterOptions.patch_size,
        photometric_bandwidth: float | Tensor | Literal["auto"] = SHADING_LEVELS / 255,
        spatial_bandwidth: SpatialBandwidth | Literal["auto"] | None = AUTO,
        num_landmarks: int = SHADING_LANDMARKS,
        landmarks: Sampling = SAMPLING,
        completion: Completion = FilterOptions.completion,
        guide_channels: GuideChannels = FilterOptions.guide_channels,
        patch_weights: Tensor | None = FilterOptions.patch_weights,
        tolerance: float | None = FilterOptions.tolerance,
        generator: torch.Generator | None = FilterOptions.generator,
        group: object = FilterOptions.group,
    ) -> None:
        arguments = locals()
        super().__init__()
        names = check_learn(learn, LOOK_PARTS)
        initial = {} if parts is None else dict(parts)
        check_learn(list(initial), LOOK_PARTS, "parts")
        check_count(knots, "knots", least=2)
        usual = {name: torch.tensor(LOOK.defaults[name]) for name in LOOK_PARTS if name not in ("curves", "lattice")}
        curves, lattice = torch.linspace(0, 1, knots).expand(3, -1), torch.zeros(3, 9, 9, 9)
        start = usual | {"curves": curves, "matrix": usual["matrix"].view(3, 3), "lattice": lattice} | initial
        for name in LOOK_PARTS:
            value = start[name]
            check_part(value, name, 1)
            own = value.detach().to(torch.get_default_dtype()).clone()
            if name in names:
                self.register_parameter(name, nn.Parameter(own))
            else:
                self.register_buffer(name, own)
        if isinstance(spatial_bandwidth, str):
            check_choice(spatial_bandwidth, "spatial_bandwidth", (AUTO,), "pass it, a number of pixels or None")
        self.options = FilterOptions.of(arguments)

    def forward(
        self,
        image: Tensor,
        operator: NonlocalOperator | None = None,
        **parts: Tensor | None,
    ) -> Tensor:
        """Apply the look to an image: (B, 3, H, W), with values possibly outside [0, 1].

        A part that is passed replaces the layer's own in this call, for example if a network computes it; it may have a
        first dimension of B. None uses the layer's own.

        Args:
            image: (B, 3, H, W) in [0, 1].
            operator: W of the image's luminance, if available; None builds it unless the sliders are all 1.
            parts: by name: ``alpha`` (k+1,) or (B, k+1), ``bands`` (7,) or (B, 7), ``texture`` (6,) or (B, 6),
                ``curves`` (3, K) or (B, 3, K), ``matrix`` (3, 3) or (B, 3, 3), ``saturation`` (K,) or (B, K),
                ``stretch`` (3,) or (B, 3), ``local`` (8,) or (B, 8), ``lattice`` (3, n, n, n) or (B, 3, n, n, n).

        Raises:
            TypeError, ValueError: if a part has the wrong shape or an unknown name.
        """
        check_image(image, "image", channels=3)
        check_learn(list(parts), LOOK_PARTS, "parts")
        own = {name: getattr(self, name) for name in LOOK_PARTS}
        whole: dict[str, Tensor] = own | {name: part for name, part in parts.items() if part is not None}
        exact = image.to(working_dtype(image))
        if operator is None and acts(whole["alpha"]):
            operator = operator_from_guide(reduce_channels(exact, "luminance"), self._options(image))
        detail = None if operator is None else partial(polynomial_filter, operator)
        return in_format_of(filter_look(exact, whole, detail), image)

    def _options(self, image: Tensor) -> FilterOptions:
        """Options of the filter for an image (B, 3, H, W)."""
        if not isinstance(self.options.spatial_bandwidth, str):
            return self.options
        return replace(self.options, spatial_bandwidth=SHADING_DISTANCE * min(image.shape[-2:]))
