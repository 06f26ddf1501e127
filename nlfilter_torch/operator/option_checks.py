"""Checks of the options for building an operator, from a guide, from features or from the rows of a picture."""

import torch
from torch import Tensor

from nlfilter_torch.core.checks import (
    check_choice,
    check_count,
    check_instance,
    check_number,
    check_positive,
    described,
)
from nlfilter_torch.core.warning import warn
from nlfilter_torch.operator.options import Construction, OperatorOptions, SpatialBandwidth, bandwidths_of


def check_construction(options: Construction) -> None:
    """Raise an error for an invalid option."""
    remedy = "choose one of these, and pass the number of landmarks as num_landmarks"
    check_choice(options.landmarks, "landmarks", ("kmeans", "uniform", "random"), remedy)
    check_choice(options.completion, "completion", ("diagonal", "none"))
    check_count(options.num_landmarks, "num_landmarks")
    if options.tolerance is not None:
        check_number(options.tolerance, "tolerance", "pass a float or None")
        check_positive(options.tolerance, "tolerance")
    if options.generator is not None:
        check_instance(options.generator, torch.Generator, "generator", "create one with torch.Generator()")


def check_options(options: OperatorOptions) -> None:
    """Raise an error for an invalid option, except for bandwidths, whose shape depends on the guide."""
    check_choice(options.guide_channels, "guide_channels", ("luminance", "all"))
    check_construction(options)


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


def landmark_count(options: Construction, points: int) -> int:
    """Number of landmarks, reduced with a warning where there are fewer points."""
    if options.num_landmarks > points:
        got = described(options.num_landmarks)
        warn(f"num_landmarks must be at most the number of pixels, {points}, got {got}; using every pixel")
        return points
    return options.num_landmarks
