"""A layer for looks with learned parts."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_count, check_image
from nlfilter_torch.core.precision import working_dtype
from nlfilter_torch.core.torch_internals import in_format_of
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.build import operator_from_guide
from nlfilter_torch.operator.features import reduce_channels
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
from nlfilter_torch.photo.declared.shared_parameters import SHADING_DISTANCE, SHADING_LANDMARKS, SHADING_LEVELS
from nlfilter_torch.photo.looks.histogram import KINDS_OF_LEVELS, STRENGTHS
from nlfilter_torch.photo.looks.look_filter import BLURS, LOOK_PARTS, LookPart, acts, check_part, filter_look


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
        knots: int = 17,
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
        start = {
            "alpha": torch.ones(4),
            "bands": torch.ones(BLURS + 1),
            "texture": torch.ones(BLURS),
            "curves": torch.linspace(0, 1, knots).expand(3, -1),
            "matrix": torch.eye(3),
            "saturation": torch.ones(5),
            "stretch": torch.zeros(KINDS_OF_LEVELS),
            "local": torch.zeros(STRENGTHS),
            "lattice": torch.zeros(3, 9, 9, 9),
        } | initial
        for name, value in start.items():
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
        *,
        alpha: Tensor | None = None,
        bands: Tensor | None = None,
        texture: Tensor | None = None,
        curves: Tensor | None = None,
        matrix: Tensor | None = None,
        saturation: Tensor | None = None,
        stretch: Tensor | None = None,
        local: Tensor | None = None,
        lattice: Tensor | None = None,
    ) -> Tensor:
        """Apply the look to an image: (B, 3, H, W), with values possibly outside [0, 1].

        A part that is passed replaces the layer's own in this call, for example if a network computes it; it may have a
        first dimension of B. None uses the layer's own.

        Args:
            image: (B, 3, H, W) in [0, 1].
            operator: W of the image's luminance, if available; None builds it unless the sliders are all 1.
            alpha: (k+1,) or (B, k+1).
            bands: (7,) or (B, 7).
            texture: (6,) or (B, 6).
            curves: (3, K) or (B, 3, K).
            matrix: (3, 3) or (B, 3, 3).
            saturation: (K,) or (B, K).
            stretch: (3,) or (B, 3).
            local: (8,) or (B, 8).
            lattice: (3, n, n, n) or (B, 3, n, n, n).
        """
        check_image(image, "image", channels=3)
        passed = (alpha, bands, texture, curves, matrix, saturation, stretch, local, lattice)
        parts: dict[str, Tensor] = {
            name: getattr(self, name) if part is None else part for name, part in zip(LOOK_PARTS, passed, strict=True)
        }
        exact = image.to(working_dtype(image))
        if operator is None and acts(parts["alpha"]):
            operator = operator_from_guide(reduce_channels(exact, "luminance"), self._options(image))
        detail = None if operator is None else partial(polynomial_filter, operator)
        return in_format_of(filter_look(exact, parts, detail), image)

    def _options(self, image: Tensor) -> FilterOptions:
        """Options of the filter for an image (B, 3, H, W)."""
        if not isinstance(self.options.spatial_bandwidth, str):
            return self.options
        return replace(self.options, spatial_bandwidth=SHADING_DISTANCE * min(image.shape[-2:]))
