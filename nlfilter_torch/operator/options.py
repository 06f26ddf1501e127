"""Options for building an operator, from a guide, from features or from the rows of a picture: defaults and checks."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_choice,
    check_count,
    check_instance,
    check_number,
    check_positive,
    described,
    warn,
)
from nlfilter_torch.operator.features import GuideChannels, SpatialBandwidth, bandwidths_of
from nlfilter_torch.operator.landmarks import Sampling
from nlfilter_torch.operator.nystrom import Completion

AUTO: Literal["auto"] = "auto"  # photometric bandwidth: estimate it from the guide


@dataclass(frozen=True, kw_only=True, eq=False)
class Construction:
    """How an operator is built from features; see :func:`operator_from_features` for the meaning of the options.

    The only declaration of their defaults.
    """

    num_landmarks: int = 100
    landmarks: Sampling = "kmeans"
    completion: Completion = "diagonal"
    tolerance: float | None = None
    generator: torch.Generator | None = None
    group: Any = None

    def check(self) -> None:
        """Raise an error for an invalid option."""
        remedy = "choose one of these, and pass the number of landmarks as num_landmarks"
        check_choice(self.landmarks, "landmarks", ("kmeans", "uniform", "random"), remedy)
        check_choice(self.completion, "completion", ("diagonal", "none"))
        check_count(self.num_landmarks, "num_landmarks")
        if self.tolerance is not None:
            check_number(self.tolerance, "tolerance", "pass a float or None")
            check_positive(self.tolerance, "tolerance")
        if self.generator is not None:
            check_instance(self.generator, torch.Generator, "generator", "create one with torch.Generator()")

    def count(self, points: int) -> int:
        """Number of landmarks, reduced with a warning where there are fewer points."""
        if self.num_landmarks > points:
            got = described(self.num_landmarks)
            warn(f"num_landmarks must be at most the number of pixels, {points}, got {got}; using every pixel")
        return min(self.num_landmarks, points)


@dataclass(frozen=True, kw_only=True, eq=False)
class OperatorOptions(Construction):
    """How an operator is built from a guide; see :func:`nonlocal_operator` for the meaning of the options.

    The only declaration of their defaults.
    """

    patch_size: int = 5
    photometric_bandwidth: float | Tensor | Literal["auto"] = AUTO
    spatial_bandwidth: SpatialBandwidth | None = None
    guide_channels: GuideChannels = "luminance"
    patch_weights: Tensor | None = None

    def check(self) -> None:
        """Raise an error for an invalid option, except for bandwidths, whose shape depends on the guide."""
        check_choice(self.guide_channels, "guide_channels", ("luminance", "all"))
        super().check()


def check_bandwidths(
    photometric: float | Tensor | str, spatial: SpatialBandwidth | None, batch: int | None = None
) -> None:
    """Raise unless these are bandwidths, for all images or for each of a batch."""
    if isinstance(photometric, str):
        check_choice(photometric, "photometric_bandwidth", ("auto",), "pass it or a number")
    else:
        check_positive(photometric, "photometric_bandwidth", batch)
    if isinstance(spatial, tuple | list) and len(spatial) != 2:
        raise ValueError(
            "spatial_bandwidth must be a number, or two for vertical and horizontal distances, got "
            f"{len(spatial)} in a {type(spatial).__name__}; pass two numbers"
        )
    if spatial is not None:
        for bandwidth in bandwidths_of(spatial):
            check_positive(bandwidth, "spatial_bandwidth", batch)
