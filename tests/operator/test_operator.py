"""The operator: against the dense filter, and invariants for every image."""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import accuracy
from nlfilter_torch import nonlocal_operator
from tests import reference
from tests.images import photograph
from tests.pairwise import each_value, pairwise
from tests.problems import SAMPLINGS, build, guides, noise, options, picture

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


# --- against the dense filter


@pytest.mark.parametrize(("bandwidth", "name"), each_value(list(accuracy.LIMITS), accuracy.PICTURES))
def test_filtered_photographs_are_near_the_dense_filter(name: str, bandwidth: int) -> None:
    errors = accuracy.measure(name, bandwidth)
    print(errors)
    assert errors.default <= accuracy.LIMITS[bandwidth]
    assert errors.default <= errors.paper / 2
    assert errors.default <= errors.plain / 2


@pytest.mark.parametrize(
    ("h_x", "bandwidth", "completion"), pairwise([None, 6.0], [5, 10, 20, 40], ["diagonal", "none"])
)
def test_with_every_pixel_a_landmark_it_is_the_dense_filter(bandwidth: int, completion: str, h_x: float | None) -> None:
    image = photograph("astronaut", 24, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None],
        photometric_bandwidth=bandwidth / 255,
        spatial_bandwidth=h_x,
        num_landmarks=image.size,
        completion=completion,
    )
    expected = reference.filter_matrix(image, 5, bandwidth / 255, h_x)
    np.testing.assert_allclose(operator.to_dense()[0], expected, atol=1e-4)
    y = photograph("coffee", 24, 24)
    filtered = operator @ torch.from_numpy(y.copy())[None, None]
    np.testing.assert_allclose(filtered.ravel(), expected @ y.ravel(), atol=1e-4)


def test_with_every_pixel_a_landmark_it_is_the_dense_filter_in_single_precision() -> None:
    image = photograph("astronaut", 24, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy()).float()[None, None], photometric_bandwidth=20 / 255, num_landmarks=image.size
    )
    expected = reference.filter_matrix(photograph("astronaut", 24, 24), 5, 20 / 255)
    np.testing.assert_allclose(operator.to_dense()[0], expected, atol=1e-4)


def test_colour_guide_against_the_dense_filter() -> None:
    guide = np.stack([photograph(name, 20, 22) for name in ("astronaut", "coffee", "chelsea")])
    operator = nonlocal_operator(
        torch.from_numpy(guide)[None], photometric_bandwidth=0.2, num_landmarks=440, guide_channels="all", patch_size=3
    )
    np.testing.assert_allclose(operator.to_dense()[0], reference.filter_matrix(guide, 3, 0.2), atol=1e-4)


@pytest.mark.parametrize("bandwidth", [20, 60])
def test_plain_uniform_is_the_papers_method(bandwidth: int) -> None:
    image, h_y = photograph("chelsea", 30, 40), bandwidth / 255
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None],
        photometric_bandwidth=h_y,
        num_landmarks=50,
        landmarks="uniform",
        completion="none",
    )
    s, v = reference.nystrom_eigenpairs(reference.features(image, 5, h_y), reference.uniform_samples(30, 40, 50))
    filtered = (operator @ torch.from_numpy(image.copy())[None, None]).ravel()
    # The library's jitter and the paper's cut of small eigenvalues cause a difference of up to a grey level.
    np.testing.assert_allclose(filtered, reference.spectral_function(s, v, s, image.ravel()), atol=1 / 255)


