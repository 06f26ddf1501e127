"""Landmarks that are held by an assignment or passed as features: smooth, kept exactly, refused if they do not fit."""

import io
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalOperator, nonlocal_operator, operator_from_features, polynomial_filter
from nlfilter_torch.operator.assignment import Assignment
from tests import reference
from tests.pairwise import pairwise
from tests.problems import SAMPLINGS, noise, picture, seeded

ALPHA = torch.tensor([3.0, 1.0], dtype=torch.float64)


def built(guide: Tensor, bandwidth: float | Tensor = 0.1, **options: object) -> NonlocalOperator:
    return nonlocal_operator(guide, photometric_bandwidth=bandwidth, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("dtype", "sampling", "take"),
    pairwise([torch.float32, torch.float64], SAMPLINGS, ["operator", "assignment", "landmarks"]),
)
def test_landmarks_of_an_operator_give_the_same_operator(dtype: torch.dtype, sampling: str, take: str) -> None:
    guide = torch.cat([picture(name, 20, 24, dtype) for name in ("camera", "coffee")])
    first = built(guide, num_landmarks=30, landmarks=sampling, generator=seeded(4))
    second = built(guide, landmarks=first if take == "operator" else getattr(first, take))
    assert torch.equal(second.landmarks, first.landmarks)
    assert torch.equal(second.factor, first.factor)
    assert second.landmarks.shape == (2, 25, 30)
    assert (second.assignment is None) == (take == "landmarks")


def test_as_many_landmarks_as_pixels_can_be_held() -> None:
    guide = picture("camera", 6, 7)
    first = built(guide, num_landmarks=42)
    second = built(guide, 0.3, landmarks=first)
    assert torch.equal(second.landmarks, built(guide, 0.3, num_landmarks=42).landmarks)


def slope_and_difference(value: Callable[[Tensor], Tensor], at: float, step: float) -> tuple[float, float]:
    """Derivative by autograd, and central difference for a relative step."""
    point = torch.tensor(at, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(point), point)
    with torch.no_grad():
        far, near = (value(torch.tensor(at * (1 + sign * step), dtype=torch.float64)) for sign in (1, -1))
    return float(slope), float(far - near) / (2 * step * at)


@pytest.mark.parametrize("take", ["assignment", "landmarks"])
def test_gradients_describe_what_the_next_call_does(take: str) -> None:
    image = picture("camera", 32, 32)
    held = getattr(built(image, 0.08, num_landmarks=60), take)

    def loss(bandwidth: Tensor) -> Tensor:
        return (polynomial_filter(built(image, bandwidth, landmarks=held), image, ALPHA) - image).square().mean()

    for step in (1e-4, 1e-3, 1e-2):
        slope, difference = slope_and_difference(loss, 0.08, step)
        assert abs(difference / slope - 1) < 0.01, step


def test_slight_noise_in_the_guide_changes_the_output_slightly() -> None:
    image = picture("camera", 48, 48)
    noisy = image + 1e-4 * torch.randn(image.shape, generator=seeded(), dtype=torch.float64)
    first = built(image, 20 / 255, num_landmarks=100)
    change = built(noisy, 20 / 255, landmarks=first) @ image - first @ image
    assert change.square().mean().sqrt() < 5e-5


def test_operator_of_held_landmarks_is_that_of_the_reference() -> None:
    image = picture("coffee", 12, 13)
    held = built(image, 0.2, num_landmarks=25)
    operator = built(image, 0.15, landmarks=held)
    assert held.assignment is not None
    assert held.assignment.clusters is not None
    points = reference.features(image[0, 0].numpy(), 5, 0.15)[held.assignment.candidates[0].numpy()]
    clusters = held.assignment.clusters[0].numpy()
    landmarks = np.stack([points[clusters == number].mean(0) for number in range(25)])
    features = reference.features(image[0, 0].numpy(), 5, 0.15)
    columns = reference.affinity(features, landmarks)
    between = reference.affinity(landmarks, landmarks) + 1e-5 * np.eye(25)
    kernel = columns @ np.linalg.solve(between, columns.T)
    np.fill_diagonal(kernel, 1.0)
    np.testing.assert_allclose(operator.to_dense()[0].numpy(), reference.balanced(kernel, 200), atol=1e-9)


def test_gradcheck_with_held_and_with_passed_landmarks() -> None:
    guide = picture("camera", 5, 6)
    held = built(guide, 0.3, num_landmarks=6, patch_size=3)
    weights = noise(1, 1, 5, 6)

    def moving(guide: Tensor, bandwidth: Tensor) -> Tensor:
        operator = built(guide, bandwidth, landmarks=held, patch_size=3, tolerance=1e-13)
        return (operator @ weights).square().sum()

    def passed(features: Tensor, landmarks: Tensor) -> Tensor:
        operator = operator_from_features(features, size=(5, 6), landmarks=landmarks, tolerance=1e-13)
        return (operator @ weights).square().sum()

    bandwidth = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(moving, (guide.clone().requires_grad_(), bandwidth))
    features = held.kernel.recipe(guide)
    assert torch.autograd.gradcheck(
        passed, (features.clone().requires_grad_(), held.landmarks.clone().requires_grad_())
    )


