"""Eigenvalues and eigenvectors. As those of repeated eigenvalues are not unique, tests compare V f(S) V^T."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nlfilter_torch import (
    Spectrum,
    nonlocal_operator,
)
from tests import reference
from tests.images import photograph, two_colours
from tests.pairwise import each_value
from tests.problems import build, guides, noise, options, picture


def rebuild(spectrum: Spectrum, power: float = 1.0) -> torch.Tensor:
    """V S^power V^T, (B, N, N)."""
    v = spectrum.eigenvectors.flatten(2)
    return v.mT @ (spectrum.eigenvalues.pow(power).unsqueeze(2) * v)


@pytest.mark.parametrize("power", [1.0, 0.5, 3.0])
def test_with_every_pixel_a_landmark_it_is_the_dense_spectrum(power: float) -> None:
    image = photograph("coffee", 24, 24)
    operator = nonlocal_operator(
        torch.from_numpy(image.copy())[None, None], photometric_bandwidth=20 / 255, num_landmarks=576
    )
    s, v = reference.eigenpairs(reference.filter_matrix(image, 5, 20 / 255))
    spectrum = operator.spectrum()
    np.testing.assert_allclose(spectrum.eigenvalues[0, :100], s[:100], atol=1e-4)
    # The jitter, 1e-5, moves small eigenvalues; their root moves by 3e-3.
    tolerance = 1e-4 if power >= 1 else 5e-3
    np.testing.assert_allclose(rebuild(spectrum, power)[0], v @ np.diag(s**power) @ v.T, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("completion", ["diagonal", "none"])
def test_eigenvectors_are_eigenvectors(completion: str, dtype: torch.dtype) -> None:
    operator = build(
        picture("chelsea", 40, 48, dtype),
        photometric_bandwidth=60 / 255,
        completion=completion,
        num_landmarks=60,
        landmarks="uniform",
    )
    spectrum = operator.spectrum()
    v = spectrum.eigenvectors.flatten(2)
    image = (operator @ spectrum.eigenvectors).flatten(2)
    kept = spectrum.eigenvalues[0] > 1e-2
    residual = (image - spectrum.eigenvalues.unsqueeze(2) * v).norm(dim=2)[0]
    # Without a diagonal part the span of the factor is invariant; with one, the eigenvectors are the best in that span.
    assert residual[kept].max() <= (1e-3 if completion == "none" else 0.1)
    rayleigh = (image * v).sum(2)
    torch.testing.assert_close(rayleigh[0, kept], spectrum.eigenvalues[0, kept], atol=1e-4, rtol=0)


def test_without_a_diagonal_part_the_spectrum_is_the_operator() -> None:
    operator = build(picture("camera", 24, 30), photometric_bandwidth=0.4, completion="none", num_landmarks=50)
    torch.testing.assert_close(rebuild(operator.spectrum()), operator.to_dense(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(guide=guides(), chosen=options)
def test_spectrum_is_in_order_in_range_and_orthonormal(
    guide: torch.Tensor, chosen: dict[str, object], dtype: torch.dtype
) -> None:
    spectrum = build(guide.to(dtype), **chosen).spectrum()
    s, v = spectrum.eigenvalues, spectrum.eigenvectors.flatten(2)
    assert s.dtype == v.dtype == dtype
    assert s.isfinite().all()
    assert v.isfinite().all()
    assert (s.diff(dim=1) <= 1e-6).all()
    assert s.min() >= 0
    assert s.max() <= 1.0001
    # The images of a batch may differ in rank: vectors beyond an image's own are zero.
    gram = v @ v.mT
    occupied = gram.diagonal(dim1=1, dim2=2) > 0.5
    torch.testing.assert_close(gram, torch.diag_embed(occupied.to(dtype)), atol=1e-3, rtol=0)
    assert occupied[:, 0].all()
    assert (s[~occupied] == 0).all()


@pytest.mark.parametrize(("name", "bandwidth"), each_value(["astronaut", "camera", "coffee", "chelsea"], [10, 20, 40]))
def test_ritz_values_lie_where_they_must(name: str, bandwidth: int) -> None:
    """Each lies between the eigenvalue of W of the same rank and that of its low-rank part (Courant and Fischer)."""
    operator = build(picture(name, 24, 24), photometric_bandwidth=bandwidth / 255, num_landmarks=60)
    dense = operator.to_dense()
    result = operator.spectrum().eigenvalues
    rank = result.shape[1]
    above = torch.linalg.eigvalsh(dense).flip(-1)[:, :rank]
    below = torch.linalg.eigvalsh(dense - torch.diag_embed(operator.scaling**2 * operator.diagonal)).flip(-1)[:, :rank]
    assert (result <= above + 1e-8).all()
    assert (result >= below - 1e-8).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["two colours", "constant"])
def test_first_eigenvector_is_constant_and_positive(name: str, dtype: torch.dtype) -> None:
    guide = {
        "two colours": torch.from_numpy(two_colours())[None, None],
        "constant": torch.full((1, 1, 40, 48), 0.5),
    }[name].to(dtype)
    spectrum = build(guide, photometric_bandwidth=30 / 255, num_landmarks=60).spectrum()
    first = spectrum.eigenvectors[0, 0]
    torch.testing.assert_close(first, torch.full_like(first, first.numel() ** -0.5), rtol=1e-3, atol=0)
    assert spectrum.eigenvalues[0, 0].item() == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("name", ["astronaut", "camera", "coffee"])
def test_first_eigenvector_of_a_photograph_is_nearly_constant(name: str) -> None:
    # The span of 60 landmarks contains the constant vector only up to the part of the kernel that they do not capture.
    spectrum = build(picture(name, 40, 48), photometric_bandwidth=30 / 255, num_landmarks=60).spectrum()
    first = spectrum.eigenvectors[0, 0]
    assert first.sum().item() / first.numel() ** 0.5 > 0.99
    assert 0.99 < spectrum.eigenvalues[0, 0].item() <= 1


def test_rank_cuts_the_tail() -> None:
    operator = build(picture("camera", 24, 30), photometric_bandwidth=0.2, num_landmarks=50)
    whole, part = operator.spectrum(), operator.spectrum(rank=7)
    assert part.eigenvalues.shape == (1, 7)
    assert part.eigenvectors.shape == (1, 7, 24, 30)
    torch.testing.assert_close(part.eigenvalues, whole.eigenvalues[:, :7])
    torch.testing.assert_close(part.eigenvectors, whole.eigenvectors[:, :7])
    assert operator.spectrum(rank=10_000).eigenvalues.shape == whole.eigenvalues.shape


def test_rank_is_what_the_image_has() -> None:
    spectrum = build(torch.full((1, 1, 10, 12), 0.5), num_landmarks=30).spectrum()
    assert spectrum.eigenvalues.shape == (1, 1)
    spectrum = build(torch.from_numpy(two_colours())[None, None], num_landmarks=30, patch_size=1).spectrum()
    assert spectrum.eigenvalues.shape == (1, 2)


def test_a_batch_is_its_images() -> None:
    guide = torch.cat([picture(name, 24, 30) for name in ("astronaut", "camera", "moon")])
    together = rebuild(build(guide, num_landmarks=40).spectrum())
    alone = torch.cat([rebuild(build(guide[i : i + 1], num_landmarks=40).spectrum()) for i in range(3)])
    torch.testing.assert_close(together, alone, atol=1e-6, rtol=0)


def test_eigenvalues_and_eigenvectors_have_finite_gradients() -> None:
    guide = noise(1, 1, 10, 12).requires_grad_()
    spectrum = build(guide, photometric_bandwidth=0.3, num_landmarks=15).spectrum(rank=5)
    (spectrum.eigenvalues.sum() + spectrum.eigenvectors.pow(4).sum()).backward()
    assert guide.grad is not None
    assert guide.grad.isfinite().all()
    assert guide.grad.abs().max() > 0


def test_gradient_of_repeated_eigenvalues_is_finite() -> None:
    guide = torch.from_numpy(two_colours(10, 12))[None, None].requires_grad_()
    spectrum = build(guide, photometric_bandwidth=0.05, num_landmarks=15).spectrum()
    assert (spectrum.eigenvalues[0, :2] > 0.999).all()
    spectrum.eigenvalues.square().sum().backward()
    assert guide.grad is not None
    assert guide.grad.isfinite().all()


@given(st.integers(0, 99))
def test_basis_keeps_distances(seed: int) -> None:
    spectrum = build(noise(1, 1, 8, 9, seed=seed), photometric_bandwidth=0.4, num_landmarks=12).spectrum()
    rows = spectrum.basis(lambda s: s**1.5) @ (spectrum.factor * spectrum.scaling.unsqueeze(1))
    expected = spectrum.eigenvalues.pow(1.5).unsqueeze(2) * spectrum.eigenvectors.flatten(2)
    torch.testing.assert_close(rows.mT @ rows, expected.mT @ expected, atol=1e-8, rtol=0)


def test_a_look_at_the_eigenvectors_takes_no_gradient_away() -> None:
    guide = noise(1, 1, 8, 9).requires_grad_()
    weights = noise(1, 6, 8, 9, seed=1)

    def slope(look: bool) -> torch.Tensor:
        spectrum = build(guide, photometric_bandwidth=0.4, num_landmarks=12).spectrum(6)
        if look:
            with torch.no_grad():
                assert not spectrum.eigenvectors.requires_grad
        return torch.autograd.grad((spectrum.eigenvectors.abs() * weights).sum(), guide)[0]

    torch.testing.assert_close(slope(look=True), slope(look=False))
    with torch.no_grad():
        constant = build(guide, photometric_bandwidth=0.4, num_landmarks=12).spectrum()
    assert not constant.eigenvectors.requires_grad


def test_the_first_eigenvector_stays_constant_in_double_precision() -> None:
    """An operator balanced in float32 has eigenvalues of 1 that differ by more than the rounding of float64."""
    image = 0.02 * noise(1, 3, 32, 32).float()
    image[..., 10:20] += 0.4
    image[..., 20:] += 0.9
    operator = nonlocal_operator(image, photometric_bandwidth=0.06, num_landmarks=20, patch_size=1)
    for spectrum in (
        operator.spectrum(),
        operator.spectrum().to(torch.float64),
        operator.to(torch.float64).spectrum(),
    ):
        first = spectrum.eigenvectors[0, 0]
        assert first.std() <= 1e-5 * first.mean()


def test_eigenvectors_formed_in_inference_mode_serve_training() -> None:
    spectrum = nonlocal_operator(noise(1, 1, 12, 12), num_landmarks=10, photometric_bandwidth=0.2).spectrum()
    with torch.inference_mode():
        assert spectrum.eigenvectors.isfinite().all()
    weight = torch.ones(1, dtype=torch.float64, requires_grad=True)
    (spectrum.eigenvectors * weight).sum().backward()
    assert weight.grad is not None


def test_an_empty_batch_has_an_empty_spectrum() -> None:
    operator = nonlocal_operator(noise(1, 1, 12, 12)[:0], num_landmarks=10, photometric_bandwidth=0.2)
    assert operator.spectrum().eigenvalues.shape[0] == 0


@pytest.mark.parametrize(("side", "bandwidth"), each_value([33, 64, 128], [0.1, 0.3, 1.0]))
def test_eigenvectors_of_a_single_spike_are_orthonormal(side: int, bandwidth: float) -> None:
    image = torch.zeros(1, 1, side, side)
    image[..., side // 2, side // 3] = 1
    vectors = nonlocal_operator(image, photometric_bandwidth=bandwidth, num_landmarks=5).spectrum().eigenvectors
    flat = vectors.flatten(2).double()
    torch.testing.assert_close(flat @ flat.mT, torch.eye(flat.shape[1]).double()[None], atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", ["rocket", "moon", "coffee"])
def test_eigenvectors_of_photographs_are_orthonormal(name: str) -> None:
    image = picture(name, 96, 96, torch.float32)
    assert max(nonlocal_operator(image).diagnostics().orthogonality) < 1e-4


def test_spectra_of_images_and_volumes_say_what_they_are() -> None:
    for size, spelled in (((1, 1, 6, 7), "6x7"), ((2, 1, 4, 5, 6), "4x5x6")):
        operator = nonlocal_operator(noise(*size), photometric_bandwidth=0.3, patch_size=3, num_landmarks=5)
        images = "1 image" if size[0] == 1 else "2 images"
        assert repr(operator.spectrum(rank=3)) == f"Spectrum({images} of {spelled}, 3 eigenvalues, torch.float64, cpu)"
