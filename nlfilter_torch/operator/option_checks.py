"""Checks of the options for building an operator, from a guide, from features or from the rows of a picture."""

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_choice,
    check_count,
    check_features,
    check_instance,
    check_number,
    check_positive,
    described,
)
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.assignment import Assignment
from nlfilter_torch.operator.options import (
    Construction,
    HasLandmarks,
    Landmarks,
    OperatorOptions,
    SpatialBandwidth,
    bandwidths_of,
)

SAMPLINGS = (
    "choose one of these, or pass features (B, D, M) or an operator, and pass the number of landmarks as num_landmarks"
)


def check_construction(options: Construction) -> None:
    """Raise an error for an invalid option."""
    check_count(options.num_landmarks, "num_landmarks")
    check_landmarks(options.landmarks)
    check_choice(options.completion, "completion", ("diagonal", "none"))
    if options.tolerance is not None:
        check_number(options.tolerance, "tolerance", "pass a float or None")
        check_positive(options.tolerance, "tolerance")
    if options.generator is not None:
        check_instance(options.generator, torch.Generator, "generator", "create one with torch.Generator()")


def check_landmarks(landmarks: Landmarks) -> None:
    """Raise unless this is a name of a sampling, an assignment, features (B, D, M), or has landmarks."""
    if isinstance(landmarks, Tensor):
        check_features(landmarks, "landmarks")
    elif not isinstance(landmarks, Assignment | HasLandmarks):
        check_choice(landmarks, "landmarks", ("kmeans", "uniform", "random"), SAMPLINGS)


def count_of(landmarks: Tensor | Assignment | HasLandmarks) -> int:
    """M."""
    if isinstance(landmarks, Assignment):
        return landmarks.num_landmarks
    return (landmarks if isinstance(landmarks, Tensor) else landmarks.landmarks).shape[2]


def check_options(options: OperatorOptions) -> None:
    """Raise an error for an invalid option, except for bandwidths, whose shape depends on the guide."""
    check_choice(options.guide_channels, "guide_channels", ("luminance", "all"))
    check_construction(options)


def check_bandwidths(
    photometric: float | Tensor | str, spatial: SpatialBandwidth | None, batch: int | None = None, axes: int = 2
) -> None:
    """Raise unless these are bandwidths, for all images with so many axes or for each of a batch."""
    if isinstance(photometric, str):
        check_choice(photometric, "photometric_bandwidth", ("auto",), "pass it or a number")
    else:
        check_positive(photometric, "photometric_bandwidth", batch)
    if isinstance(spatial, tuple | list) and len(spatial) != axes:
        count, distances = ("two", "") if axes == 2 else ("three", "depth, ")
        raise ValueError(
            f"spatial_bandwidth must be a number, or {count} for {distances}vertical and horizontal distances, got "
            f"{len(spatial)} in a {type(spatial).__name__}; pass {count} numbers"
        )
    if spatial is not None:
        for bandwidth in bandwidths_of(spatial):
            check_positive(bandwidth, "spatial_bandwidth", batch)


def landmark_count(options: Construction, points: int) -> int:
    """Number of landmarks, reduced with a warning where there are fewer points to choose from."""
    if not isinstance(options.landmarks, str):
        return count_of(options.landmarks)
    if options.num_landmarks > points:
        got = described(options.num_landmarks)
        warn(f"num_landmarks must be at most the number of pixels, {points}, got {got}; using every pixel")
        return points
    return options.num_landmarks
