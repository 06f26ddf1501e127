"""The options of a filter: one value, from the function that a user calls to the operator; declared here alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from nlfilter_torch.core.torch_internals import with_tensors
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
GuideChannels = Literal["luminance", "all"]
SpatialBandwidth = float | Tensor | tuple[float | Tensor, ...] | list[float | Tensor]
Completion = Literal["diagonal", "none"]

AUTO: Literal["auto"] = "auto"  # photometric bandwidth: estimate it from the guide
SAMPLING: Sampling = "kmeans"  # how landmarks are chosen by default


@with_tensors
@dataclass(frozen=True, kw_only=True, eq=False)
class FilterOptions:
    """How a filter is built; see :func:`nonlocal_operator` for the meaning of the options.

    A function with these arguments makes one value of them, which is passed on as it is. Functions that choose a
    bandwidth themselves also take None or a word for it, and replace these before an operator is built. An operator of
    features, which are divided by their bandwidths, uses the options after ``patch_weights`` alone.
    """

    patch_size: int = 5
    photometric_bandwidth: float | Tensor | str | None = AUTO
    spatial_bandwidth: SpatialBandwidth | str | None = None
    guide_channels: GuideChannels = "luminance"
    patch_weights: Tensor | None = None
    num_landmarks: int = 100
    landmarks: Landmarks = SAMPLING
    completion: Completion = "diagonal"
    tolerance: float | None = None
    generator: torch.Generator | None = None
    group: Any = None

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Self:
        """The options among the arguments of a function, such as its ``locals()`` before it has other variables."""
        return cls().updated(arguments)

    def updated(self, arguments: Mapping[str, Any]) -> Self:
        """The options, with those among some arguments in their place."""
        return replace(
            self, **{option.name: arguments[option.name] for option in fields(self) if option.name in arguments}
        )

    def bandwidth_or(self, estimate: Callable[[], float | Tensor]) -> float | Tensor:
        """The photometric bandwidth, or an estimate in place of ``"auto"``; call :func:`check_bandwidths` before."""
        chosen = self.photometric_bandwidth
        return estimate() if isinstance(chosen, str) or chosen is None else chosen

    @property
    def landmark_count(self) -> int:
        """M: the number of landmarks to choose, or of those that are given."""
        if isinstance(self.landmarks, str):
            return self.num_landmarks
        if isinstance(self.landmarks, Assignment):
            return self.landmarks.num_landmarks
        return (self.landmarks if isinstance(self.landmarks, Tensor) else self.landmarks.landmarks).shape[2]


def bandwidths_of(spatial: SpatialBandwidth | str | None) -> tuple[Any, ...]:
    """The bandwidth of all distances, or those along each axis."""
    return tuple(spatial) if isinstance(spatial, tuple | list) else (spatial,)