# --- invariants for every image


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(guide=guides(), chosen=options)
def test_operator_is_symmetric_stochastic_and_a_contraction(
    guide: torch.Tensor, chosen: dict[str, object], dtype: torch.dtype
) -> None:
    operator = build(guide.to(dtype), **chosen)
    dense = operator.to_dense()
    batch, _, height, width = guide.shape
    assert dense.shape == (batch, height * width, height * width)
    assert dense.isfinite().all()
    torch.testing.assert_close(dense, dense.mT, atol=1e-6, rtol=0)
    torch.testing.assert_close(operator.row_sums(), torch.ones(batch, 1, height, width, dtype=dtype), atol=1e-4, rtol=0)
    eigenvalues = torch.linalg.eigvalsh(dense.double())
    assert eigenvalues.min() >= -1e-5
    assert eigenvalues.max() <= 1.0001


@given(seed=st.integers(0, 99), order=st.permutations(list(range(30))))
def test_shuffled_pixels_give_a_shuffled_operator(seed: int, order: list[int]) -> None:
    """Without patches and coordinates an image is a set of pixels."""
    guide = noise(1, 2, 5, 6, seed=seed)
    shuffled = guide.flatten(2)[:, :, order].unflatten(2, (5, 6))
    kwargs = {"patch_size": 1, "photometric_bandwidth": 0.3, "num_landmarks": 30}
    dense, other = build(guide, **kwargs).to_dense(), build(shuffled, **kwargs).to_dense()
    torch.testing.assert_close(other, dense[:, order][:, :, order], atol=1e-5, rtol=0)


@pytest.mark.parametrize("dimensions", [(-1,), (-2,), (-1, -2)])
@given(seed=st.integers(0, 99), height=st.integers(1, 7), width=st.integers(1, 7), h_x=st.sampled_from([None, 2.0]))
def test_a_flipped_guide_gives_a_flipped_filter(
    seed: int, height: int, width: int, h_x: float | None, dimensions: tuple[int, ...]
) -> None:
    guide, image = noise(1, 1, height, width, seed=seed), noise(1, 2, height, width, seed=seed + 100)
    kwargs = {"num_landmarks": height * width, "photometric_bandwidth": 0.3, "spatial_bandwidth": h_x}
    straight = build(guide, **kwargs) @ image
    flipped = build(guide.flip(dimensions), **kwargs) @ image.flip(dimensions)
    torch.testing.assert_close(flipped.flip(dimensions), straight, atol=1e-5, rtol=0)


@given(seed=st.integers(0, 99), height=st.integers(1, 7), width=st.integers(1, 7), h_x=st.sampled_from([None, 2.0]))
def test_a_transposed_guide_gives_a_transposed_filter(seed: int, height: int, width: int, h_x: float | None) -> None:
    guide, image = noise(1, 1, height, width, seed=seed), noise(1, 2, height, width, seed=seed + 100)
    kwargs = {"num_landmarks": height * width, "photometric_bandwidth": 0.3, "spatial_bandwidth": h_x}
    straight, turned = build(guide, **kwargs) @ image, build(guide.mT, **kwargs) @ image.mT
    torch.testing.assert_close(turned.mT, straight, atol=1e-5, rtol=0)


@pytest.mark.parametrize("landmarks", SAMPLINGS)
@given(offset=st.sampled_from([-0.25, 0.5, 64.0]), scale=st.sampled_from([0.25, 8.0]))
def test_only_differences_in_units_of_the_bandwidth_count(landmarks: str, offset: float, scale: float) -> None:
    guide = (noise(1, 2, 9, 8) * 4096).round() / 4096  # exact under these offsets and scales
    kwargs = {"num_landmarks": 20, "landmarks": landmarks}
    dense = build(guide, photometric_bandwidth=0.2, **kwargs).to_dense()
    other = build(guide * scale + offset, photometric_bandwidth=0.2 * scale, **kwargs).to_dense()
    torch.testing.assert_close(other, dense, atol=1e-6, rtol=0)


