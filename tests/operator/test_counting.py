"""Pixels of weight 0: padding changes nothing, and hidden pixels are filtered from those that count."""

from typing import Any

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
    operator_from_features,
    pad_images,
    polynomial_filter,
    propagate_strokes,
    segment_mask,
)
from nlfilter_torch.operator.counting import hidden_points
from tests.pairwise import each_value
from tests.problems import colour, noise, seeded

SHAPES = ((40, 50), (60, 33), (64, 64))
OPTIONS: tuple[dict[str, Any], ...] = (
    {"photometric_bandwidth": 0.08},
    {"spatial_bandwidth": 12.0},
    {"landmarks": "uniform", "photometric_bandwidth": 0.1},
    {"landmarks": "random", "guide_channels": "all"},
    {"completion": "none", "photometric_bandwidth": 0.3},
)


def padded(images: list[Tensor], size: tuple[int, int], value: float = 0.9) -> tuple[Tensor, Tensor]:
    """Images (1, C, h, w) at the top left of a batch, and the weights of its pixels."""
    batch = images[0].new_full((len(images), images[0].shape[1], *size), value)
    weights = torch.zeros(len(images), 1, *size)
    for image, canvas, row in zip(images, batch, weights, strict=True):
        canvas[:, : image.shape[2], : image.shape[3]] = image[0]
        row[:, : image.shape[2], : image.shape[3]] = 1
    return batch, weights


def largest_difference(whole: Tensor, part: Tensor) -> float:
    return float((whole[..., : part.shape[-2], : part.shape[-1]] - part).abs().max())


@pytest.mark.parametrize(("options", "dtype"), each_value(OPTIONS, [torch.float32, torch.float64]))
def test_padding_changes_nothing(options: dict[str, Any], dtype: torch.dtype) -> None:
    pictures = [colour(name).to(dtype) for name in ("coffee", "astronaut", "chelsea")]
    images = [picture[..., :h, :w] for picture, (h, w) in zip(pictures, SHAPES, strict=True)]
    batch, weights = padded(images, (64, 64))
    operator = nonlocal_operator(batch, weights=weights, num_landmarks=60, **options)
    alpha, limit = torch.tensor([3.0, 2.0, 1.05], dtype=dtype), 1e-5 if dtype == torch.float32 else 1e-12
    filtered = polynomial_filter(operator, batch, alpha)
    for number, image in enumerate(images):
        alone = nonlocal_operator(image, num_landmarks=60, **options)
        torch.testing.assert_close(operator.kernel.landmarks[number], alone.kernel.landmarks[0], atol=2e-6, rtol=2e-6)
        assert largest_difference(filtered[number], polynomial_filter(alone, image, alpha)[0]) < limit
    assert bool((operator.row_sums() - 1).abs().max() < 1e-4)


def test_masks_of_a_padded_image_are_those_of_the_image() -> None:
    image = colour("coffee").double()[..., :40, :50]
    region = torch.zeros(1, 1, 40, 50).double()
    region[..., 4:9, 20:26] = 1
    batch, weights = padded([image], (64, 64))
    regions, _ = padded([torch.cat([region, 1 - region], dim=1)], (64, 64), 1.0)  # also over the padding
    alone = nonlocal_operator(image, num_landmarks=60).spectrum()
    spectrum = nonlocal_operator(batch, weights=weights, num_landmarks=60).spectrum()
    pairs = [
        (diffusion_mask(spectrum, regions), diffusion_mask(alone, torch.cat([region, 1 - region], dim=1))),
        (segment_mask(spectrum, regions), segment_mask(alone, torch.cat([region, 1 - region], dim=1))),
        (propagate_strokes(spectrum, batch, regions[:, :1]), propagate_strokes(alone, image, region)),
    ]
    for whole, part in pairs:
        assert bool(whole.isfinite().all())
        assert largest_difference(whole, part) < 1e-9


