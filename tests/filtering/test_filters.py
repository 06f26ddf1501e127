"""Sliders, layers and the response of sliders, compared with the dense reference and with each other."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch import (
    NonlocalFilter,
    Spectrum,
    compose_alpha,
    detail_layers,
    filter_regions,
    nonlocal_operator,
    polynomial_filter,
    polynomial_response,
    spectral_filter,
)
from tests import reference
from tests.images import photograph
from tests.problems import build, colour, guides, noise, options, picture

ALPHA = (3.0, 0.5, 4.0, 1.05)
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
sliders = st.lists(st.floats(-5, 20, width=32), min_size=2, max_size=6)


def double(values: object) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


# --- the response, eq. 14


@given(alpha=sliders, eigenvalues=st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_response_is_the_reference_response(alpha: list[float], eigenvalues: list[float]) -> None:
    result = polynomial_response(double(eigenvalues), double(alpha))
    np.testing.assert_allclose(result, reference.response(np.array(eigenvalues), np.array(alpha)), atol=1e-12)


@given(alpha=sliders)
def test_response_has_the_ends_of_the_paper(alpha: list[float]) -> None:
    ends = polynomial_response(torch.tensor([0.0, 1.0], dtype=torch.float64), double(alpha))
    torch.testing.assert_close(ends, double([alpha[0], alpha[-1]]), atol=0, rtol=0)


def test_response_of_ones_is_one_and_of_the_low_pass_is_the_eigenvalue() -> None:
    eigenvalues = torch.linspace(0, 1, 50)
    torch.testing.assert_close(polynomial_response(eigenvalues, torch.ones(4)), torch.ones(50))
    torch.testing.assert_close(polynomial_response(eigenvalues, torch.tensor([0.0, 1, 1, 1])), eigenvalues)


def test_response_takes_sliders_for_every_image() -> None:
    eigenvalues, alpha = noise(3, 7), noise(3, 4, seed=1)
    expected = torch.stack([polynomial_response(eigenvalues[i], alpha[i]) for i in range(3)])
    torch.testing.assert_close(polynomial_response(eigenvalues, alpha), expected)


# --- layers, eq. 11


@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_layers_are_the_reference_layers(order: int) -> None:
    image, y = photograph("astronaut", 20, 24), photograph("coffee", 20, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None], photometric_bandwidth=20 / 255, num_landmarks=480
    )
    result = detail_layers(operator, torch.from_numpy(y.copy())[None, None], order=order)
    assert result.shape == (1, order + 1, 1, 20, 24)
    expected = reference.layers(reference.filter_matrix(image, 5, 20 / 255), y.ravel(), order)
    np.testing.assert_allclose(result.flatten(2)[0, :, :], expected, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(guide=guides(), chosen=options, channels=st.integers(1, 4), order=st.integers(1, 5))
def test_layers_sum_to_the_image(
    guide: torch.Tensor, chosen: dict[str, object], channels: int, order: int, dtype: torch.dtype
) -> None:
    operator = build(guide.to(dtype), **chosen)
    image = noise(guide.shape[0], channels, *guide.shape[2:], seed=1, dtype=dtype)
    parts = detail_layers(operator, image, order=order)
    assert parts.shape == (guide.shape[0], order + 1, *image.shape[1:])
    torch.testing.assert_close(parts.sum(1), image, atol=1e-5 if dtype == torch.float32 else 1e-12, rtol=0)


def test_detail_layers_have_no_mean_and_the_smooth_one_has_it_all() -> None:
    image = picture("chelsea", 30, 40)
    parts = detail_layers(build(image, photometric_bandwidth=0.1, num_landmarks=60), image)
    torch.testing.assert_close(parts[:, :-1].mean((3, 4)), torch.zeros(1, 3, 1, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(parts[:, -1].mean((2, 3)), image.mean((2, 3)))


# --- sliders, eq. 12 and 13


@pytest.mark.parametrize("residual", [None, 0.0, 1.0])
def test_sliders_are_those_of_the_dense_paper(residual: float | None) -> None:
    """With every pixel a landmark, V is complete and the residual is zero."""
    image, y = photograph("astronaut", 20, 24), photograph("coffee", 20, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None], photometric_bandwidth=20 / 255, num_landmarks=480
    )
    result = polynomial_filter(operator, torch.from_numpy(y.copy())[None, None], double(ALPHA), residual=residual)
    w = reference.filter_matrix(image, 5, 20 / 255)
    np.testing.assert_allclose(result.ravel(), reference.edited(w, y.ravel(), np.array(ALPHA)), atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(guide=guides(), chosen=options, channels=st.integers(1, 3), order=st.integers(1, 5))
def test_ones_give_the_image_back(
    guide: torch.Tensor, chosen: dict[str, object], channels: int, order: int, dtype: torch.dtype
) -> None:
    operator = build(guide.to(dtype), **chosen)
    image = noise(guide.shape[0], channels, *guide.shape[2:], seed=1, dtype=dtype)
    for residual in (None, 1.0):
        result = polynomial_filter(operator, image, torch.ones(order + 1), residual=residual)
        torch.testing.assert_close(result, image, atol=1e-5, rtol=0)


@given(alpha=sliders)
def test_sliders_weigh_the_layers(alpha: list[float]) -> None:
    guide, image = noise(2, 1, 9, 11), noise(2, 3, 9, 11, seed=1)
    operator = build(guide, photometric_bandwidth=0.3, num_landmarks=20)
    parts = detail_layers(operator, image, order=len(alpha) - 1)
    expected = (double(alpha).view(1, -1, 1, 1, 1) * parts).sum(1)
    torch.testing.assert_close(polynomial_filter(operator, image, double(alpha)), expected, atol=1e-12, rtol=0)


def test_filter_is_linear_in_image_and_sliders() -> None:
    operator = build(noise(1, 1, 9, 11), photometric_bandwidth=0.3, num_landmarks=20)
    y, z = noise(1, 2, 9, 11, seed=1), noise(1, 2, 9, 11, seed=2)
    a, b = double(ALPHA), double([1.0, 2.0, -1.0, 0.5])
    for residual in (None, 0.0, 0.7):
        apart = polynomial_filter(operator, y, a, residual=residual) - 2 * polynomial_filter(
            operator, z, a, residual=residual
        )
        together = polynomial_filter(operator, y - 2 * z, a, residual=residual)
        torch.testing.assert_close(together, apart, atol=1e-11, rtol=0)
    torch.testing.assert_close(
        polynomial_filter(operator, y, a + b), polynomial_filter(operator, y, a) + polynomial_filter(operator, y, b)
    )


def test_without_residual_it_is_eq_13_on_the_eigenvectors() -> None:
    image = picture("camera", 24, 30)
    operator = build(image, photometric_bandwidth=0.4, completion="none", num_landmarks=50)
    spectrum = operator.spectrum()
    result = polynomial_filter(operator, image, double(ALPHA), residual=0.0)
    v = spectrum.eigenvectors.flatten(2)[0].numpy().T
    expected = reference.polynomial_filter(spectrum.eigenvalues[0].numpy(), v, image.numpy().ravel(), np.array(ALPHA))
    np.testing.assert_allclose(result.ravel(), expected, atol=1e-5)


def projected(spectrum: Spectrum, image: torch.Tensor) -> torch.Tensor:
    return spectral_filter(spectrum, image, torch.ones_like, residual=0.0)


@pytest.mark.parametrize("completion", ["diagonal", "none"])
def test_residual_is_the_weight_of_what_the_eigenvectors_miss(completion: str) -> None:
    image = picture("camera", 24, 30)
    operator = build(image, photometric_bandwidth=0.3, completion=completion, num_landmarks=30, landmarks="uniform")
    missed = (1 - operator.diagonal_share) * (image - projected(operator.spectrum(), image))
    assert missed.abs().max() > 1e-3
    assert bool((operator.diagonal_share > 1e-3).any()) == (completion == "diagonal")
    by_default = polynomial_filter(operator, image, double(ALPHA))
    gain = polynomial_response(operator.diagonal_share.flatten(1), double(ALPHA)).view_as(operator.diagonal_share)
    for weight in (0.0, 1.0, ALPHA[0]):
        result = polynomial_filter(operator, image, double(ALPHA), residual=weight)
        torch.testing.assert_close(result, by_default + (weight - gain) * missed, atol=1e-9, rtol=0)


def test_a_residual_of_one_moves_no_pixel_far() -> None:
    """Pixels that W keeps in part were weighed twice: at 3 by the sliders, and once more by their residual."""
    image = picture("rocket", 96, 96)
    operator = build(image)
    result = polynomial_filter(operator, image, double((3.0, 3.0, 4.0, 1.05)), residual=1.0)
    assert ((result - image).abs() > 0.5).float().mean() < 1e-3


@pytest.mark.parametrize("residual", [None, 0.0, 1.0])
def test_a_pixel_like_no_other_is_neither_lifted_nor_dropped(residual: float | None) -> None:
    image = picture("camera", 24, 30) / 2
    image[0, 0, 5, 7] = 1.0
    operator = build(image, photometric_bandwidth=0.02, num_landmarks=10, landmarks="uniform", patch_size=1)
    alike = operator.diagonal_share < 0.999
    assert not alike[0, 0, 5, 7]
    result = polynomial_filter(operator, image, double(ALPHA), residual=residual)
    torch.testing.assert_close(result[~alike], ALPHA[-1] * image[~alike], atol=0.02, rtol=0)


def test_residual_may_be_a_parameter() -> None:
    image = picture("camera", 12, 15)
    operator = build(image, photometric_bandwidth=0.3, num_landmarks=10)
    weight = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    polynomial_filter(operator, image, double(ALPHA), residual=weight).square().sum().backward()
    assert weight.grad is not None
    assert weight.grad.abs() > 0


def test_sliders_for_every_image_and_every_pixel() -> None:
    guide, image = noise(3, 1, 9, 11), noise(3, 2, 9, 11, seed=1)
    operator = build(guide, photometric_bandwidth=0.3, num_landmarks=20)
    alpha = noise(3, 4, seed=2)
    result = polynomial_filter(operator, image, alpha)
    for i in range(3):
        expected = polynomial_filter(operator, image, alpha[i])[i]
        torch.testing.assert_close(result[i], expected, atol=1e-12, rtol=0)
    spread = alpha[:, :, None, None].expand(3, 4, 9, 11)
    torch.testing.assert_close(polynomial_filter(operator, image, spread), result, atol=1e-12, rtol=0)
    mask = (noise(3, 1, 9, 11, seed=3) > 0.5).double()
    blended = polynomial_filter(operator, image, 1 + mask * (spread - 1))
    torch.testing.assert_close(blended, image + mask * (result - image), atol=1e-12, rtol=0)


@pytest.mark.parametrize("dtype", FLOATS)
def test_images_keep_their_dtype(dtype: torch.dtype) -> None:
    operator = build(noise(1, 1, 9, 11, dtype=torch.float32), photometric_bandwidth=0.3, num_landmarks=20)
    image = noise(1, 3, 9, 11, seed=1, dtype=dtype)
    alpha = torch.tensor(ALPHA)
    for result in (
        polynomial_filter(operator, image, alpha),
        polynomial_filter(operator, image, alpha, residual=0.5),
        detail_layers(operator, image),
        spectral_filter(operator.spectrum(), image, torch.sqrt),
    ):
        assert result.dtype == dtype
        assert result.isfinite().all()
    exact = polynomial_filter(operator, image.float(), alpha)
    tolerance = 4 * torch.finfo(dtype).eps if dtype.itemsize == 2 else 1e-5
    result = polynomial_filter(operator, image, alpha).float()
    torch.testing.assert_close(result, exact, atol=tolerance, rtol=tolerance)


def test_batch_is_its_images() -> None:
    guide = torch.cat([picture(name, 30, 36) for name in ("astronaut", "camera", "moon")])
    image, alpha = noise(3, 2, 30, 36), double(ALPHA)
    together = build(guide, num_landmarks=40)
    for i in range(3):
        alone = build(guide[i : i + 1], num_landmarks=40)
        for residual in (None, 0.0):
            torch.testing.assert_close(
                polynomial_filter(together, image, alpha, residual=residual)[i : i + 1],
                polynomial_filter(alone, image[i : i + 1], alpha, residual=residual),
                atol=1e-7,
                rtol=0,
            )


@pytest.mark.parametrize("name", ["astronaut", "constant"])
def test_gradients_reach_the_guide_and_are_finite(name: str) -> None:
    guide = picture("astronaut", 10, 12) if name == "astronaut" else torch.full((1, 1, 10, 12), 0.5).double()
    guide = guide.clone().requires_grad_()
    image = noise(1, 2, 10, 12)
    operator = build(guide, photometric_bandwidth=0.3, num_landmarks=15)
    weights = noise(1, 2, 10, 12, seed=5)
    for filtered in (
        polynomial_filter(operator, image, double(ALPHA)),
        polynomial_filter(operator, image, double(ALPHA), residual=0.3),
        spectral_filter(operator.spectrum(), image, lambda s: s**0.5),
    ):
        (gradient,) = torch.autograd.grad((filtered * weights).sum(), guide, retain_graph=True)
        assert gradient.isfinite().all()
        assert name == "constant" or gradient.abs().max() > 0


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("painted", [0.0, 0.2])
def test_gradients_by_masks_are_right_where_all_are_0(count: int, painted: float) -> None:
    image = colour("chelsea", 10, 12).double()
    operator = nonlocal_operator(image, num_landmarks=15)
    alpha = torch.tensor([[3.0, 2.0, 1.0, 1.0], [0.5, 1.5, 1.0, 1.1]], dtype=torch.float64)[:count]
    masks = torch.zeros(1, count, 10, 12, dtype=torch.float64)
    masks[..., :3] = painted
    weights = noise(*image.shape)
    leaf = masks.clone().requires_grad_()
    filtered = filter_regions(operator, image, leaf, alpha)
    assert torch.equal(filtered[..., 3:], image[..., 3:])
    (result,) = torch.autograd.grad((filtered * weights).sum(), leaf)
    for k in range(count):
        moved = masks.clone()
        moved[:, k] += 1e-6
        wanted = ((filter_regions(operator, image, moved, alpha) - filtered.detach()) * weights).sum() / 1e-6
        assert float(result[:, k].sum()) == pytest.approx(float(wanted), rel=1e-4)


def test_numbers_are_as_exact_as_tensors_in_double_precision() -> None:
    image = noise(1, 1, 20, 20)
    operator = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20)
    alpha = torch.tensor([3.0, 2.0, 1.0]).double()
    number, tensor = (
        polynomial_filter(operator, image, alpha, residual=value) for value in (0.3, torch.tensor(0.3).double() * 1)
    )
    exact = polynomial_filter(operator, image, alpha, residual=torch.tensor(0.3, dtype=torch.float64))
    torch.testing.assert_close(number, exact, atol=1e-15, rtol=0)
    assert (tensor - exact).abs().max() > 1e-12  # 0.3 rounded to float32


def test_half_precision_masks_do_not_round_the_sliders() -> None:
    image = noise(1, 1, 16, 16).float()
    operator = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20)
    alpha = torch.tensor([[3.1, 2.3, 4.7, 1.05]])
    mask = torch.ones(1, 1, 16, 16)
    expected = filter_regions(operator, image, mask, alpha)
    assert torch.equal(filter_regions(operator, image, mask.bfloat16(), alpha), expected)


def test_patch_weights_in_half_precision_do_not_overflow() -> None:
    image = noise(1, 1, 16, 16).float()
    options = {"photometric_bandwidth": 0.2, "num_landmarks": 20}
    result, expected = (
        nonlocal_operator(image, patch_weights=weights, **options) @ image
        for weights in (torch.full((5, 5), 3000.0).half(), torch.ones(5, 5))
    )
    torch.testing.assert_close(result, expected, atol=1e-6, rtol=0)


def test_sliders_of_regions_blend_their_edits() -> None:
    image = picture("coffee", 20, 22)
    operator = build(image, num_landmarks=60, photometric_bandwidth=0.2)
    sliders = torch.tensor([[3.0, 2.0, 1.1], [0.0, 0.5, 1.0]], dtype=torch.float64)
    masks = noise(1, 2, 20, 22) / 2
    edited = polynomial_filter(operator, image, compose_alpha(masks, sliders))
    whole = [polynomial_filter(operator, image, row) for row in sliders]
    expected = image + sum(masks[:, k : k + 1] * (whole[k] - image) for k in range(2))
    torch.testing.assert_close(edited, expected)
    blend = polynomial_filter(operator, image, compose_alpha(masks[:, :1], sliders[:1]))
    torch.testing.assert_close(blend, torch.lerp(image, whole[0], masks[:, :1]))


@pytest.mark.parametrize("residual", [None, 0.0, 1.0])
def test_regions_are_filtered_each_by_its_own_sliders(residual: float | None) -> None:
    image, sliders = picture("coffee", 20, 22), torch.tensor([[3.0, 2.0, 1.1], [0.0, 0.5, 1.0]], dtype=torch.float64)
    operator = build(image, num_landmarks=60, photometric_bandwidth=0.2)
    masks = torch.zeros(1, 2, 20, 22, dtype=torch.float64)
    masks[:, 0, :8], masks[:, 1, 14:] = 1, 1
    edited = filter_regions(operator, image, masks, sliders, residual=residual)
    assert torch.equal(edited[:, :, 8:14], image[:, :, 8:14])
    for rows, row in ((slice(0, 8), sliders[0]), (slice(14, 20), sliders[1])):
        whole = polynomial_filter(operator, image, row, residual=residual)
        torch.testing.assert_close(edited[:, :, rows], whole[:, :, rows])
    layer = NonlocalFilter(sliders.tolist(), residual=residual, photometric_bandwidth=0.2, num_landmarks=60)
    single = image.float()
    result = layer(single, mask=masks.float())
    torch.testing.assert_close(result, edited.float(), atol=1e-3, rtol=0)
    result.square().mean().backward()
    assert layer.sliders.alpha.grad is not None
    assert (layer.sliders.alpha.grad != 0).all()
    called = NonlocalFilter(residual=residual, photometric_bandwidth=0.2, num_landmarks=60)
    torch.testing.assert_close(called(single, mask=masks.float(), alpha=sliders.float()), result)
    one_for_all = called(single, mask=masks.float(), alpha=sliders[0].float())
    torch.testing.assert_close(one_for_all[:, :, :8], result[:, :, :8])
    for wrong in (-masks, 2 * masks):
        with pytest.raises(ValueError, match=r"masks must be in \[0, 1\]"):
            filter_regions(operator, image, wrong, sliders)
    with pytest.raises(ValueError, match="mask must have 2 channels, one for each row of sliders, got None"):
        layer(single)
    with pytest.raises(ValueError, match=r"alpha must have shape \(1, k\+1\)"):
        layer(single, mask=masks[:, :1].float())


def test_overlapping_masks_share_a_pixel() -> None:
    alpha = compose_alpha(torch.ones(1, 2, 1, 1), torch.tensor([[3.0, 1.0], [5.0, 2.0]]))
    torch.testing.assert_close(alpha.flatten(), torch.tensor([4.0, 1.5]))
    per_image = compose_alpha(torch.ones(2, 1, 1, 1), torch.tensor([[[3.0, 1.0]], [[5.0, 2.0]]]))
    torch.testing.assert_close(per_image[..., 0, 0], torch.tensor([[3.0, 1.0], [5.0, 2.0]]))


@pytest.mark.parametrize(
    ("masks", "alpha", "sentence"),
    [
        (torch.ones(1, 2, 3, 3), torch.ones(3), r"alpha must have shape \(2, k\+1\) or \(B, 2, k\+1\), .* got \(3,\)"),
        (torch.ones(1, 2, 3, 3), torch.ones(3, 4), r"alpha must have shape .* got \(3, 4\); reshape it"),
        (torch.ones(1, 2, 3, 3) * 1.5, torch.ones(2, 4), r"masks must be in \[0, 1\], got values from 1.5 to 1.5"),
        (torch.ones(1, 2, 3, 3), torch.full((2, 4), torch.nan), "alpha must be finite, got 8 NaN"),
    ],
)
def test_sliders_that_do_not_fit(masks: torch.Tensor, alpha: torch.Tensor, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        compose_alpha(masks, alpha)


def test_sliders_are_a_tensor() -> None:
    with pytest.raises(TypeError, match=r"alpha must be a torch.Tensor, got list; convert it with torch.tensor"):
        compose_alpha(torch.ones(1, 1, 2, 2), [1.0, 2.0])  # type: ignore[arg-type]
