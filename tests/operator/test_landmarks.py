"""Features to landmarks: three samplings, determinism, and images with few distinct patches."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nlfilter_torch import NonlocalOperator, nonlocal_operator, operator_from_features, polynomial_filter
from nlfilter_torch.core.kernels import clusters
from nlfilter_torch.operator.landmarks import (
    _pivots,
    _sums_by_product,
    _sums_in_order,
    assign_landmarks,
    candidate_pixels,
    choose_in_graph,
    condense,
)
from nlfilter_torch.operator.nystrom import inverse_cholesky, nystrom_factor
from nlfilter_torch.operator.options import Assignment, FilterOptions
from tests import reference
from tests.images import hard_images, photograph
from tests.pairwise import each_value, pairwise
from tests.problems import SAMPLINGS, noise, picture, seeded

HEIGHT, WIDTH = 20, 30


def choose_landmarks(
    features: torch.Tensor, size: tuple[int, ...], count: int, sampling: Any, generator: torch.Generator | None
) -> torch.Tensor:
    options = FilterOptions(num_landmarks=count, landmarks=sampling, generator=generator)
    return assign_landmarks(features, size, options)[0]


def cloud(batch: int = 1, pixels: int = HEIGHT * WIDTH, seed: int = 0) -> torch.Tensor:
    """Features (B, 4, N) in float64."""
    return torch.randn(batch, 4, pixels, generator=seeded(seed), dtype=torch.float64)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@given(count=st.integers(1, 60))
def test_there_are_as_many_as_asked_for(sampling: str, count: int) -> None:
    landmarks = choose_landmarks(cloud(2, 60), (6, 10), count, sampling, seeded())
    assert landmarks.shape == (2, 4, count)
    assert landmarks.isfinite().all()


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_as_many_as_pixels_are_the_pixels(sampling: str) -> None:
    x = cloud()
    landmarks = choose_landmarks(x, (HEIGHT, WIDTH), HEIGHT * WIDTH, sampling, seeded())
    assert (landmarks.sort(dim=2).values == x.sort(dim=2).values).all()


@pytest.mark.parametrize("sampling", ["uniform", "random"])
@given(height=st.integers(1, 12), width=st.integers(1, 12), data=st.data())
def test_sampled_landmarks_are_distinct_pixels(sampling: str, height: int, width: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, height * width))
    numbers = torch.arange(height * width, dtype=torch.float64).view(1, 1, -1)
    chosen = choose_landmarks(numbers, (height, width), count, sampling, seeded())[0, 0]
    assert chosen.unique().numel() == count
    assert (chosen == chosen.round()).all()


@pytest.mark.parametrize(("height", "width", "count"), [(100, 100, 100), (60, 90, 54), (1, 64, 16), (64, 1, 16)])
def test_uniform_landmarks_lie_evenly(height: int, width: int, count: int) -> None:
    numbers = torch.arange(height * width, dtype=torch.float64).view(1, 1, -1)
    chosen = choose_landmarks(numbers, (height, width), count, "uniform", None)[0, 0].long()
    points = torch.stack([chosen // width, chosen % width], dim=1).double()
    apart = torch.cdist(points, points).fill_diagonal_(float("inf")).min(1).values
    spacing = (height * width / count) ** 0.5 if min(height, width) > 1 else height * width / count
    assert apart.min() >= 0.6 * spacing
    margin = torch.tensor([height, width]) - 1 - points.amax(0)
    assert ((points.amin(0) - margin).abs() <= spacing).all()


def test_kmeans_landmarks_are_nearer_to_the_pixels_than_sampled_ones() -> None:
    x = cloud()

    def spread(sampling: str) -> float:
        landmarks = choose_landmarks(x, (HEIGHT, WIDTH), 40, sampling, seeded())
        return torch.cdist(x[0].T, landmarks[0].T).min(1).values.square().mean().item()

    assert spread("kmeans") < 0.85 * min(spread("uniform"), spread("random"))


def test_kmeans_landmarks_are_means_of_their_pixels() -> None:
    x = torch.cat([cloud(seed=1)[..., :300] - 20, cloud(seed=2)[..., :300] + 20], dim=2)
    landmarks = choose_landmarks(x, (HEIGHT, WIDTH), 2, "kmeans", seeded())[0].sort(dim=1).values
    expected = torch.stack([x[0, :, :300].mean(1), x[0, :, 300:].mean(1)], dim=1)
    torch.testing.assert_close(landmarks, expected, atol=0.5, rtol=0)  # k-means uses a subset of the pixels


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_generator_decides(sampling: str) -> None:
    x = cloud()
    first, again = (choose_landmarks(x, (HEIGHT, WIDTH), 20, sampling, seeded(5)) for _ in range(2))
    assert (first == again).all()
    other = choose_landmarks(x, (HEIGHT, WIDTH), 20, sampling, seeded(6))
    assert sampling == "uniform" or not torch.equal(first, other)
    default = [choose_landmarks(x, (HEIGHT, WIDTH), 20, sampling, None) for _ in range(2)]
    assert torch.equal(*default)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_batch_chooses_what_each_image_chooses(sampling: str) -> None:
    x = cloud(3)
    together = choose_landmarks(x, (HEIGHT, WIDTH), 20, sampling, seeded())
    alone = [choose_landmarks(x[i : i + 1], (HEIGHT, WIDTH), 20, sampling, seeded()) for i in range(3)]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-12, rtol=0)


@pytest.mark.parametrize(("dtype", "name"), each_value([torch.float32, torch.float64], list(hard_images())))
def test_few_distinct_features_leave_the_landmarks_finite_and_usable(name: str, dtype: torch.dtype) -> None:
    image = torch.from_numpy(hard_images()[name]).to(dtype)
    x = image.reshape(1, 1, -1) * 100
    landmarks = choose_landmarks(x, tuple(image.shape), min(50, x.shape[2] - 1), "kmeans", seeded())
    assert landmarks.isfinite().all()
    assert landmarks.min() >= x.min() - 1e-3
    assert landmarks.max() <= x.max() + 1e-3
    factor, diagonal = nystrom_factor(x, landmarks, inverse_cholesky(landmarks), "diagonal")
    assert factor.isfinite().all()
    assert diagonal.isfinite().all()


@pytest.mark.parametrize(("count", "expected"), [(100, 6400), (512, 32768), (1000, 32768), (20_000, 40_000)])
def test_candidates_stop_growing_with_the_landmarks(count: int, expected: int) -> None:
    assert len(candidate_pixels((1000, 1000), count, "kmeans", seeded())) == expected


def pivot_draws(count: int) -> torch.Tensor:
    return torch.rand(count, clusters.TRIALS, generator=seeded(), dtype=torch.float64)


def test_starts_drawn_in_blocks_are_about_as_good_as_those_drawn_singly(monkeypatch: pytest.MonkeyPatch) -> None:
    x = 0.5 * cloud(2, 3000).float()
    x[0, :, :300] *= 0.01  # many similar points
    x[0, :, 7:2900:1000] += 50.0 * torch.arange(1, 4)  # and three unlike all others

    def residual(seed: int) -> torch.Tensor:
        marks = condense(x, 300, seeded(seed))
        return nystrom_factor(x, marks, inverse_cholesky(marks), "diagonal")[1].mean(1)

    pivots, in_blocks = _pivots(x, pivot_draws(300)), sum(map(residual, range(3)))
    assert all(len(row.unique()) > 285 for row in pivots)  # few are chosen twice
    assert {7, 1007, 2007} <= set(pivots[0].tolist())
    monkeypatch.setattr(clusters, "LARGEST", 1)
    assert (in_blocks < 1.25 * sum(map(residual, range(3)))).all()


@pytest.mark.parametrize(("marks", "spread"), each_value([64, 100, 300], [0.05, 0.1, 0.15]))
def test_no_cluster_is_missed(marks: int, spread: float) -> None:
    generator = seeded(1)
    centres = torch.randn(60, 64, generator=generator)
    members = torch.randint(60, (4096,), generator=generator)
    x = (centres[members] + spread * torch.randn(4096, 64, generator=generator)).mT.unsqueeze(0)
    landmarks = choose_landmarks(x, (1, 4096), marks, "kmeans", None)
    apart = torch.cdist(centres, landmarks[0].mT).amin(1)
    assert apart.max() < 8 * spread / 2 + 0.1  # of clusters whose radius is 8 spreads, and which are 11 apart


def test_starts_of_many_landmarks_do_not_depend_on_the_batch() -> None:
    x = cloud(2, 1000)
    alone = torch.cat([_pivots(image, pivot_draws(300)) for image in x.split(1)])
    assert torch.equal(_pivots(x, pivot_draws(300)), alone)


def test_a_few_points_that_hold_all_of_the_residual_do_not_fill_a_block() -> None:
    x = torch.zeros(1, 1, 1000, dtype=torch.float64)
    x[0, 0, :5] = 50.0 * torch.arange(1, 6)
    pivots = _pivots(x, pivot_draws(300))[0]
    assert set(range(5)) <= set(pivots.tolist())
    assert len(pivots.unique()) > 200


@pytest.mark.parametrize("count", [20, 300])
def test_both_precisions_choose_the_same_landmarks(count: int) -> None:
    x = cloud(2).float()
    single, double = (choose_landmarks(y, (HEIGHT, WIDTH), count, "kmeans", seeded()) for y in (x, x.double()))
    assert double.dtype == torch.float64
    torch.testing.assert_close(single.double(), double, atol=1e-5, rtol=1e-5)


def test_features_whose_squares_overflow_in_single_precision() -> None:
    x = 1e25 * cloud()
    landmarks = choose_landmarks(x, (HEIGHT, WIDTH), 300, "kmeans", seeded())
    assert landmarks.isfinite().all()
    assert landmarks.unique(dim=2).shape[2] > 100


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_landmarks_pass_gradients_to_the_features(sampling: str) -> None:
    x = cloud().requires_grad_()
    choose_landmarks(x, (HEIGHT, WIDTH), 20, sampling, seeded()).sum().backward()
    assert x.grad is not None
    # Every landmark is a mean of features, so the gradients of each coordinate sum to the number of landmarks.
    torch.testing.assert_close(x.grad.sum(2), torch.full((1, 4), 20.0, dtype=torch.float64))


def test_kmeans_does_not_mind_an_offset() -> None:
    x = torch.from_numpy(photograph("camera", 20, 30).copy()).float().view(1, 1, -1) * 10
    near, far = (choose_landmarks(x + shift, (20, 30), 20, "kmeans", seeded()) - shift for shift in (0.0, 4096.0))
    # Grey levels are often equally far from two centres, and rounding decides; the quality of the centres is the same.
    spread, spread_far = ((x - marks.mT).square().amin(1).mean() for marks in (near, far))
    assert spread_far < 1.1 * spread


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_ways_to_add_up_clusters_agree(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 3, 200, generator=generator, dtype=dtype, requires_grad=True)
    assignment = torch.randint(0, 6, (2, 200), generator=generator)  # of 7: the last is empty
    in_order, by_product = (add(points, assignment, 7) for add in (_sums_in_order, _sums_by_product))
    torch.testing.assert_close(in_order, by_product)
    torch.testing.assert_close(in_order[1, :, 2], points[1][:, assignment[1] == 2].sum(1))
    assert (in_order[:, :, 6] == 0).all()
    slopes = torch.randn(in_order.shape, generator=generator, dtype=dtype)
    gradients = [torch.autograd.grad(sums, points, slopes)[0] for sums in (in_order, by_product)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("sampling", ["kmeans", "uniform", "random"])
def test_landmarks_in_a_graph_are_those_without_one(sampling: Any) -> None:
    features = noise(2, 3, 2000, dtype=torch.float32)
    expected = choose_landmarks(features, (40, 50), 20, sampling, None)
    torch.testing.assert_close(choose_in_graph(features, (40, 50), 20, sampling)[0], expected, atol=0, rtol=0)
    assert torch.equal(choose_in_graph(features, (40, 50), 2000, sampling)[0], features)


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
    guide = picture("camera", 4, 5)
    held = built(guide, 0.3, num_landmarks=5, patch_size=3)
    weights = noise(1, 1, 4, 5)

    def moving(guide: Tensor, bandwidth: Tensor) -> Tensor:
        operator = built(guide, bandwidth, landmarks=held, patch_size=3, tolerance=1e-13)
        return (operator @ weights).square().sum()

    def passed(features: Tensor, landmarks: Tensor) -> Tensor:
        operator = operator_from_features(features, size=(4, 5), landmarks=landmarks, tolerance=1e-13)
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
