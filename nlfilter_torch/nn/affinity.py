"""A layer that builds an operator from a guide."""

from collections.abc import Collection
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import check_choice
from nlfilter_torch.core.communicator import check_group
from nlfilter_torch.nn.parameters import Learnable, UnitWindow, check_learn, positive_option
from nlfilter_torch.operator.build import nonlocal_operator
from nlfilter_torch.operator.features import unit_window
from nlfilter_torch.operator.operator import NonlocalOperator
from nlfilter_torch.operator.option_checks import check_options
from nlfilter_torch.operator.options import AUTO, Completion, GuideChannels, OperatorOptions, Sampling


class NonlocalAffinity(Learnable):
    """Layer that builds an operator from a guide by :func:`nonlocal_operator`, with the same options.

    Args:
        patch_size: as for :func:`nonlocal_operator`.
        photometric_bandwidth: a positive number in units of the guide, or ``"auto"``.
        spatial_bandwidth: a positive number of pixels, or None.
        num_landmarks: as for :func:`nonlocal_operator`.
        landmarks: as for :func:`nonlocal_operator`.
        completion: as for :func:`nonlocal_operator`.
        guide_channels: as for :func:`nonlocal_operator`.
        patch_weights: as for :func:`nonlocal_operator`.
        tolerance: as for :func:`nonlocal_operator`.
        generator: as for :func:`nonlocal_operator`. Every call then draws different landmarks; do not combine it with
            gradient checkpointing, which expects two runs of the layer to agree.
        group: as for :func:`nonlocal_operator`. A layer with a group cannot be pickled or copied.
        learn: the options to learn: any of ``"photometric_bandwidth"`` and ``"spatial_bandwidth"`` (which need initial
            values) and ``"patch_weights"``. All stay positive.

    Raises:
        TypeError, ValueError: if ``learn`` has any other name, or an option is not valid for :func:`nonlocal_operator`.
    """

    learnable = MappingProxyType(
        {
            "photometric_bandwidth": "log_photometric_bandwidth",
            "spatial_bandwidth": "log_spatial_bandwidth",
            "patch_weights": "patch_weights.logits",
        }
    )
    photometric_bandwidth: float | Literal["auto"] | Tensor = positive_option(
        "photometric_bandwidth", 'Number or ``"auto"``; a tensor of shape () if it is learned.'
    )
    spatial_bandwidth: float | Tensor | None = positive_option(
        "spatial_bandwidth", "Number of pixels or None; a tensor of shape () if it is learned."
    )

    def __init__(
        self,
        *,
        patch_size: int = OperatorOptions.patch_size,
        photometric_bandwidth: float | Literal["auto"] = AUTO,
        spatial_bandwidth: float | None = None,
        num_landmarks: int = OperatorOptions.num_landmarks,
        landmarks: Sampling = OperatorOptions.landmarks,
        completion: Completion = OperatorOptions.completion,
        guide_channels: GuideChannels = OperatorOptions.guide_channels,
        patch_weights: Tensor | None = OperatorOptions.patch_weights,
        tolerance: float | None = OperatorOptions.tolerance,
        generator: torch.Generator | None = OperatorOptions.generator,
        group: Any = OperatorOptions.group,
        learn: Collection[str] = (),
    ) -> None:
        super().__init__()
        names = check_learn(learn, tuple(self.learnable))
        check_options(
            OperatorOptions(
                num_landmarks=num_landmarks,
                landmarks=landmarks,
                completion=completion,
                guide_channels=guide_channels,
                tolerance=tolerance,
                generator=generator,
            )
        )
        check_group(group)
        window = unit_window(patch_size, patch_weights).detach()  # learned only with learn=("patch_weights",)
        self.patch_size = patch_size
        self.num_landmarks = num_landmarks
        self.landmarks: Sampling = landmarks
        self.completion: Completion = completion
        self.guide_channels: GuideChannels = guide_channels
        self.tolerance = tolerance
        self.generator = generator
        self.group = group

        if isinstance(photometric_bandwidth, str):
            check_choice(photometric_bandwidth, "photometric_bandwidth", ("auto",), "pass it or a number")
            if "photometric_bandwidth" in names:
                raise ValueError(
                    "photometric_bandwidth must be a number if it is learned, got 'auto'; "
                    "pass the mean of estimate_bandwidth over a few guides"
                )
        if spatial_bandwidth is None and "spatial_bandwidth" in names:
            raise ValueError(
                "spatial_bandwidth must be a number of pixels if it is learned, got None; "
                "start with a third of the image's height"
            )
        self.start_positive("photometric_bandwidth", photometric_bandwidth, names, other=str)
        self.start_positive("spatial_bandwidth", spatial_bandwidth, names, other=type(None))
        # Non-persistent: a fixed window is a constructor option like the others.
        self.patch_weights: Tensor | UnitWindow | None
        if "patch_weights" in names:
            self.patch_weights = UnitWindow(window)
        else:
            self.register_buffer("patch_weights", None if patch_weights is None else window, persistent=False)

    def forward(self, guide: Tensor) -> NonlocalOperator:
        """Build the operator of a guide (B, C, H, W)."""
        weights = self.patch_weights
        return nonlocal_operator(
            guide,
            patch_size=self.patch_size,
            photometric_bandwidth=self.photometric_bandwidth,
            spatial_bandwidth=self.spatial_bandwidth,
            num_landmarks=self.num_landmarks,
            landmarks=self.landmarks,
            completion=self.completion,
            guide_channels=self.guide_channels,
            patch_weights=weights() if isinstance(weights, UnitWindow) else weights,
            tolerance=self.tolerance,
            generator=self.generator,
            group=self.group,
        )

    def extra_repr(self) -> str:
        """The options of the operator."""
        return (
            f"patch_size={self.patch_size}, photometric_bandwidth={self.shown('photometric_bandwidth')}, "
            f"spatial_bandwidth={self.shown('spatial_bandwidth')}, num_landmarks={self.num_landmarks}, "
            f"landmarks={self.landmarks!r}, completion={self.completion!r}, guide_channels={self.guide_channels!r}"
        )
