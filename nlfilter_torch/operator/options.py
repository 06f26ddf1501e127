"""Options for building an operator, their types and their defaults; declared here alone."""

from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from torch import Tensor

from nlfilter_torch.operator.assignment import Assignment


@runtime_checkable
class HasLandmarks(Protocol):
    """An operator, for another that takes its landmarks."""

    @property
    def landmarks(self) -> Tensor:
        """Features (B, D, M)."""

    @property
    def assignment(self) -> Assignment | None:
        """Of which points the landmarks are made; None if they were passed as features."""


Sampling = Literal["kmeans", "uniform", "random"]
Landmarks = Sampling | Tensor | Assignment | HasLandmarks
Completion = Literal["diagonal", "none"]
GuideChannels = Literal["luminance", "all"]
SpatialBandwidth = float | Tensor | tuple[float | Tensor, ...] | list[float | Tensor]

AUTO: Literal["auto"] = "auto"  # photometric bandwidth: estimate it from the guide
SAMPLING: Sampling = "kmeans"  # how landmarks are chosen by default


@dataclass(frozen=True, kw_only=True, eq=False)
class Construction:
    """How an operator is built from features; see :func:`operator_from_features` for the meaning of the options."""

    num_landmarks: int = 100
    landmarks: Landmarks = SAMPLING
    completion: Completion = "diagonal"
    tolerance: float | None = None
    generator: torch.Generator | None = None
    group: Any = None


@dataclass(frozen=True, kw_only=True, eq=False)
class OperatorOptions(Construction):
    """How an operator is built from a guide; see :func:`nonlocal_operator` for the meaning of the options."""

    patch_size: int = 5
    photometric_bandwidth: float | Tensor | Literal["auto"] = AUTO
    spatial_bandwidth: SpatialBandwidth | None = None
    guide_channels: GuideChannels = "luminance"
    patch_weights: Tensor | None = None


def bandwidths_of(spatial: SpatialBandwidth | None) -> tuple[Any, ...]:
    """The bandwidth of all distances, or those along each axis."""
    return tuple(spatial) if isinstance(spatial, tuple | list) else (spatial,)
