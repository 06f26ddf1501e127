"""The options of a filter: one value, from the function that a user calls to the operator; declared here alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Protocol, Self, runtime_checkable

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_choice,
    check_count,
    check_features,
    check_instance,
    check_number,
    check_positive,
    check_values,
    described,
)
from nlfilter_torch.core.torch_internals import with_tensors
from nlfilter_torch.core.warning import warn


@dataclass(frozen=True, eq=False)
class Assignment:
    """Which points the landmarks of an operator are made of, without their features.

    With an assignment that is held, landmarks are a smooth function of the features, and so are W and all that is
    computed from it. Choosing landmarks anew is not: k-means starts from other points after the smallest change.

    Attributes:
        candidates: (B, S), numbers of the points from which landmarks are computed, counted over the whole image. Here
            and below, a batch size of 1 serves for all images.
        clusters: (B, S), number of the landmark that each candidate belongs to, which is the mean of its candidates;
            None if the candidates themselves are the landmarks.
        start: (B, 1, M), the candidate that replaces the mean of an empty cluster, or None.
        points: N, number of points of the whole image.
    """

    candidates: Tensor
    clusters: Tensor | None
    start: Tensor | None
    points: int

    @property
    def num_landmarks(self) -> int:
        """M."""
        return self.candidates.shape[-1] if self.start is None else self.start.shape[2]

    @property
    def batch(self) -> int:
        """Number of images that have an assignment of their own, or 1 if all share one."""
        own = self.candidates if self.clusters is None else self.clusters
        return own.shape[0]

    @property
    def kind(self) -> tuple[int, int, int, bool]:
        """What assignments have in common that can be joined to one of several images."""
        return self.points, self.candidates.shape[1], self.num_landmarks, self.clusters is None

    def serves(self, batch: int, points: int) -> bool:
        """Whether landmarks can be computed from the features of ``batch`` images of so many points."""
        return points == self.points and self.batch in (1, batch)

    def on(self, device: torch.device) -> "Assignment":
        """The assignment on a device."""
        if self.candidates.device == device:
            return self
        clusters, start = (None if tensor is None else tensor.to(device) for tensor in (self.clusters, self.start))
        return Assignment(self.candidates.to(device), clusters, start, self.points)


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

Auto = Literal["auto"]

AUTO: Auto = "auto"  # photometric bandwidth: estimate it from the guide; number of landmarks: as many as needed
FIRST = 64  # landmarks that are tried first
SAMPLING: Sampling = "kmeans"  # how landmarks are chosen by default
SAMPLINGS = (
    "choose one of these, or pass features (B, D, M) or an operator, and pass the number of landmarks as num_landmarks"
)


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
    covering: bool = False  # num_landmarks="auto": it is the first number that is tried
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


def first_count(num_landmarks: int | Auto) -> tuple[int, bool]:
    """The number of landmarks, or the first that is tried, and whether more are to cover the points."""
    if not isinstance(num_landmarks, str):
        return num_landmarks, False
    check_choice(num_landmarks, "num_landmarks", (AUTO,), "pass it or a number")
    return FIRST, True


def check_options(options: FilterOptions) -> None:
    """Raise an error for an invalid option, except for bandwidths and patches, whose shape depends on the guide."""
    check_choice(options.guide_channels, "guide_channels", ("luminance", "all"))
    check_count(options.num_landmarks, "num_landmarks")
    if isinstance(options.landmarks, Tensor):
        check_features(options.landmarks, "landmarks")
    elif isinstance(options.landmarks, str) or not isinstance(options.landmarks, Assignment | HasLandmarks):
        check_choice(options.landmarks, "landmarks", ("kmeans", "uniform", "random"), SAMPLINGS)
    check_choice(options.completion, "completion", ("diagonal", "none"))
    if options.tolerance is not None:
        check_number(options.tolerance, "tolerance", "pass a float or None")
        check_positive(options.tolerance, "tolerance")
    if options.generator is not None:
        check_instance(options.generator, torch.Generator, "generator", "create one with torch.Generator()")


def check_bandwidths(options: FilterOptions, batch: int | None = None, axes: int = 2) -> None:
    """Raise unless the bandwidths are those of a guide with so many axes, for all images or for each of a batch."""
    photometric, spatial = options.photometric_bandwidth, options.spatial_bandwidth
    if isinstance(photometric, str):
        check_choice(photometric, "photometric_bandwidth", (AUTO,), "pass it or a number")
    else:
        check_values(photometric, "photometric_bandwidth", "positive", batch)
    if isinstance(spatial, tuple | list) and len(spatial) != axes:
        count, distances = ("two", "") if axes == 2 else ("three", "depth, ")
        raise ValueError(
            f"spatial_bandwidth must be a number, or {count} for {distances}vertical and horizontal distances, got "
            f"{len(spatial)} in a {type(spatial).__name__}; pass {count} numbers"
        )
    if spatial is not None:
        for bandwidth in bandwidths_of(spatial):
            check_positive(bandwidth, "spatial_bandwidth", batch)


def landmark_count(options: FilterOptions, points: int) -> int:
    """Number of landmarks, reduced with a warning where there are fewer points to choose from."""
    if not isinstance(options.landmarks, str) or options.num_landmarks <= points:
        return options.landmark_count
    got = described(options.num_landmarks)
    warn(f"num_landmarks must be at most the number of pixels, {points}, got {got}; using every pixel")
    return points