@pytest.mark.parametrize("landmarks", SAMPLINGS)
def test_the_order_of_the_channels_does_not_count(landmarks: str) -> None:
    guide = noise(1, 3, 9, 8)
    kwargs = {"num_landmarks": 20, "landmarks": landmarks, "guide_channels": "all", "photometric_bandwidth": 0.2}
    dense, other = build(guide, **kwargs).to_dense(), build(guide[:, [2, 0, 1]], **kwargs).to_dense()
    torch.testing.assert_close(other, dense, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("completion", "landmarks", "dtype"), pairwise(["diagonal", "none"], SAMPLINGS, [torch.float32, torch.float64])
)
def test_a_batch_gives_what_single_calls_give(landmarks: str, completion: str, dtype: torch.dtype) -> None:
    guide = torch.cat([picture(name, 40, 48, dtype) for name in ("astronaut", "camera", "moon")])
    image = noise(3, 2, 40, 48, dtype=dtype)
    kwargs = {"num_landmarks": 60, "landmarks": landmarks, "completion": completion, "photometric_bandwidth": 0.5}
    together = build(guide, **kwargs) @ image
    alone = torch.cat([build(guide[i : i + 1], **kwargs) @ image[i : i + 1] for i in range(3)])
    torch.testing.assert_close(together, alone, atol=2e-5 if dtype == torch.float32 else 1e-10, rtol=0)


def test_a_batch_estimates_what_single_calls_estimate() -> None:
    guide = torch.cat([picture(name, 40, 48) for name in ("astronaut", "moon")])
    operator = build(guide)
    alone = [build(guide[i : i + 1]) for i in range(2)]
    together = operator.diagnostics().photometric_bandwidth
    assert together == pytest.approx([o.diagnostics().photometric_bandwidth[0] for o in alone])
    torch.testing.assert_close(operator.row_sums(), torch.cat([o.row_sums() for o in alone]), atol=1e-9, rtol=0)


@pytest.mark.parametrize("guide_dtype", FLOATS)
def test_images_keep_their_dtype(guide_dtype: torch.dtype) -> None:
    for dtype in FLOATS:
        operator = build(noise(1, 1, 8, 9, dtype=guide_dtype), num_landmarks=20)
        assert operator.factor.dtype == (torch.float64 if guide_dtype == torch.float64 else torch.float32)
        image = noise(1, 3, 8, 9, dtype=dtype)
        filtered = operator @ image
        assert filtered.dtype == dtype
        exact = build(noise(1, 1, 8, 9, dtype=guide_dtype).double(), num_landmarks=20) @ image.double()
        tolerance = 2 * torch.finfo(dtype).eps if dtype.itemsize == 2 else 1e-4
        torch.testing.assert_close(filtered.double(), exact, atol=tolerance, rtol=0)


def test_autocast_changes_nothing() -> None:
    guide, image = noise(1, 1, 12, 13, dtype=torch.float32), noise(1, 3, 12, 13, dtype=torch.float32)
    plain = build(guide, num_landmarks=30) @ image
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = build(guide, num_landmarks=30) @ image
    torch.testing.assert_close(inside, plain, atol=0, rtol=0)


def test_strides_do_not_matter() -> None:
    guide, image = noise(1, 2, 12, 13), noise(1, 3, 12, 13)
    plain = build(guide, num_landmarks=30) @ image

    def strided(x: torch.Tensor) -> torch.Tensor:
        y = x.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0)
        assert not y.is_contiguous()
        return y

    torch.testing.assert_close(build(strided(guide), num_landmarks=30) @ strided(image), plain, atol=1e-12, rtol=0)
    channels_last = image.contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(build(guide, num_landmarks=30) @ channels_last, plain, atol=1e-12, rtol=0)
    wide = noise(1, 2, 12, 26)
    torch.testing.assert_close(
        build(wide[..., ::2], num_landmarks=30).to_dense(), build(wide[..., ::2].clone(), num_landmarks=30).to_dense()
    )


