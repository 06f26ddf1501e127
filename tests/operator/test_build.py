"""Operators of weighted points, compared with those of the pixels that the points represent, and of guides."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NonlocalOperator,
    captured_energy,
    detail_layers,
    diffusion_map,
    diffusion_mask,
    fit_alpha,
    fit_filter,
    nonlocal_operator,
    operator_from_features,
    polynomial_filter,
    propagate_strokes,
    spectral_filter,
)
from tests import reference
from tests.pairwise import each_value
from tests.problems import SAMPLINGS, build, noise, picture, seeded

COPIES = 4
ALPHA = (3.0, 0.5, 2.0, 1.05)
FLOATS = (torch.float32, torch.float64)


def features_of(image: Tensor) -> Tensor:
    """Features (1, 9, N) of an image, as an operator computes them."""
    operator = nonlocal_operator(image, patch_size=3, photometric_bandwidth=0.2, num_landmarks=2)
    return operator.kernel.recipe(image)


def pair(dtype: torch.dtype, **options: Any) -> tuple[Tensor, NonlocalOperator, NonlocalOperator]:
    """An image of 4,096 pixels, the operator of its points with weight 4, and that of the 16,384 pixels."""
    image = picture("camera", 64, 64, dtype)
    features = features_of(image)
    options = {"num_landmarks": 40, "generator": None, **options}
    points = operator_from_features(features, size=(64, 64), weights=features.new_full((4096,), COPIES), **options)
    pixels = operator_from_features(features.repeat_interleave(COPIES, dim=2), size=(64, 256), **options)
    return image, points, pixels


def repeated(image: Tensor) -> Tensor:
    return image.repeat_interleave(COPIES, dim=3)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize(("dtype", "precision"), [(torch.float32, 1e-4), (torch.float64, 1e-9)])
def test_points_of_weight_four_are_the_pixels_they_stand_for(
    dtype: torch.dtype, precision: float, completion: str
) -> None:
    image, points, pixels = pair(dtype, completion=completion, tolerance=1e-7 if dtype == torch.float32 else None)

    def assert_same(result: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(repeated(result), expected, atol=precision, rtol=0)

    torch.testing.assert_close(points.kernel.landmarks, pixels.kernel.landmarks, atol=1e-5, rtol=0)
    assert_same(points @ image, pixels @ repeated(image))
    assert_same(points.row_sums(), torch.ones(1, 1, 64, 256, dtype=dtype))
    assert_same(points.diagonal_share, pixels.diagonal_share)
    alpha = torch.tensor(ALPHA, dtype=dtype)
    filtered = polynomial_filter(points, image, alpha, residual=0.5)
    assert_same(filtered, polynomial_filter(pixels, repeated(image), alpha, residual=0.5))
    spectra = points.spectrum(), pixels.spectrum()
    ranks = min(spectrum.eigenvalues.shape[1] for spectrum in spectra)
    values = [spectrum.eigenvalues[:, :ranks] for spectrum in spectra]
    torch.testing.assert_close(values[0], values[1], atol=precision, rtol=0)
    responses = [spectral_filter(s, y, torch.sqrt) for s, y in zip(spectra, (image, repeated(image)), strict=True)]
    assert_same(*responses)
    energies = [captured_energy(s, y) for s, y in zip(spectra, (image, repeated(image)), strict=True)]
    torch.testing.assert_close(*energies, atol=precision, rtol=0)
    region = torch.zeros_like(image)
    region[..., 10:20, 10:20] = 1
    assert_same(diffusion_mask(spectra[0], region), diffusion_mask(spectra[1], repeated(region)))
    fits = [fit_filter(w, y).moments for w, y in ((points, image), (pixels, repeated(image)))]
    torch.testing.assert_close(*fits, atol=1e-2, rtol=precision)


@pytest.mark.parametrize("dtype", FLOATS)
def test_what_a_weighted_operator_reports_is_true_of_the_pixels(dtype: torch.dtype) -> None:
    _, points, pixels = pair(dtype)
    result, expected = points.diagnostics(), pixels.diagnostics()
    assert result.pixels == expected.pixels == 16384
    assert result.rank == expected.rank
    for name in ("smallest_row_sum", "largest_eigenvalue", "diagonal_share"):
        torch.testing.assert_close(getattr(result, name), getattr(expected, name), atol=1e-3, rtol=1e-4)
    assert max(result.orthogonality) < 1e-3
    assert max(result.eigenvector_residual) < max(expected.eigenvector_residual) + 1e-4
    assert max(points.certify().symmetry) < 1e-5


def test_gradients_of_weighted_points_are_those_of_the_pixels() -> None:
    image, weights = picture("coffee", 12, 12), noise(1, 1, 12, 12, seed=2)
    gradients = []
    for copies in (1, COPIES):
        features = features_of(image).detach().requires_grad_()
        counts = None if copies > 1 else torch.full((144,), float(COPIES), dtype=torch.float64)
        operator = operator_from_features(
            features.repeat_interleave(copies, dim=2), size=(12, 12 * copies), weights=counts, num_landmarks=10
        )
        filtered = polynomial_filter(operator, repeated(image) if copies > 1 else image, torch.tensor(ALPHA).double())
        by = repeated(weights) / COPIES if copies > 1 else weights
        gradients.append(torch.autograd.grad((by * filtered).sum(), features)[0])
    torch.testing.assert_close(*gradients, atol=1e-8, rtol=1e-6)


def test_gradcheck_with_weights() -> None:
    weights = noise(2, 12, seed=4) * 5 + 0.5
    image, by = noise(2, 1, 3, 4, seed=1), noise(2, 1, 3, 4, seed=2)

    def loss(features: Tensor) -> Tensor:
        options = {"num_landmarks": 5, "landmarks": "uniform"}
        operator = operator_from_features(features, size=(3, 4), weights=weights, **options)
        filtered = polynomial_filter(operator, image, torch.tensor(ALPHA).double())
        energy = captured_energy(operator.spectrum(), image)
        return (by * filtered).sum() + energy.sum() + operator.spectrum().eigenvalues[:, 1:4].sum()

    features = (noise(2, 3, 12) * 2).requires_grad_()
    assert torch.autograd.gradcheck(loss, (features,), eps=1e-6, atol=1e-6)


def test_points_may_stand_for_less_than_a_pixel() -> None:
    features, image = noise(1, 3, 60, seed=1), noise(1, 1, 6, 10, seed=2)
    few, many = (
        operator_from_features(features, size=(6, 10), weights=torch.full((60,), weight), num_landmarks=20)
        for weight in (1e-3, 1.0)
    )
    torch.testing.assert_close(few.row_sums(), many.row_sums(), atol=1e-6, rtol=0)
    assert (few @ image).isfinite().all()


@pytest.mark.parametrize(("dtype", "weight"), each_value(FLOATS, [1 / 150, 0.1, 0.5]))
def test_small_weights_give_the_dense_operator(dtype: torch.dtype, weight: float) -> None:
    features, image = noise(1, 2, 150, seed=1) / 0.2, noise(1, 1, 1, 150, seed=2)
    weights = weight * (0.5 + noise(1, 150, seed=3))
    operator = operator_from_features(
        features.to(dtype), size=(150,), weights=weights.to(dtype), num_landmarks=150, completion="diagonal"
    )
    kernel = torch.exp(-(features[0].T[:, None] - features[0].T).square().sum(2))
    scaling = torch.ones(150, dtype=torch.float64)
    for _ in range(200):
        scaling = (scaling / (kernel @ (weights[0] * scaling))).sqrt()
    expected = scaling * (kernel @ (weights[0] * scaling * image.flatten()))
    torch.testing.assert_close((operator @ image.to(dtype)).flatten().double(), expected, atol=1e-3, rtol=0)
    columns = operator.at(features.to(dtype))
    torch.testing.assert_close(columns.scaling, operator.scaling, atol=1e-4, rtol=1e-4)


def test_evaluation_leaves_autocast() -> None:
    features, points = noise(1, 3, 60, seed=1).float(), noise(1, 3, 40, seed=2).float()
    operator = operator_from_features(features.requires_grad_(), size=(60,), num_landmarks=20)
    expected = operator.at(points)
    with torch.autocast("cpu", torch.bfloat16):
        result = operator.at(points)
    assert torch.equal(result.factor, expected.factor)
    assert torch.equal(result.scaling, expected.scaling)


def test_arguments_may_be_changed_after_building() -> None:
    image, bandwidth = noise(1, 1, 12, 12).float(), torch.tensor(0.2)
    fitted = fit_filter(nonlocal_operator(image, photometric_bandwidth=bandwidth, num_landmarks=20), image)
    layers = fitted.layers(image)
    bandwidth.mul_(3)
    assert torch.equal(fitted.layers(image), layers)
    features, weights = noise(1, 2, 50, seed=1), noise(1, 50, seed=2) + 0.5
    operator = operator_from_features(features, size=(50,), weights=weights, num_landmarks=50)
    points = noise(1, 2, 5, seed=3)
    factor = operator.at(points).factor
    features.add_(1)
    weights.mul_(2)
    assert torch.equal(operator.at(points).factor, factor)
    assert (operator.row_sums() - 1).abs().max() <= 1e-9


@pytest.mark.parametrize("spatial", [None, 9.0])
def test_a_guide_is_its_features(spatial: float | None) -> None:
    """Bit for bit: there is one assembly."""
    image = picture("camera", 40, 50, torch.float32)
    options = {"num_landmarks": 30}
    operator = nonlocal_operator(image, photometric_bandwidth=0.1, spatial_bandwidth=spatial, **options)
    # Points have no orientation, so that their landmarks would be others.
    points = operator_from_features(operator.kernel.recipe(image), size=(40, 50), landmarks=operator, **options)
    for name in ("factor", "diagonal", "scaling", "remainder", "residual"):
        assert torch.equal(getattr(points, name), getattr(operator, name))


def test_voxels_of_a_volume_are_filtered_as_by_the_dense_filter() -> None:
    volume = noise(1, 1, 5, 6, 7)
    places = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in (5, 6, 7)), indexing="ij")).flatten(1)
    features = torch.cat([volume.flatten(2) / 0.2, places[None] / 2], dim=1)
    operator = operator_from_features(features, size=(5, 42), num_landmarks=210)
    exact = reference.balanced(reference.affinity(features[0].mT.numpy(), features[0].mT.numpy()))
    torch.testing.assert_close(operator.to_dense()[0], torch.from_numpy(exact), atol=1e-4, rtol=0)


def test_an_operator_of_features_has_no_guide() -> None:
    operator = operator_from_features(noise(1, 2, 12), size=(3, 4), num_landmarks=4)
    layers = detail_layers(operator, noise(1, 1, 3, 4))
    assert layers.shape == (1, 4, 1, 3, 4)
    with pytest.raises(ValueError, match=r"operator must be built by nonlocal_operator .* use operator.at\(features\)"):
        fit_filter(operator, noise(1, 1, 3, 4)).layers(noise(1, 1, 3, 4))
    assert operator.diagnostics().photometric_bandwidth == [1.0]


def test_points_in_no_order_are_one_row() -> None:
    operator = operator_from_features(noise(1, 3, 12), size=(12,), num_landmarks=4)
    assert operator.size == (1, 12)
    assert operator.row_sums().shape == (1, 1, 1, 12)


def weighted_points() -> tuple[torch.Tensor, torch.Tensor]:
    """Features (1, 3, 60) and two rows of weights with different totals."""
    points = torch.rand(1, 3, 60, generator=seeded(0), dtype=torch.float64) / 0.3
    weights = torch.stack([torch.ones(60), 1 + 7 * torch.rand(60, generator=seeded(1))]).double()
    return points, weights


def test_images_of_a_batch_have_totals_of_their_own() -> None:
    points, weights = weighted_points()
    both = operator_from_features(points.expand(2, -1, -1), size=(6, 10), weights=weights, num_landmarks=60)
    alone = operator_from_features(points, size=(6, 10), weights=weights[1:], num_landmarks=60)
    region = torch.zeros(1, 1, 6, 10)
    region[..., :2, :2] = 1
    strokes, painted = torch.rand(1, 2, 6, 10, generator=seeded(2)), region
    for compute in (
        lambda spectrum: diffusion_mask(spectrum, region),
        lambda spectrum: diffusion_map(spectrum, time=1.0).abs(),
        lambda spectrum: propagate_strokes(spectrum, strokes, painted),
    ):
        torch.testing.assert_close(compute(both.spectrum())[1:], compute(alone.spectrum()), rtol=0, atol=1e-6)
    result, wanted = both.diagnostics(), alone.diagnostics()
    assert result.diagonal_share[1:] == pytest.approx(wanted.diagonal_share)
    assert wanted.pixels == round(float(weights[1].sum()))


def test_captured_energy_and_sliders_count_the_pixels_that_points_represent() -> None:
    points, weights = weighted_points()
    counts = weights[1].round().long()
    repeated = points.repeat_interleave(counts, dim=2)
    image = torch.rand(1, 1, 1, 60, generator=seeded(3), dtype=torch.float64)
    whole = image.repeat_interleave(counts, dim=3)
    few = operator_from_features(points, size=(60,), weights=counts[None].double(), num_landmarks=60)
    landmarks = {"landmarks": "random", "num_landmarks": 60}
    many = operator_from_features(repeated, size=(len(repeated[0, 0]),), **landmarks)
    spectrum = operator_from_features(points, size=(60,), weights=counts[None].double(), num_landmarks=10).spectrum()
    vectors = spectrum.eigenvectors.flatten(2)[0]
    wanted = (vectors * counts * image.flatten()).sum(1).square().sum() / (counts * image.flatten().square()).sum()
    assert float(captured_energy(spectrum, image)) == pytest.approx(float(wanted), rel=1e-6)

    generator = seeded(4)
    target = image + 0.1 * torch.randn(image.shape, generator=generator, dtype=torch.float64)
    target_of_all = target.repeat_interleave(counts, dim=3)
    result = fit_alpha(few, image, target, order=2)
    torch.testing.assert_close(result, fit_alpha(many, whole, target_of_all, order=2), rtol=0.02, atol=0.02)


@pytest.mark.parametrize("landmarks", SAMPLINGS)
def test_a_generator_decides_and_none_means_always_the_same(landmarks: str) -> None:
    guide = noise(1, 1, 20, 20)

    def factor(generator: torch.Generator | None) -> torch.Tensor:
        return nonlocal_operator(guide, num_landmarks=30, landmarks=landmarks, generator=generator).factor

    assert torch.equal(factor(seeded(3)), factor(seeded(3)))
    assert torch.equal(factor(None), factor(None))
    assert landmarks == "uniform" or not torch.equal(factor(seeded(3)), factor(seeded(4)))


@pytest.mark.parametrize("landmarks", SAMPLINGS)
def test_the_global_random_state_is_left_alone(landmarks: str) -> None:
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    operator = nonlocal_operator(noise(1, 3, 20, 20), num_landmarks=30, landmarks=landmarks)
    operator.spectrum()
    operator.diagnostics()
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


def test_arguments_are_not_written_to() -> None:
    guide, image = noise(1, 1, 12, 13), noise(1, 3, 12, 13)
    guide_before, image_before = guide.clone(), image.clone()
    operator = build(guide, num_landmarks=30)
    _ = operator @ image
    operator.spectrum()
    assert torch.equal(guide, guide_before)
    assert torch.equal(image, image_before)


def test_custom_patch_weights_are_scaled_to_unit_sum() -> None:
    guide = noise(1, 1, 12, 13)
    box = torch.ones(3, 3, dtype=torch.float64)
    matrix, other = (build(guide, patch_weights=w, num_landmarks=156).to_dense() for w in (box, 7 * box))
    torch.testing.assert_close(matrix, other)
    only_centre = torch.zeros(3, 3, dtype=torch.float64)
    only_centre[1, 1] = 1
    torch.testing.assert_close(
        build(guide, patch_weights=only_centre, num_landmarks=156).to_dense(),
        build(guide, patch_size=1, num_landmarks=156).to_dense(),
    )


@pytest.mark.parametrize("bandwidth", ["photometric_bandwidth", "spatial_bandwidth"])
def test_bandwidths_may_be_tensors_one_per_image(bandwidth: str) -> None:
    guide = noise(2, 1, 8, 9)
    values = torch.tensor([0.3, 2.0], dtype=torch.float64)
    together = build(guide, num_landmarks=72, **{bandwidth: values}).to_dense()
    for i in range(2):
        alone = build(guide[i : i + 1], num_landmarks=72, **{bandwidth: values[i].item()}).to_dense()
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (1, 9), (9, 1), (2, 2), (3, 4)])
def test_images_smaller_than_the_patch(size: tuple[int, int]) -> None:
    for patch_size in [1, 5, 11]:
        guide = noise(1, 1, *size)
        operator = build(guide, patch_size=patch_size, photometric_bandwidth=0.2)
        expected = reference.filter_matrix(guide[0].numpy(), patch_size, 0.2)
        np.testing.assert_allclose(operator.to_dense()[0], expected, atol=1e-4)
        assert operator.spectrum().eigenvalues[0, 0].item() == pytest.approx(1, abs=1e-6)
