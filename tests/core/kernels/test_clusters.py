"""Pivots and Lloyd's iteration: the kernels in C agree with the definitions in torch."""

import pytest
import torch

from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core.kernels.clusters import TRIALS, lloyd
from nlfilter_torch.operator import landmarks
from tests.native import LEVELS, by_torch, random
from tests.pairwise import pairwise


@pytest.mark.parametrize(
    ("level", "batch", "size", "points_and_marks"),
    pairwise(LEVELS, [1, 3], [1, 25], [(1, 1), (5, 3), (64, 7), (65, 20), (1000, 50)]),
    indirect=["level"],
)
def test_landmarks(level: int, batch: int, size: int, points_and_marks: tuple[int, int]) -> None:
    points, marks = points_and_marks
    cloud = random(batch, size, points)
    draws = torch.rand(marks, TRIALS, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    pivots, expected = landmarks._pivots(cloud, draws), by_torch(landmarks._pivots, cloud, draws)
    assert torch.equal(pivots[:, :6], expected[:, :6])  # on a line, the others are chosen by rounding
    assert torch.equal(pivots, expected) or size == 1
    start = cloud.gather(2, pivots.unsqueeze(1).expand(-1, size, -1))
    start[:, :, marks // 2 :] += 100.0 * (marks > 3)  # far from all points, so that they do not move
    margin = landmarks.TIE * torch.finfo(torch.float32).eps
    assignment = lloyd(cloud, start, 5, margin)
    assert (assignment == by_torch(lloyd, cloud, start, 5, margin)).float().mean() > 0.95
    assert assignment.max() < max(marks // 2, 1) or marks <= 3


IMAGES = {
    "constant": torch.full((5, 8), 0.5),
    "large constant": torch.full((48, 64), 0.5),
    "checkerboard": ((torch.arange(16)[:, None] + torch.arange(24)) % 2).float(),
    "stripes": (torch.arange(24) % 4 / 4).expand(16, 24),
    "repeated patch": torch.rand(4, 6, generator=torch.Generator().manual_seed(0)).repeat(4, 4),
}


@pytest.mark.parametrize(
    ("level", "name", "spatial_bandwidth", "marks"),
    pairwise(LEVELS, list(IMAGES), [2.0, 5.0], [3, 10, 25]),
    indirect=["level"],
)
def test_ties_are_broken_by_one_rule(level: int, name: str, spatial_bandwidth: float, marks: int) -> None:
    image = IMAGES[name]
    filtered = random(1, 1, *image.shape)

    def build() -> tuple[torch.Tensor, torch.Tensor]:
        operator = nonlocal_operator(
            image[None, None],
            photometric_bandwidth=0.1,
            spatial_bandwidth=spatial_bandwidth,
            num_landmarks=marks,
            tolerance=1e-6,
        )
        return operator.kernel.landmarks, operator @ filtered

    (landmarks, result), (expected, by_definition) = build(), by_torch(build)
    torch.testing.assert_close(landmarks, expected, atol=1e-5, rtol=1e-5)
    # Balancing enlarges rounding where all landmarks are far away.
    torch.testing.assert_close(result, by_definition, atol=1e-4, rtol=0)
