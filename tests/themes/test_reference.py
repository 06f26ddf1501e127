"""Tests of the reference: each step is compared with a slower or different computation of the same number."""

import numpy as np
import pytest

from tests import reference
from tests.images import photograph

SMALL = photograph("camera", 14, 12)
H_Y = 30 / 255


@pytest.fixture(scope="module")
def w() -> np.ndarray:
    return reference.filter_matrix(SMALL, 5, H_Y)


@pytest.mark.parametrize("size", [1, 3, 5, 9])
def test_patch_weights_are_a_symmetric_window_of_unit_sum(size: int) -> None:
    window = reference.patch_weights(size)
    assert window.shape == (size, size)
    assert window.sum() == pytest.approx(1)
    np.testing.assert_array_equal(window, window[::-1])
    np.testing.assert_array_equal(window, window.T)
    assert window.argmax() == size * size // 2


def test_kernel_is_eq_1_written_out() -> None:
    h_x, height, width = 4.0, *SMALL.shape
    x = reference.features(SMALL, 3, H_Y, h_x)
    kernel = reference.affinity(x, x)
    window = reference.patch_weights(3)
    padded = np.pad(SMALL, 1, mode="reflect")
    for i, j in ((0, 1), (5, 100), (13, 13), (30, 167)):
        (a, b), (c, d) = divmod(i, width), divmod(j, width)
        photometric = (window * (padded[a : a + 3, b : b + 3] - padded[c : c + 3, d : d + 3]) ** 2).sum()
        spatial = (a - c) ** 2 + (b - d) ** 2
        assert kernel[i, j] == pytest.approx(np.exp(-spatial / h_x**2 - photometric / H_Y**2), rel=1e-10)
    assert kernel.shape == (height * width, height * width)


def test_borders_are_reflected_or_replicated_where_too_short() -> None:
    row = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(reference.pad(row, 2)[0], [3, 2, 1, 2, 3, 2, 1])
    np.testing.assert_array_equal(reference.pad(row, 3)[0], [1, 1, 1, 1, 2, 3, 3, 3, 3])
    assert (reference.pad(row, 2) == reference.pad(row, 2)[0]).all()


def test_filter_is_symmetric_doubly_stochastic_and_positive(w: np.ndarray) -> None:
    np.testing.assert_allclose(w, w.T, atol=1e-15)
    np.testing.assert_allclose(w.sum(0), 1, atol=1e-12)
    assert w.min() >= 0
    assert np.linalg.eigvalsh(w).min() > -1e-12


def test_balanced_filter_is_close_to_the_row_normalised_one() -> None:
    x = reference.features(SMALL, 5, 1.0)  # one division nearly balances a wide kernel
    kernel = reference.affinity(x, x)
    np.testing.assert_allclose(reference.balanced(kernel), reference.row_normalised(kernel), rtol=0.3)


def test_eigenpairs_rebuild_the_filter(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    np.testing.assert_allclose(v @ np.diag(s) @ v.T, w, atol=1e-12)
    assert s[0] == pytest.approx(1)
    np.testing.assert_allclose(np.abs(v[:, 0]), len(v) ** -0.5, rtol=1e-10)
    assert (np.diff(s) <= 0).all()


def test_truncation_is_the_best_of_its_rank(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    s_m, v_m = reference.truncated(s, v, 10)
    assert np.linalg.norm(w - (v_m * s_m) @ v_m.T, 2) == pytest.approx(s[10], rel=1e-8)


def test_papers_method_with_every_pixel_sampled_is_the_dense_filter(w: np.ndarray) -> None:
    x = reference.features(SMALL, 5, H_Y)
    s, v = reference.nystrom_eigenpairs(x, np.arange(len(x)))
    np.testing.assert_allclose((v * s) @ v.T, w, atol=1e-4)  # only eigenvalues below its tolerance are missing


def test_papers_method_gives_orthonormal_vectors_and_unit_row_sums() -> None:
    x = reference.features(SMALL, 5, 60 / 255)
    s, v = reference.nystrom_eigenpairs(x, reference.uniform_samples(*SMALL.shape, 60))
    np.testing.assert_allclose(v.T @ v, np.eye(len(s)), atol=1e-8)
    np.testing.assert_allclose(v @ (s * v.sum(axis=0)), 1, atol=1e-4)


@pytest.mark.parametrize(("height", "width", "m"), [(72, 72, 100), (8, 8, 10), (1, 64, 20), (40, 48, 99)])
def test_uniform_samples_are_distinct_and_spread(height: int, width: int, m: int) -> None:
    samples = reference.uniform_samples(height, width, m)
    assert len(np.unique(samples)) == m
    assert samples.min() >= 0
    assert samples.max() < height * width
    centre = np.array([(samples // width).mean() + 0.5, (samples % width).mean() + 0.5])
    np.testing.assert_allclose(centre / [height, width], 0.5, atol=0.1)


def test_layers_sum_to_the_image_and_weighted_ones_are_eq_13(w: np.ndarray) -> None:
    y, alpha = SMALL.ravel(), np.array([3.0, 0.5, 4.0, 1.05])
    assert reference.layers(w, y, 3).shape == (4, len(y))
    np.testing.assert_allclose(reference.layers(w, y, 3).sum(0), y, atol=1e-14)
    s, v = reference.eigenpairs(w)
    np.testing.assert_allclose(reference.edited(w, y, alpha), reference.polynomial_filter(s, v, y, alpha), atol=1e-11)


def test_response_has_the_ends_and_the_low_pass_of_the_paper() -> None:
    s = np.linspace(0, 1, 11)
    f = reference.response(s, np.array([3.0, 2.0, 5.0, 1.5]))
    assert f[0] == 3.0
    assert f[-1] == pytest.approx(1.5)
    np.testing.assert_allclose(reference.response(s, np.array([0.0, 1.0, 1.0, 1.0])), s, atol=1e-15)


def test_diffusion_distance_is_eq_16_written_out(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    psi = reference.diffusion_map(s, v, 1.5)
    expected = sum(s[k] ** 3 * (v[3, k] - v[77, k]) ** 2 for k in range(1, len(s))) * len(s)
    assert reference.diffusion_distance(psi, psi[77])[3] == pytest.approx(expected)


def test_diffusion_mask_is_one_at_its_own_pixel_and_grows_with_time(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    region = np.zeros(len(s))
    region[40] = 1
    early, late = (reference.diffusion_mask(s, v, region, time, 4.0) for time in (0.5, 3.0))
    assert early[40] == late[40] == 1
    assert (late >= early).all()
    assert early.min() < 0.5


def test_segment_mask_parts_the_pixels(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    regions = np.zeros((2, len(s)))
    regions[0, SMALL.argmin()] = regions[1, SMALL.argmax()] = 1
    masks = reference.segment_mask(s, v, regions, 1.0)
    np.testing.assert_array_equal(masks.sum(0), 1)
    assert masks[0, SMALL.argmin()] == masks[1, SMALL.argmax()] == 1


def test_captured_energy_and_relative_rmse_say_the_same(w: np.ndarray) -> None:
    s, v = reference.eigenpairs(w)
    _, v = reference.truncated(s, v, 12)
    beta, missed = reference.captured_energy(v, SMALL.ravel()), reference.relative_rmse(v, SMALL.ravel())
    assert 0.9 < beta < 1
    assert missed == pytest.approx(100 * np.sqrt(1 - beta))
