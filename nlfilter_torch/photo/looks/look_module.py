"""A layer for looks with learned parts."""

import inspect
from collections.abc import Collection, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_count, check_image
from nlfilter_torch.core.precision import as_given, working_dtype
from nlfilter_torch.filtering.filters import polynomial_filter
from nlfilter_torch.nn.parameters import check_learn
from nlfilter_torch.operator.build import nonlocal_operator, operator_from_guide
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import OperatorOptions
from nlfilter_torch.photo.declared.shading import LANDMARKS, LEVELS, NEAR
from nlfilter_torch.photo.looks.histogram import KINDS, STRENGTHS
from nlfilter_torch.photo.looks.look_filter import BLURS, NAMES, acts, check_part, filter_look


class Look(nn.Module):
    """Layer that applies a look to an image: the sum of the changes by its parts, from sliders to a colour matrix.

    Paper: eq. (12) for the sliders. Starts from the identity, or from the result of :func:`fit_look`.

    Args:
        parts: initial values by name: ``alpha`` (k+1,), ``bands`` (7,), ``texture`` (6,), ``curves`` (3, K),
            ``matrix`` (3, 3), ``saturation`` (K,), ``stretch`` (3,) and ``local`` (8,), as from
            :meth:`FittedLook.tensors`. Omitted parts start from the identity.
        learn: names of the parts to learn; the others are buffers.
        knots: K, for curves that start from the identity.
        **options: of :func:`nonlocal_operator`, for the filter of ``alpha``; the spatial bandwidth is a twelfth of the
            short side by default.

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

    def __init__(
        self,
        parts: Mapping[str, Tensor] | None = None,
        *,
        learn: Collection[str] = NAMES,
        knots: int = 17,
        **options: Any,
    ) -> None:
        super().__init__()
        names = check_learn(learn, NAMES)
        initial = {} if parts is None else dict(parts)
        check_learn(list(initial), NAMES, "parts")
        check_count(knots, "knots", least=2)
        start = {
            "alpha": torch.ones(4),
            "bands": torch.ones(BLURS + 1),
            "texture": torch.ones(BLURS),
            "curves": torch.linspace(0, 1, knots).expand(3, -1),
            "matrix": torch.eye(3),
            "saturation": torch.ones(5),
            "stretch": torch.zeros(KINDS),
            "local": torch.zeros(STRENGTHS),
        } | initial
        for name, value in start.items():
            check_part(value, name, 1)
            own = value.detach().to(torch.get_default_dtype()).clone()
            if name in names:
                self.register_parameter(name, nn.Parameter(own))
            else:
                self.register_buffer(name, own)
        inspect.signature(nonlocal_operator).bind(None, **options)  # raises TypeError for an unknown option
        self.options = {"photometric_bandwidth": LEVELS / 255, "num_landmarks": LANDMARKS, **options}

    def forward(self, image: Tensor, operator: NonlocalOperator | None = None, **parts: Tensor) -> Tensor:
        """Apply the look to an image: (B, 3, H, W), with values possibly outside [0, 1].

        Args:
            image: (B, 3, H, W) in [0, 1].
            operator: W of the image's luminance, if available; None builds it unless the sliders are all 1.
            **parts: values that replace the layer's own in this call, for example computed by a network, with a first
                dimension of B if they differ between images.
        """
        check_image(image, "image", channels=3)
        check_learn(list(parts), NAMES, "parts")
        used = {name: parts.get(name, getattr(self, name)) for name in NAMES}
        exact = image.to(working_dtype(image))
        if operator is None and acts(used["alpha"]):
            near = {"spatial_bandwidth": NEAR * min(image.shape[-2:])}
            operator = operator_from_guide(reduce_channels(exact, "luminance"), OperatorOptions(**near | self.options))
        detail = None if operator is None else partial(polynomial_filter, operator)
        return as_given(filter_look(exact, used, detail), image)
