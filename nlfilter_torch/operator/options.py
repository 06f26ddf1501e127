"""Checked options for building an operator, from a guide, from features or from the rows of a picture."""

from dataclasses import dataclass

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
from nlfilter_torch.operator.features import SpatialBandwidth, bandwidths_of
from nlfilter_torch.operator.landmarks import Sampling
from nlfilter_torch.operator.nystrom import Completion


@dataclass(frozen=True)
class Construction:
    """Checked options for building an operator from features; see :func:`nonlocal_operator`."""

    num_landmarks: int
    landmarks: Sampling
    completion: Completion
    tolerance: float | None
    generator: torch.Generator | None

    def __post_init__(self) -> None:
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
        for one in bandwidths_of(spatial):
            check_positive(one, "spatial_bandwidth", batch)