def test_hidden_values_are_not_read_and_filled_from_what_counts() -> None:
    image = colour("coffee")
    weights = (noise(1, 1, 64, 64, seed=3) > 0.3).float()
    weights[..., 20:26, 30:36] = 0
    hidden = (weights == 0).expand_as(image)
    options: dict[str, Any] = {"photometric_bandwidth": 0.1, "num_landmarks": 60, "weights": weights}
    results = []
    for value in (0.0, 3.0):
        spoilt = torch.where(hidden, value, image)
        operator = nonlocal_operator(spoilt, **options)
        results.append(operator @ spoilt)
        share = operator.diagonal_share[weights == 0]
        assert share.median() < 1e-3
    assert torch.equal(results[0][~hidden], results[1][~hidden])
    # What is unknown is estimated: closer to the truth than the mean of the picture, by far.
    error, naive = (results[0] - image)[hidden].abs().mean(), (image.mean() - image)[hidden].abs().mean()
    assert error < 0.3 * naive


def test_points_of_weight_zero_are_as_if_left_out() -> None:
    points, weights = noise(2, 3, 80) / 0.4, (noise(2, 80, seed=1) * 4 - 2).clamp(min=0)
    weights[0, :4] = 2.0
    operator = operator_from_features(points, size=(80,), weights=weights, num_landmarks=20)
    values = noise(2, 2, 1, 80, seed=2)
    for number in range(2):
        kept = weights[number] > 0
        few = operator_from_features(
            points[number : number + 1, :, kept], size=(int(kept.sum()),), weights=weights[number, kept],
            num_landmarks=20,
        )  # fmt: skip
        torch.testing.assert_close(
            (operator @ values)[number][..., kept], (few @ values[number : number + 1, ..., kept])[0]
        )
        assert few.diagnostics().smallest_row_sum[0] == pytest.approx(operator.diagnostics().smallest_row_sum[number])
    dense = operator.to_dense()
    torch.testing.assert_close(dense.sum(2), torch.ones(2, 80).double())
    assert not bool((dense - torch.diag_embed(operator.remainder))[0][:, weights[0] == 0].any())


@pytest.mark.parametrize("landmarks", ["kmeans", "uniform"])
def test_gradcheck_with_hidden_pixels(landmarks: Any) -> None:
    weights = (noise(2, 1, 4, 5, seed=4) > 0.4).double()
    image = noise(2, 1, 4, 5, seed=5)

    def output(guide: Tensor, bandwidth: Tensor) -> Tensor:
        operator = nonlocal_operator(
            guide, photometric_bandwidth=bandwidth, num_landmarks=5, landmarks=landmarks, weights=weights
        )
        return operator @ (operator @ image)

    guide = noise(2, 1, 4, 5).requires_grad_()
    assert torch.autograd.gradcheck(output, (guide, torch.tensor(0.4).double().requires_grad_()), atol=1e-6)
    (gradient,) = torch.autograd.grad(output(guide, torch.tensor(0.4).double()).square().sum(), guide)
    assert not bool(gradient[weights == 0].any())


def test_a_picture_with_little_that_counts() -> None:
    """Samples of the balancing hold points that count."""
    image = colour("astronaut", 200, 200).repeat(1, 1, 1, 2)
    weights = torch.zeros(1, 1, 200, 400)
    weights[..., 90:93, 201:206] = 1
    operator = nonlocal_operator(image, weights=weights, num_landmarks=5)
    few = nonlocal_operator(image[..., 90:93, 201:206], num_landmarks=5)
    expected = few @ image[..., 90:93, 201:206]
    torch.testing.assert_close((operator @ image)[..., 90:93, 201:206], expected, atol=1e-5, rtol=0)
    assert bool((operator @ image).isfinite().all())