def test_a_wide_kernel_averages_and_a_narrow_one_leaves_alone() -> None:
    image = noise(1, 1, 12, 13)
    averaged = build(image, photometric_bandwidth=1e4, num_landmarks=20) @ image
    torch.testing.assert_close(averaged, image.mean().expand_as(image), atol=1e-3, rtol=0)
    untouched = build(image, photometric_bandwidth=1e-4, num_landmarks=20) @ image
    torch.testing.assert_close(untouched, image, atol=1e-4, rtol=0)


def test_completion_does_not_depend_on_the_size_of_a_block() -> None:
    guide = picture("camera", 100, 90)  # three blocks of pixels
    whole, part = build(guide, num_landmarks=40), build(guide[..., :50, :], num_landmarks=40)
    for operator in (whole, part):
        norms = operator.factor.square().sum(1) + operator.diagonal
        torch.testing.assert_close(norms, torch.ones_like(norms), atol=1e-9, rtol=0)


# --- diagnostics and warnings


def test_diagnostics_are_measured() -> None:
    guide = picture("chelsea", 30, 40)
    operator = build(guide, num_landmarks=50, photometric_bandwidth=20 / 255)
    figures = operator.diagnostics()
    w = operator.to_dense()
    assert figures.pixels == 1200
    assert figures.num_landmarks == 50
    assert figures.photometric_bandwidth == [pytest.approx(20 / 255)]
    assert figures.row_sum_residual == [pytest.approx((w.sum(2) - 1).abs().max().item(), abs=1e-10)]
    assert figures.diagonal_share[0] == pytest.approx((operator.scaling**2 * operator.diagonal).mean().item())
    spectrum = operator.spectrum()
    v = spectrum.eigenvectors.flatten(2)
    assert figures.rank == [v.shape[1]]
    residual = (v @ w - spectrum.eigenvalues.unsqueeze(2) * v).norm(dim=2).max().item()
    assert figures.eigenvector_residual == [pytest.approx(residual, abs=1e-8)]
    gram = v @ v.mT - torch.eye(v.shape[1], dtype=torch.float64)
    assert figures.orthogonality == [pytest.approx(gram.abs().max().item(), abs=1e-8)]
    numbers = [0, 16, 33, len(v[0]) - 1]  # evenly spread
    few = operator.diagnostics(4, spectrum)
    residual = (v @ w - spectrum.eigenvalues.unsqueeze(2) * v)[:, numbers].norm(dim=2).max().item()
    assert few.eigenvector_residual == [pytest.approx(residual, abs=1e-8)]
    assert few.rank == figures.rank
    assert operator.diagnostics(1000).eigenvector_residual == pytest.approx(figures.eigenvector_residual)
    with pytest.raises(ValueError, match="eigenvectors must be at least 1"):
        operator.diagnostics(0)
    with pytest.raises(TypeError, match="spectrum must be"):
        operator.diagnostics(4, spectrum.eigenvalues)  # type: ignore[arg-type]


def test_diagnostics_tell_where_the_plain_method_breaks() -> None:
    guide = picture("astronaut", 72, 72, torch.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plain = build(guide, photometric_bandwidth=5 / 255, landmarks="uniform", completion="none").diagnostics()
    completed = build(guide, photometric_bandwidth=5 / 255).diagnostics()
    print(plain, completed)
    assert plain.smallest_row_sum[0] < 0.1
    assert completed.smallest_row_sum[0] >= 0.5
    assert completed.row_sum_residual[0] <= 1e-4


# --- gradients


def test_backward_gives_finite_gradients_to_everything() -> None:
    guide, image = noise(2, 1, 12, 13).requires_grad_(), noise(2, 3, 12, 13, seed=1).requires_grad_()
    h_y = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    h_x = torch.tensor(5.0, dtype=torch.float64, requires_grad=True)
    operator = build(guide, photometric_bandwidth=h_y, spatial_bandwidth=h_x, num_landmarks=20)
    (operator @ image).square().sum().backward()
    for tensor in (guide, image, h_y, h_x):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert tensor.grad.abs().max() > 0
