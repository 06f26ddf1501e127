"""Landmarks of an operator: chosen anew, held by an assignment, or passed as features."""

import math

import torch
from torch import Tensor

from nlfilter_torch.core.communicator import ALONE, Communicator
from nlfilter_torch.operator.assignment import Assignment, Layout
from nlfilter_torch.operator.landmarks import assign_landmarks, choose_in_graph, landmarks_of
from nlfilter_torch.operator.options import FilterOptions


def landmarks_by(
    options: FilterOptions,
    features: Tensor,
    size: tuple[int, ...],
    count: int,
    communicator: Communicator = ALONE,
    weights: Tensor | None = None,
    layout: Layout | None = None,
) -> tuple[Tensor, Assignment | None]:
    """Landmarks (B, D, M) for features (B, D, N) of an image of ``size``, by the ``landmarks`` of some options.

    Also returns of which points they are made; None for landmarks that were passed as features.

    Raises:
        ValueError: if the landmarks do not fit the features.
    """
    landmarks = options.landmarks
    if isinstance(landmarks, str):
        if torch.compiler.is_compiling():  # never with a generator, weights or a group
            return choose_in_graph(features, size, count, landmarks, layout)
        return assign_landmarks(features, size, count, landmarks, options.generator, communicator, weights, layout)
    batch, points = features.shape[0], math.prod(size)
    if isinstance(landmarks, Assignment):
        _check_assignment(landmarks, batch, points)
        return landmarks_of(features, landmarks, communicator), landmarks
    if not isinstance(landmarks, Tensor):
        if landmarks.assignment is not None and landmarks.assignment.serves(batch, points):
            return landmarks_of(features, landmarks.assignment, communicator), landmarks.assignment
        landmarks = landmarks.landmarks.detach()
    _check_features(landmarks, features)
    return communicator.copy_to_group(landmarks.to(features.dtype)).expand(batch, -1, -1), None


def _check_assignment(assignment: Assignment, batch: int, points: int) -> None:
    """Raise unless landmarks can be computed by an assignment."""
    if not assignment.serves(batch, points):
        images = f"{assignment.batch} images" if assignment.batch > 1 else "one image"
        raise ValueError(
            f"landmarks must be an assignment of {points} points of {batch} images, got one of {assignment.points} "
            f"points of {images}; pass the operator or its landmarks, whose features are then kept"
        )


def _check_features(landmarks: Tensor, features: Tensor) -> None:
    """Raise unless landmarks (B, D, M) fit features (B, D, N)."""
    batch, size, _ = features.shape
    if landmarks.shape[1] != size:
        raise ValueError(
            f"landmarks must have shape (B, {size}, M), with as many features as the points, got "
            f"{tuple(landmarks.shape)}; take them from an operator with the same patch size, channels and coordinates"
        )
    if landmarks.shape[0] not in (1, batch):
        raise ValueError(
            f"landmarks must have a batch size of 1 or {batch}, like the points, got {landmarks.shape[0]}; "
            "pass landmarks[:1] to use the same for all"
        )
    if landmarks.device != features.device:
        raise ValueError(
            f"landmarks must be on the device of the points, {features.device}, got {landmarks.device}; move one by "
            ".to()"
        )
