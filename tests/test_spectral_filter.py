"""Responses of the spectrum and captured energy, compared with the dense reference."""

import numpy as np
import pytest
import torch
from hypothesis import given

from nlfilter_torch import (
    captured_energy,
    nonlocal_operator,
    spectral_filter,
)
from tests import reference
from tests.images import photograph
from tests.problems import build, guides, noise, options, picture

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def double(values: object) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("power", [0.1, 0.5, 1.0, 3.0])
def test_spectral_filter_is_v_f_v(power: float) -> None:
    image = picture("coffee", 24, 30)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=50).spectrum()
    found = spectral_filter(spectrum, image, lambda s: s**power)
    s, v = spectrum.eigenvalues[0].numpy(), spectrum.eigenvectors.flatten(2)[0].numpy().T
    np.testing.assert_allclose(
        found.ravel(), reference.spectral_function(s, v, s**power, image.numpy().ravel()), atol=1e-6
    )


def test_spectral_filter_against_the_dense_paper() -> None:
    image, y = photograph("astronaut", 24, 24), photograph("coffee", 24, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None], photometric_bandwidth=20 / 255, num_landmarks=576
    )
    s, v = reference.eigenpairs(reference.filter_matrix(image, 5, 20 / 255))
    for f in (lambda s: s, lambda s: (1 - s) * s**0.5, lambda s: s**3):
        found = spectral_filter(operator.spectrum(), torch.from_numpy(y.copy())[None, None], f)
        np.testing.assert_allclose(found.ravel(), reference.spectral_function(s, v, f(s), y.ravel()), atol=3e-3)


def test_a_response_of_one_projects() -> None:
    image = picture("coffee", 24, 30)
    spectrum = build(image, photometric_bandwidth=0.1, num_landmarks=30, landmarks="uniform").spectrum()
    once = spectral_filter(spectrum, image, torch.ones_like)
    torch.testing.assert_close(spectral_filter(spectrum, once, torch.ones_like), once, atol=1e-8, rtol=0)
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
        found = spectral_filter(spectrum, image, lambda s, p=power: s**p, residual=0.7, coefficients=held)
        assert torch.equal(found, spectral_filter(spectrum, image, lambda s, p=power: s**p, residual=0.7))


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
    found = captured_energy(spectrum, image)
    assert found.shape == (1,)
    assert found.item() == pytest.approx(reference.captured_energy(v, image.numpy().ravel()), abs=1e-9)
    assert 0.5 < found.item() < 1


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
        found = spectral_filter(spectrum, image, lambda values: values > 0.5, residual=residual)
        wanted = spectral_filter(spectrum, image, lambda values: (values > 0.5).float(), residual=residual)
        assert torch.equal(found, wanted)
