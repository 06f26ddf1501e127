"""Abstraction of a photograph to flat areas, with optional edge lines and few tones. Paper: Sec. V-D, Fig. 18.

Edges and tones after Winnemoeller, Olsen and Gooch, "Real-Time Video Abstraction", SIGGRAPH 2006 (the paper's [30]).
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nlfilter_torch.core.blocks import Inner
from nlfilter_torch.core.checks import check_count, check_reach
from nlfilter_torch.core.rational import rational_form
from nlfilter_torch.core.torch_internals import is_unreadable
from nlfilter_torch.operator.features import blur, blur_margin
from nlfilter_torch.operator.options import Completion, FilterOptions, GuideChannels, Sampling
from nlfilter_torch.photo.declared.declaration import Edit
from nlfilter_torch.photo.declared.parameters import ABSTRACT
from nlfilter_torch.photo.picture import measuring
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.edit import PhotoEdit
from nlfilter_torch.photo.picture.in_memory import edited
from nlfilter_torch.photo.picture.pixels import LessMean, M, whole_image
from nlfilter_torch.photo.picture.source import Fitted, Guide, Pixels, Planes, Source
from nlfilter_torch.photo.picture.viewing import fit_change, viewed_size

# Difference of Gaussians on luminance from 0 to 100: scale and weight of the wider one, and steepness.
WIDER, SENSITIVITY, FALLOFF = 1.6, 0.98, 1.0
SOFT, CRISP = 5.0, 25.0  # steepness of the steps between tones in flat areas and at edges
MIN_SQUARED_GRADIENT = 1e-12  # lower limit of squared gradients; keeps the derivative of their square root finite
EDGE_GRADIENT = 2.0  # gradient of luminance from 0 to 100, per pixel of the viewing size, from which on steps are CRISP


def abstract(
    image: Tensor,
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
    landmarks: Sampling = ABSTRACT.defaults["landmarks"],
    completion: Completion = "diagonal",
    guide_channels: GuideChannels = "all",
    generator: torch.Generator | None = None,
) -> Tensor:
    """Remove small detail from a photograph and keep its outlines: ``W^k y`` with a fractional k.

    Paper: Sec. V-D. The kernel compares colours and has a spatial term, so that the filter is local. Lines along edges
    and quantized luminance are optional.

    Args:
        image: (B, C, H, W) in [0, 1]; lines and tones require C = 1 or 3.
        power: k, from 0 to 10, a number or a tensor of shape () or (B,); 0 changes nothing.
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
        landmarks: how the landmarks are chosen, see :func:`nonlocal_operator`.
        completion: of the kernel's diagonal, see :func:`nonlocal_operator`.
        guide_channels: what the filter compares, ``"luminance"`` or ``"all"`` channels.
        generator: source of randomness for the landmarks; None draws the same for every call.

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
    return edited(Abstract, locals())


@dataclass(frozen=True, kw_only=True, eq=False)
class Abstract(PhotoEdit):
    """The edit of :func:`abstract`."""

    declared: ClassVar[Edit] = ABSTRACT
    relative: ClassVar[bool] = True
    filtering: ClassVar[FilterOptions] = FilterOptions(guide_channels="all")
    power: float | Tensor
    edges: float
    edge_width: float | None
    tones: int | None
    viewing_size: float

    def fit(self, source: Source[M], drawn: Drawn[M]) -> Fitted:
        """Fit the flattened picture, with lines and tones."""
        check_count(self.options.num_landmarks, "num_landmarks")
        ABSTRACT.check(source.batch, power=self.power, edges=self.edges, edge_width=self.edge_width)
        ABSTRACT.check(source.batch, viewing_size=self.viewing_size)
        width = ABSTRACT["edge_width"].pixels(self.edge_width, source.size)
        check_reach(width, "edge_width", source.size)
        ABSTRACT.check(tones=self.tones)
        if (self.edges > 0 or self.tones is not None) and source.channels not in (1, 3):
            raise ValueError(
                f"image must have 1 or 3 channels for edges and tones, got {source.channels}; select 1 or 3"
            )
        fitted = fit_change(source, self._change, whole_image, self.viewing_size, "none")
        if self.edges == 0 and self.tones is None:
            return fitted
        scale = source.size[0] / viewed_size(source.size, self.viewing_size)[0]
        drawing = Drawing(self.edges, width, self.tones, scale)
        return Fitted(fitted.pixels, drawing.finish, margin=blur_margin(WIDER * width) + 1)

    def _change(self, viewed: Source[M]) -> Fitted:
        """The change of a picture at the viewing size."""
        return Fitted(self.flattened(viewed).change)

    def flattened(self, source: Source[M]) -> "Flattened":
        """Compute ``W^k y``; powers above 1 in several steps."""
        operator = source.operator(Guide(self.filter_options(source.size, fewer_landmarks=True)))
        # W^k for k up to 1 by four poles alone, which cost about as much as a spectrum: the gains of eigenvalues from
        # 1e-4 to 1 are right to 7e-3, those of smaller ones nearly that of 1e-4, and pixels to a grey level (RMS 0.1).
        form, steps = rational_form(decades=4, degree=0, poles=4, first=2.0, last=8.0), _steps(self.power)
        # W preserves constants, but a rational function of it does so only up to rounding: filter without the mean.
        mean = measuring.mean(source, whole_image)
        exponent = torch.as_tensor(self.power, dtype=torch.float64, device=mean.device).reshape(-1, 1) / steps
        weights = form.coefficients(form.nodes.to(mean.device) ** exponent).expand(source.batch, -1)
        planes: Planes = LessMean(whole_image, mean)
        for _ in range(steps):
            planes = operator.rational(planes, form, weights)
        return Flattened(mean, planes)


