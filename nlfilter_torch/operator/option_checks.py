"""Checks of the options of a filter."""

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
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.assignment import Assignment
from nlfilter_torch.operator.options import AUTO, FilterOptions, HasLandmarks, bandwidths_of

SAMPLINGS = (
    "choose one of these, or pass features (B, D, M) or an operator, and pass the number of landmarks as num_landmarks"
)


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
