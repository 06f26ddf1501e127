"""Filters by any response, with a spectrum and with the operator."""

import numpy as np
import pytest
import torch
from hypothesis import given

from nlfilter_torch import (
    Spectrum,
    captured_energy,
    nonlocal_operator,
    polynomial_filter,
    polynomial_response,
    spectral_filter,
)
from tests import reference
from tests.images import photograph
from tests.pairwise import each_value
from tests.problems import build, guides, noise, options, picture


def projected(spectrum: Spectrum, image: torch.Tensor) -> torch.Tensor:
    return spectral_filter(spectrum, image, torch.ones_like, residual=0.0)


@pytest.mark.parametrize("power", [0.1, 0.5, 1.0, 3.0])
def test_spectral_filter_is_v_f_v(power: float) -> None:
    image = picture("coffee", 24, 30)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=50).spectrum()
    result = spectral_filter(spectrum, image, lambda s: s**power, residual=0.0)
    s, v = spectrum.eigenvalues[0].numpy(), spectrum.eigenvectors.flatten(2)[0].numpy().T
    np.testing.assert_allclose(
        result.ravel(), reference.spectral_function(s, v, s**power, image.numpy().ravel()), atol=1e-6
    )


def test_spectral_filter_against_the_dense_paper() -> None:
    image, y = photograph("astronaut", 24, 24), photograph("coffee", 24, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None], photometric_bandwidth=20 / 255, num_landmarks=576
    )
    s, v = reference.eigenpairs(reference.filter_matrix(image, 5, 20 / 255))
    for f in (lambda s: s, lambda s: (1 - s) * s**0.5, lambda s: s**3):
        result = spectral_filter(operator.spectrum(), torch.from_numpy(y.copy())[None, None], f, residual=0.0)
        np.testing.assert_allclose(result.ravel(), reference.spectral_function(s, v, f(s), y.ravel()), atol=3e-3)


def test_a_response_of_one_projects() -> None:
    image = picture("coffee", 24, 30)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=30, landmarks="uniform").spectrum()
    once = projected(spectrum, image)
    torch.testing.assert_close(projected(spectrum, once), once, atol=1e-8, rtol=0)
    whole = spectral_filter(spectrum, image, torch.ones_like, residual=1.0)
    torch.testing.assert_close(whole, image, atol=1e-8, rtol=0)


@pytest.mark.parametrize(("guides", "images"), [(1, 1), (1, 3), (2, 2), (2, 1)])
def test_coefficients_that_are_kept_change_nothing(guides: int, images: int) -> None:
    noise = torch.Generator().manual_seed(0)
    guide, image = (torch.rand(count, 3, 12, 15, dtype=torch.float64, generator=noise) for count in (guides, images))
    spectrum = build(guide, photometric_bandwidth=0.3, num_landmarks=10).spectrum()
    held = spectrum.coefficients(image)
    assert held.shape == (max(guides, images), 3, 10)
    for power in (0.1, 2.0):
        result = spectral_filter(spectrum, image, lambda s, p=power: s**p, residual=0.7, coefficients=held)
        assert torch.equal(result, spectral_filter(spectrum, image, lambda s, p=power: s**p, residual=0.7))


def test_coefficients_of_another_image_are_refused() -> None:
    image = picture("coffee", 12, 15)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=10).spectrum()
    held = spectrum.coefficients(image.expand(1, 3, -1, -1))
    with pytest.raises(
        ValueError, match=r"coefficients must have shape \(1, 1, 10\), got \(1, 3, 10\); use spectrum.coe"
    ):
        spectral_filter(spectrum, image, torch.sqrt, coefficients=held)
    with pytest.raises(TypeError, match=r"coefficients must be a torch\.Tensor, got list; use"):
        spectral_filter(spectrum, image, torch.sqrt, coefficients=held.tolist())  # type: ignore[arg-type]


def test_parameters_of_a_response_learn() -> None:
    image = picture("coffee", 12, 15)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=10).spectrum()
    power = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    spectral_filter(spectrum, image, lambda s: s**power).square().sum().backward()
    assert power.grad is not None
    assert power.grad < 0  # a larger power passes less


def test_captured_energy_is_the_reference_beta() -> None:
    image = picture("coffee", 24, 30)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=20, landmarks="uniform").spectrum()
    v = spectrum.eigenvectors.flatten(2)[0].numpy().T
    result = captured_energy(spectrum, image)
    assert result.shape == (1,)
    assert result.item() == pytest.approx(reference.captured_energy(v, image.numpy().ravel()), abs=1e-9)
    assert 0.5 < result.item() < 1


@given(guide=guides(), chosen=options)
def test_captured_energy_is_a_share(guide: torch.Tensor, chosen: dict[str, object]) -> None:
    energy = captured_energy(build(guide, **chosen).spectrum(), guide)
    assert energy.shape == (guide.shape[0],)
    assert (energy >= 0).all()
    assert (energy <= 1 + 1e-6).all()


def test_all_of_a_black_image_is_captured() -> None:
    spectrum = build(noise(2, 1, 8, 9), num_landmarks=10).spectrum()
    torch.testing.assert_close(captured_energy(spectrum, torch.zeros(2, 1, 8, 9)), torch.ones(2, dtype=torch.float64))