def test_one_set_of_landmarks_serves_for_all_images() -> None:
    guides = torch.cat([picture(name, 16, 18) for name in ("camera", "coffee", "chelsea")])
    first = built(guides[:1], num_landmarks=20)
    for held in (first, first.landmarks):
        together = built(guides, landmarks=held)
        assert together.landmarks.shape == (3, 25, 20)
        for number in range(3):
            alone = built(guides[number : number + 1], landmarks=held)
            torch.testing.assert_close(together.landmarks[number : number + 1], alone.landmarks, atol=0, rtol=0)
            torch.testing.assert_close(together.factor[number], alone.factor[0], atol=1e-12, rtol=0)


def test_operator_of_another_size_or_batch_passes_its_features() -> None:
    first = built(picture("camera", 20, 20), num_landmarks=30)
    for guide in (picture("camera", 9, 31), picture("coffee", 4, 5)):  # the last has fewer pixels than landmarks
        second = built(guide, landmarks=first)
        assert torch.equal(second.landmarks, first.landmarks)
        assert second.assignment is None
        sums = second.row_sums()
        torch.testing.assert_close(sums, torch.ones_like(sums), atol=1e-9, rtol=0)
    pair = built(torch.cat([picture("camera", 20, 20), picture("coffee", 20, 20)]), num_landmarks=10)
    with pytest.raises(ValueError, match="landmarks must have a batch size of 1 or 3"):
        built(picture("camera", 20, 20).expand(3, -1, -1, -1), landmarks=pair)


def test_landmarks_survive_moving_and_files() -> None:
    guide = picture("camera", 12, 12)
    first = built(guide, num_landmarks=15)
    stream = io.BytesIO()
    torch.save(first.to(torch.float32), stream)
    stream.seek(0)
    loaded = torch.load(stream, weights_only=True)
    assert loaded.landmarks.dtype == torch.float32
    assert isinstance(loaded.assignment, Assignment)
    assert loaded.assignment.candidates.dtype == torch.long
    assert torch.equal(built(guide, landmarks=loaded).landmarks, first.landmarks)


def test_landmarks_of_operators_that_are_selected_and_joined() -> None:
    guides = torch.cat([picture(name, 12, 12) for name in ("camera", "coffee", "chelsea")])
    for sampling in SAMPLINGS:
        operator = built(guides, num_landmarks=15, landmarks=sampling)
        parts = [built(guide, num_landmarks=15, landmarks=sampling) for guide in guides.split(1)]
        for first in (operator, NonlocalOperator.cat(parts)):
            second = built(guides[1:], 0.2, landmarks=first[1:])
            torch.testing.assert_close(second.landmarks, first.landmarks[1:] / 2)
            assert second.assignment is not None
    mixed = NonlocalOperator.cat([parts[0], built(guides[1:2], landmarks=parts[1].landmarks)])
    assert mixed.assignment is None
    torch.testing.assert_close(built(guides[:2], landmarks=mixed).landmarks, mixed.landmarks)


def test_weighted_points_and_points_without_order() -> None:
    points, weights = noise(2, 3, 300), 1 + 4 * noise(2, 300, seed=1)
    first = operator_from_features(points, size=(300,), weights=weights, num_landmarks=12)
    second = operator_from_features(1.05 * points, size=(300,), weights=weights, landmarks=first)
    torch.testing.assert_close(second.landmarks, 1.05 * first.landmarks)


def test_hard_guides() -> None:
    flat = torch.full((1, 1, 8, 9), 0.5)
    halves = (torch.arange(9) > 4).float().expand(1, 1, 8, 9)
    single = torch.zeros(1, 1, 1, 1)
    for guide in (flat, halves):
        first = built(guide, num_landmarks=10)
        for other in (flat, halves, noise(1, 1, 8, 9, dtype=torch.float32)):
            second = built(other, landmarks=first)
            assert (second @ other).isfinite().all()
            assert second.residual.max() < 1e-4
    assert torch.equal(built(single, landmarks=built(single, num_landmarks=1)) @ single, single)
    empty = built(flat[:0], landmarks=built(flat, num_landmarks=100 - 28))
    assert empty.landmarks.shape == (0, 25, 72)


HELD = built(noise(2, 1, 6, 6), num_landmarks=8)
GUIDE = noise(2, 1, 6, 6, seed=1)


def test_num_landmarks_is_ignored_where_landmarks_are_passed() -> None:
    expected = built(GUIDE, landmarks=HELD)
    for num_landmarks in (3, 9):
        operator = built(GUIDE, landmarks=HELD, num_landmarks=num_landmarks)
        assert torch.equal(operator.factor, expected.factor)


def test_an_assignment_fits_any_patch_size() -> None:
    assert built(GUIDE, landmarks=HELD, patch_size=3).landmarks.shape == (2, 9, 8)