def _steps(power: float | Tensor) -> int:
    """Number of steps with powers of at most 1; that of the largest power where it cannot be read."""
    if isinstance(power, Tensor):
        power = ABSTRACT["power"].high if is_unreadable(power) else float(power.detach().max())
    return max(1, math.ceil(power))


@dataclass(frozen=True, eq=False)
class Flattened:
    """``W^k y`` of a picture y.

    Attributes:
        mean: of the picture, (B, C, 1, 1).
        varying: ``W^k`` of the picture less its mean.
    """

    mean: Tensor
    varying: Planes

    def __call__(self, pixels: Pixels) -> Tensor:
        """The flattened pixels."""
        return self.mean + self.varying(pixels)

    def change(self, pixels: Pixels) -> Tensor:
        """The change of the pixels."""
        return self(pixels) - pixels.image


@dataclass(frozen=True)
class Drawing:
    """Lines along the edges of a flattened picture, and few tones.

    Attributes:
        edges: darkness of the lines.
        width: of the lines, in pixels.
        tones: number of levels of luminance; None does not quantize.
        scale: gradients are those of a picture with pixels so many times as large.
    """

    edges: float
    width: float
    tones: int | None
    scale: float = 1.0

    def finish(self, _: Tensor, flat: Tensor, __: Inner) -> Tensor:
        """Quantize the luminance of a flattened image (B, C, H, W), and draw lines along its edges."""
        luminance, chroma = split_luminance(flat) if flat.shape[1] == 3 else (flat, torch.zeros_like(flat))
        toned = luminance if self.tones is None else self.quantized(luminance, self.tones)
        toned = toned * (1 - self.edges * (1 - self.lines(luminance)))
        return merge_luminance(toned, chroma) if flat.shape[1] == 3 else toned

    def lines(self, luminance: Tensor) -> Tensor:
        """Compute lines (B, 1, H, W) from a difference of Gaussians: 1 off the lines, towards 0 in their middle."""
        near, far = blur(luminance, self.width), blur(luminance, WIDER * self.width)
        difference = 100 * (near - SENSITIVITY * far)
        return 1 + torch.tanh(FALLOFF * difference.clamp(max=0.0))

    def quantized(self, luminance: Tensor, tones: int) -> Tensor:
        """Quantize luminance (B, 1, H, W), with soft steps in flat areas and steep ones at edges."""
        from kornia.filters import spatial_gradient  # kornia takes half a second to import

        step = 1 / (tones - 1)
        nearest = (luminance / step).round() * step
        squared = spatial_gradient(luminance, mode="diff").square().sum(2)
        gradient = 100 * self.scale * squared.clamp(min=MIN_SQUARED_GRADIENT).sqrt()
        steepness = SOFT + (CRISP - SOFT) * (gradient / EDGE_GRADIENT).clamp(max=1.0)
        # Steepness is relative to a step, so that transitions look alike for any number of tones.
        return nearest + step / 2 * torch.tanh(steepness * (luminance - nearest) / step)
