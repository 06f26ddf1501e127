"""A layer that aligns coarse logits or masks with the edges of an image."""

from collections.abc import Collection
from dataclasses import replace
from types import MappingProxyType
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from nlfilter_torch.core.checks import check_choice, check_count, check_positive
from nlfilter_torch.filtering.refine import FILTER, KINDS, MARGIN, STRENGTH, Kind, MeanField, refined
from nlfilter_torch.nn.parameters import Learnable, check_learn, positive_option
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.options import (
    AUTO,
    SAMPLING,
    FilterOptions,
    GuideChannels,
    Sampling,
    check_bandwidths,
    check_options,
)

RefineOption = Literal["strength", "margin", "compatibility", "photometric_bandwidth", "spatial_bandwidth"]
LEARNABLE: tuple[RefineOption, ...] = get_args(RefineOption)


class Refine(Learnable):
    """Layer that aligns coarse logits, probabilities, a mask or a trimap with an image by :func:`refine`.

    Args:
        kind: as for :func:`refine`.
        steps: as for :func:`refine`.
        strength: a positive number.
        margin: a positive number, or None.
        caution: a positive number, ``"auto"`` as for :func:`refine`, or None, with which nothing holds learned
            bandwidths back.
        patch_size: as for :func:`nonlocal_operator`.
        photometric_bandwidth: a positive number in units of the guide, or ``"auto"``.
        spatial_bandwidth: a positive number of pixels, None or ``"auto"``.
        num_landmarks: as for :func:`nonlocal_operator`.
        landmarks: as for :func:`nonlocal_operator`.
        guide_channels: as for :func:`nonlocal_operator`.
        classes: number of classes K, needed to learn ``"compatibility"``; 2 for masks and single logits.
        learn: the options to learn: any of ``"strength"``, ``"margin"``, ``"compatibility"`` (from the identity) and,
            if they start from numbers, ``"photometric_bandwidth"`` and ``"spatial_bandwidth"``. All but the
            compatibility stay positive.

    Attributes:
        compatibility: parameter (K, K), or None.

    Raises:
        TypeError, ValueError: if an option is not valid, or ``learn`` has any other name.

    Example:
        >>> layer = Refine(classes=3, learn=("strength", "compatibility"), num_landmarks=20)
        >>> layer(torch.zeros(1, 3, 16, 16), torch.rand(1, 3, 16, 16)).shape
        torch.Size([1, 3, 16, 16])
    """

    learnable = MappingProxyType({name: f"log_{name}" for name in LEARNABLE if name != "compatibility"})
    strength: float | Tensor = positive_option("strength", "Number; a tensor of shape () if it is learned.")
    margin: float | Tensor | None = positive_option("margin", "Number or None; a tensor of shape () if it is learned.")
    photometric_bandwidth: float | Literal["auto"] | Tensor = positive_option(
        "photometric_bandwidth", 'Number or ``"auto"``; a tensor of shape () if it is learned.'
    )
    spatial_bandwidth: float | Literal["auto"] | Tensor | None = positive_option(
        "spatial_bandwidth", 'Number of pixels, None or ``"auto"``; a tensor of shape () if it is learned.'
    )
    compatibility: Tensor | None

    def __init__(
        self,
        *,
        kind: Kind = "logits",
        steps: int = MeanField.steps,
        strength: float = STRENGTH,
        margin: float | None = MARGIN,
        caution: float | Literal["auto"] | None = AUTO,
        patch_size: int = FILTER.patch_size,
        photometric_bandwidth: float | Literal["auto"] = AUTO,
        spatial_bandwidth: float | Literal["auto"] | None = AUTO,
        num_landmarks: int = FILTER.num_landmarks,
        landmarks: Sampling = SAMPLING,
        guide_channels: GuideChannels = FILTER.guide_channels,
        classes: int | None = None,
        learn: RefineOption | Collection[RefineOption] = ("strength", "margin"),
    ) -> None:
        super().__init__()
        names = check_learn(learn, LEARNABLE)
        check_choice(kind, "kind", KINDS, "say what the first argument is")
        check_count(steps, "steps", most=1000)
        if isinstance(caution, str):
            check_choice(caution, "caution", (AUTO,), "pass it, a number or None")
        elif caution is not None:
            check_positive(caution, "caution")
        options = FilterOptions.of(locals())
        check_options(options)
        self.kind: Kind = kind
        self.steps = steps
        self.caution = caution
        self.patch_size = patch_size
        self.num_landmarks = num_landmarks
        self.landmarks: Sampling = landmarks
        self.guide_channels: GuideChannels = guide_channels
        self.start_positive("strength", strength, names)
        self.start_positive("margin", margin, names, other=type(None))
        if isinstance(spatial_bandwidth, str):
            check_choice(spatial_bandwidth, "spatial_bandwidth", (AUTO,), "pass it, a number of pixels or None")
            options = replace(options, spatial_bandwidth=None)
        check_bandwidths(options)
        self.start_positive("photometric_bandwidth", photometric_bandwidth, names, other=str)
        self.start_positive(
            "spatial_bandwidth", spatial_bandwidth, names, other=type(None) if spatial_bandwidth is None else str
        )
        if "compatibility" not in names:
            self.register_parameter("compatibility", None)
            return
        if classes is None:
            raise ValueError("classes must be the number of classes to learn compatibility, got None; pass it")
        check_count(classes, "classes", least=2)
        self.compatibility = nn.Parameter(torch.eye(classes))

    def forward(self, logits: Tensor, guide: Tensor | NonlocalOperator, confidence: Tensor | None = None) -> Tensor:
        """Refine an input (B, K, H, W) with a guide (B, C, H, W) or its operator, in the dtype of the input.

        Args:
            logits: of the layer's ``kind``.
            guide: the image, or its operator, which replaces the layer's own options of the operator.
            confidence: (B, 1, H, W) in [0, 1], as for :func:`refine`.
        """
        method = MeanField(
            steps=self.steps,
            strength=self.strength,
            margin=self.margin,
            compatibility=self.compatibility,
            caution=self.caution,
        )
        options = FILTER
        if not isinstance(guide, NonlocalOperator):
            options = FilterOptions(
                patch_size=self.patch_size,
                photometric_bandwidth=self.photometric_bandwidth,
                spatial_bandwidth=self.spatial_bandwidth,
                num_landmarks=self.num_landmarks,
                landmarks=self.landmarks,
                guide_channels=self.guide_channels,
            )
        return refined(logits, guide, self.kind, confidence, method, options)

    def extra_repr(self) -> str:
        """The options."""
        return (
            f"kind={self.kind!r}, steps={self.steps}, strength={self.shown('strength')}, "
            f"margin={self.shown('margin')}, caution={self.caution}, "
            f"photometric_bandwidth={self.shown('photometric_bandwidth')}, "
            f"spatial_bandwidth={self.shown('spatial_bandwidth')}, num_landmarks={self.num_landmarks}"
        )