def test_a_generator_draws_the_same_for_all_images() -> None:
    images = [colour("coffee"), colour("coffee")[..., :40, :50]]
    batch, weights = padded(images, (64, 64))

    def landmarks(guide: Tensor, **options: Any) -> NonlocalOperator:
        return nonlocal_operator(guide, num_landmarks=20, generator=seeded(7), **options)

    both = landmarks(batch, weights=weights).kernel.landmarks
    for number, image in enumerate(images):
        torch.testing.assert_close(both[number], landmarks(image).kernel.landmarks[0], atol=2e-6, rtol=2e-6)


def test_landmarks_of_padded_images_can_be_held() -> None:
    images = [colour("coffee")[..., :60, :60].double(), colour("coffee")[..., :64, :50].double()]
    batch, weights = padded(images, (64, 64))
    options: dict[str, Any] = {"num_landmarks": 20, "photometric_bandwidth": 0.1, "weights": weights}
    operator = nonlocal_operator(batch, **options)
    assert operator.assignment is not None
    again = nonlocal_operator(batch, **options | {"landmarks": operator.assignment})
    torch.testing.assert_close(again @ batch, operator @ batch)
    passed = nonlocal_operator(images[0], num_landmarks=20, photometric_bandwidth=0.1, landmarks=operator.landmarks[:1])
    assert largest_difference((operator @ batch)[:1], passed @ images[0]) < 1e-12
    small, few = padded([image[..., :9, : 9 + 3 * number] for number, image in enumerate(images)], (9, 12))
    assert nonlocal_operator(small, **options | {"weights": few}).assignment is None  # with unequal candidates


def test_the_automatic_bandwidth_knows_what_counts() -> None:
    image = colour("coffee")[..., :40, :50]
    batch, weights = padded([image], (64, 64), 5.0)
    torch.testing.assert_close(estimate_bandwidth(batch, weights=weights), estimate_bandwidth(image))
    twice = estimate_bandwidth(image, weights=torch.full((1, 1, 40, 50), 2.0))
    torch.testing.assert_close(twice, estimate_bandwidth(image))


def test_equal_weights_are_none() -> None:
    image = colour("coffee")
    plain = nonlocal_operator(image, num_landmarks=30) @ image
    ones = torch.ones(1, 1, 64, 64)
    torch.testing.assert_close(
        nonlocal_operator(image, num_landmarks=30, weights=ones) @ image, plain, atol=1e-5, rtol=0
    )
    assert hidden_points(ones.flatten(1)) is None


def test_strokes_on_hidden_pixels_alone_are_refused() -> None:
    image, weights, strokes = noise(1, 1, 8, 8), torch.ones(1, 1, 8, 8), torch.zeros(1, 1, 8, 8).double()
    weights[..., 4:] = 0
    strokes[..., 5, 5] = 1
    spectrum = nonlocal_operator(image, num_landmarks=10, weights=weights).spectrum()
    with pytest.raises(ValueError, match="stroke_mask must hold a painted pixel in every image, got none"):
        propagate_strokes(spectrum, image, strokes)
    with pytest.raises(ValueError, match="region must hold a pixel of positive weight"):
        diffusion_mask(spectrum, strokes)


@pytest.mark.parametrize(
    "options", [{"photometric_bandwidth": 0.5}, {"spatial_bandwidth": 4.0, "landmarks": "uniform"}]
)
def test_volumes_are_padded_too(options: dict[str, Any]) -> None:
    options = options | {"patch_size": 3, "num_landmarks": 30}
    volumes = [noise(1, 6, 8, 9, seed=1), noise(1, 9, 10, 12, seed=2)]
    batch, weights = pad_images(volumes)
    operator = nonlocal_operator(batch, weights=weights, **options)
    for number, volume in enumerate(volumes):
        passed = options | {"landmarks": operator.landmarks[number : number + 1]}
        alone = nonlocal_operator(volume[None], **passed) @ volume[None]
        inside = tuple(map(slice, volume.shape[1:]))
        torch.testing.assert_close((operator @ batch)[(number, slice(None), *inside)], alone[0])