def test_captured_energy_of_large_and_small_images() -> None:
    image = noise(1, 1, 20, 20).float()
    spectrum = nonlocal_operator(image, photometric_bandwidth=0.2, num_landmarks=20).spectrum()
    expected = captured_energy(spectrum, image)
    for scale in (1e18, 1e-25):
        torch.testing.assert_close(captured_energy(spectrum, scale * image), expected, rtol=1e-5, atol=0)


def test_a_response_may_be_a_condition() -> None:
    image = picture("coffee", 20, 24)
    spectrum = nonlocal_operator(image, num_landmarks=15).spectrum()
    for residual in (0.0, 1.0):
        result = spectral_filter(spectrum, image, lambda values: values > 0.5, residual=residual)
        wanted = spectral_filter(spectrum, image, lambda values: (values > 0.5).float(), residual=residual)
        assert torch.equal(result, wanted)


# --- the weight of what the eigenvectors miss, and f(W) itself

IMAGE = picture("camera", 32, 32)
OPERATOR = build(IMAGE, photometric_bandwidth=20 / 255, num_landmarks=60)


def test_no_pixel_turns_black_by_default() -> None:
    """The power 0.1 of W darkens no pixel by more than 30 levels; the paper's eq. 10 darkens some by more than 50."""
    spectrum, exact = OPERATOR.spectrum(), spectral_filter(OPERATOR, IMAGE, lambda s: s**0.1)
    default, paper = (spectral_filter(spectrum, IMAGE, lambda s: s**0.1, residual=r) for r in (None, 0.0))
    assert (IMAGE - paper).max() > 50 / 255
    assert (IMAGE - default).max() < 30 / 255
    assert (default - exact).abs().mean() < 0.2 * (paper - exact).abs().mean()


def test_the_identity_is_the_operator() -> None:
    for dtype in (torch.float32, torch.float64):
        operator, image = OPERATOR.to(dtype), IMAGE.to(dtype)
        torch.testing.assert_close(spectral_filter(operator, image, lambda s: s), operator @ image, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("dtype", "degree"), each_value([torch.float32, torch.float64], range(1, 8)))
def test_polynomials_are_the_polynomial_filter(degree: int, dtype: torch.dtype) -> None:
    alpha = (4 * noise(degree + 1, seed=degree) - 1).to(dtype)
    operator, image = OPERATOR.to(dtype), IMAGE.to(dtype)
    result = spectral_filter(operator, image, lambda s: polynomial_response(s, alpha))
    torch.testing.assert_close(result, polynomial_filter(operator, image, alpha), atol=1e-5, rtol=0)


def test_an_operator_takes_no_residual() -> None:
    held = OPERATOR.spectrum().coefficients(IMAGE)
    with pytest.raises(ValueError, match=r"residual must be None with an operator, .* got float; pass operator.spe"):
        spectral_filter(OPERATOR, IMAGE, torch.sqrt, residual=0.0)
    with pytest.raises(ValueError, match=r"coefficients must be None with an operator, .* got Tensor; pass operator.s"):
        spectral_filter(OPERATOR, IMAGE, torch.sqrt, coefficients=held)
    with pytest.raises(TypeError, match=r"operator must be a Spectrum, got Tensor; make it with nonlocal_operator"):
        spectral_filter(IMAGE, IMAGE, torch.sqrt)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("dtype", "made"),
    each_value([torch.float16, torch.bfloat16, torch.float32, torch.float64], ["operator", "spectrum"]),
)
def test_responses_receive_the_dtype_of_the_image(made: str, dtype: torch.dtype) -> None:
    wanted = torch.float64 if dtype == torch.float64 else torch.float32
    layers = torch.nn.Linear(1, 8, dtype=wanted), torch.nn.Tanh(), torch.nn.Linear(8, 1, dtype=wanted)
    module, types = torch.nn.Sequential(*layers), set()

    def response(values: torch.Tensor) -> torch.Tensor:
        types.add(values.dtype)
        gains: torch.Tensor = module(values.unsqueeze(-1)).squeeze(-1)
        return gains

    source = OPERATOR if made == "operator" else OPERATOR.spectrum()
    result = spectral_filter(source, IMAGE.to(dtype), response)
    result.float().square().sum().backward()
    assert (result.dtype, types) == (dtype, {wanted})
    assert all(parameter.grad is not None for parameter in module.parameters())


def test_gradients_of_responses_in_float32_are_those_in_float64() -> None:
    guide, grads = noise(1, 1, 12, 14), []
    for dtype in (torch.float32, torch.float64):
        leaf = guide.clone().requires_grad_()
        spectrum = nonlocal_operator(leaf, num_landmarks=20, photometric_bandwidth=0.3).spectrum()
        filtered = spectral_filter(spectrum, guide.to(dtype), lambda s: s**0.3)
        (filtered * guide.flip(3).to(dtype)).sum().backward()
        grads.append(leaf.grad)
    assert grads[0] is not None
    assert grads[1] is not None
    assert (grads[0] - grads[1]).norm() < 1e-4 * grads[1].norm()
