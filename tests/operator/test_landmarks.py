"""Features to landmarks: three samplings, determinism, and images with few distinct patches."""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch.operator import landmarks
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
from tests.images import hard_images, photograph
from tests.pairwise import each_value
from tests.problems import noise

HEIGHT, WIDTH = 20, 30
SAMPLINGS = ("kmeans", "uniform", "random")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def choose_landmarks(*arguments: Any) -> torch.Tensor:
    return assign_landmarks(*arguments)[0]


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_starts_drawn_in_blocks_are_about_as_good_as_those_drawn_singly(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = 0.5 * cloud(2, 3000).to(dtype)
    x[0, :, :300] *= 0.01  # many similar points
    x[0, :, 7:2900:1000] += 50.0 * torch.arange(1, 4)  # and three unlike all others

    def residual() -> torch.Tensor:
        pivots = _pivots(x, 300, seeded())
        assert all(len(row.unique()) == 300 for row in pivots)
        assert {7, 1007, 2007} <= set(pivots[0].tolist())
        marks = condense(x, 300, seeded())
        return nystrom_factor(x, marks, inverse_cholesky(marks), "diagonal")[1].mean(1)

    in_blocks = residual()
    monkeypatch.setattr(landmarks, "DRAWN_SINGLY", 300)
    assert (in_blocks < 1.25 * residual()).all()


@pytest.mark.parametrize(("marks", "spread"), each_value([64, 100, 300], [0.05, 0.1, 0.15]))
def test_no_cluster_is_missed(marks: int, spread: float) -> None:
    generator = seeded(1)
    centres = torch.randn(60, 64, generator=generator)
    members = torch.randint(60, (4096,), generator=generator)
    x = (centres[members] + spread * torch.randn(4096, 64, generator=generator)).mT.unsqueeze(0)
    landmarks = choose_landmarks(x, (1, 4096), marks, "kmeans", None)
    apart = torch.cdist(centres, landmarks[0].mT).amin(1)
    assert apart.max() < 8 * spread / 2 + 0.1  # of clusters whose radius is 8 spreads, and which are 11 apart


def test_starts_drawn_in_blocks_do_not_depend_on_the_batch() -> None:
    x = cloud(2, 1000)
    alone = torch.cat([_pivots(image, 300, seeded()) for image in x.split(1)])
    assert torch.equal(_pivots(x, 300, seeded()), alone)


def test_a_few_points_that_hold_all_of_the_residual_do_not_fill_a_block() -> None:
    x = torch.zeros(1, 1, 1000, dtype=torch.float64)
    x[0, 0, :5] = 50.0 * torch.arange(1, 6)
    pivots = _pivots(x, 300, seeded())[0]
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
