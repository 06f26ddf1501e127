"""Assignments: of which points landmarks are made, and whom they serve."""

import torch

from nlfilter_torch.operator.assignment import Assignment
from nlfilter_torch.operator.landmarks import assign_landmarks, landmarks_of
from tests.problems import noise


def test_an_assignment_serves_images_of_as_many_points() -> None:
    shared = Assignment(torch.arange(5)[None], None, None, 60)
    assert (shared.batch, shared.num_landmarks) == (1, 5)
    assert shared.serves(3, 60)
    assert not shared.serves(3, 61)
    assert shared.on(torch.device("cpu")) is shared


def test_landmarks_by_an_assignment_are_those_it_was_returned_with() -> None:
    features = noise(2, 3, 200)
    landmarks, assignment = assign_landmarks(features, (10, 20), 7, "kmeans", None)
    assert (assignment.batch, assignment.num_landmarks) == (2, 7)
    assert not assignment.serves(3, 200)
    assert torch.equal(landmarks_of(features, assignment), landmarks)
