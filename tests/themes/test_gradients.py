"""Gradients end to end: against finite differences, plain autograd and float64, and with repeated eigenvalues."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from nlfilter_torch import (
    NonlocalOperator,
    Spectrum,
    captured_energy,
    diffusion_mask,
    estimate_bandwidth,
    nonlocal_operator,
    polynomial_filter,
    polynomial_response,
    spectral_filter,
)
from nlfilter_torch.filtering.scribbles import propagate_strokes
from nlfilter_torch.operator.features import patch_window
from tests.images import hard_images
from tests.pairwise import each_value, pairwise
from tests.plain_autograd import plain_filter
from tests.problems import noise, picture, seeded

SIZE = (5, 4)
COMPLETIONS = ("diagonal", "none")
ALPHA = (3.0, 0.5, 2.0, 1.05)
# Without completion, the method itself breaks down at a small bandwidth.
BANDWIDTHS = {"diagonal": 0.2, "none": 0.8}


def scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def small(channels: int = 1, seed: int = 0, batch: int = 1) -> Tensor:
    return noise(batch, channels, *SIZE, seed=seed).requires_grad_()


def build(guide: Tensor, completion: str, **options: object) -> NonlocalOperator:
    options = {"photometric_bandwidth": BANDWIDTHS[completion], "num_landmarks": 7, "patch_size": 3} | options
    return nonlocal_operator(guide, completion=completion, guide_channels="all", **options)  # type: ignore[arg-type]


def weighted(tensor: Tensor, seed: int = 9) -> Tensor:
    """A sum with a different weight for every entry."""
    return (tensor * torch.randn(tensor.shape, generator=seeded(seed), dtype=tensor.dtype)).sum()


# Finite differences -------------------------------------------------------------------------------------------------
# Of every entry for the defaults, and along a random direction for the rest.


@pytest.mark.parametrize("landmarks", ["kmeans", "uniform", "random"])
@pytest.mark.parametrize("completion", COMPLETIONS)
def test_filter_in_guide_image_alpha_and_bandwidths(completion: str, landmarks: str) -> None:
    def call(guide: Tensor, image: Tensor, alpha: Tensor, photometric: Tensor, spatial: Tensor) -> Tensor:
        operator = build(
            guide, completion, landmarks=landmarks, photometric_bandwidth=photometric, spatial_bandwidth=spatial
        )
        return polynomial_filter(operator, image, alpha)

    alpha = torch.tensor(ALPHA, dtype=torch.float64, requires_grad=True)
    arguments = (small(), small(2, seed=1), alpha, scalar(BANDWIDTHS[completion]), scalar(4.0))
    assert gradcheck(call, arguments, fast_mode=landmarks != "kmeans")


def test_filter_in_the_bandwidths_of_vertical_and_horizontal_distances() -> None:
    guide, image = small().detach(), small(seed=1).detach()

    def call(vertical: Tensor, horizontal: Tensor) -> Tensor:
        operator = build(guide, "diagonal", spatial_bandwidth=(vertical, horizontal), landmarks="uniform")
        return polynomial_filter(operator, image, torch.tensor(ALPHA, dtype=torch.float64))

    assert gradcheck(call, (scalar(3.0), scalar(5.0)))
    square = build(guide, "diagonal", spatial_bandwidth=4.0)
    for pair in ((4.0, 4.0), [4.0, 4.0]):
        torch.testing.assert_close(build(guide, "diagonal", spatial_bandwidth=pair).factor, square.factor)


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_filter_of_a_batch_with_its_own_sliders_and_bandwidths(completion: str) -> None:
    def call(guide: Tensor, alpha: Tensor, photometric: Tensor, spatial: Tensor) -> Tensor:
        operator = build(guide, completion, photometric_bandwidth=photometric, spatial_bandwidth=spatial)
        return polynomial_filter(operator, guide, alpha)

    photometric = (BANDWIDTHS[completion] * torch.tensor([1.0, 1.5]).double()).requires_grad_()
    spatial = torch.tensor([4.0, 3.0], dtype=torch.float64, requires_grad=True)
    assert gradcheck(
        call,
        (small(2, batch=2), noise(2, 3, seed=4).requires_grad_(), photometric, spatial),
        fast_mode=completion == "none",
    )


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_filter_in_patch_weights_residual_and_sliders_of_every_pixel(completion: str) -> None:
    guide, image = small().detach(), small(seed=1).detach()

    def call(weights: Tensor, residual: Tensor, alpha: Tensor) -> Tensor:
        return polynomial_filter(build(guide, completion, patch_weights=weights), image, alpha, residual=residual)

    weights = patch_window(3).clone().requires_grad_()
    assert gradcheck(
        call, (weights, scalar(0.7), noise(1, 4, *SIZE, seed=2).requires_grad_()), fast_mode=completion == "none"
    )


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_spectral_filter(completion: str) -> None:
    def call(guide: Tensor, image: Tensor, exponent: Tensor, residual: Tensor, bandwidth: Tensor) -> Tensor:
        spectrum = build(guide, completion, photometric_bandwidth=bandwidth).spectrum()
        return spectral_filter(spectrum, image, lambda s: (s + 0.1) ** exponent, residual=residual)

    arguments = (small(), small(2, seed=1), scalar(0.4), scalar(0.3), scalar(BANDWIDTHS[completion]))
    assert gradcheck(call, arguments, fast_mode=completion == "none")


def test_coefficients() -> None:
    def call(guide: Tensor, image: Tensor) -> Tensor:
        return build(guide, "diagonal").spectrum().coefficients(image)

    assert gradcheck(call, (small(), small(2, seed=1)))


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_diffusion_mask(completion: str) -> None:
    region, negative = noise(1, 2, *SIZE, seed=1).requires_grad_(), noise(1, 1, *SIZE, seed=2).requires_grad_()

    def call(guide: Tensor, region: Tensor, time: Tensor, width: Tensor, negative: Tensor) -> Tensor:
        spectrum = build(guide, completion).spectrum()
        return diffusion_mask(spectrum, region, time=time, width=width, negative=negative)

    assert gradcheck(call, (small(), region, scalar(1.3), scalar(6.0), negative), fast_mode=completion == "none")


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_propagate_strokes(completion: str) -> None:
    painted = (0.1 + 0.8 * noise(1, 1, *SIZE, seed=2)).requires_grad_()

    def call(guide: Tensor, strokes: Tensor, painted: Tensor, strength: Tensor, smoothness: Tensor) -> Tensor:
        spectrum = build(guide, completion).spectrum()
        return propagate_strokes(spectrum, strokes, painted, strength=strength, smoothness=smoothness)

    assert gradcheck(
        call, (small(), small(2, seed=1), painted, scalar(0.9), scalar(0.5)), fast_mode=completion == "none"
    )


@pytest.mark.parametrize("completion", COMPLETIONS)
def test_eigenvalues_energy_and_product(completion: str) -> None:
    def call(guide: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        operator = build(guide, completion)
        spectrum = operator.spectrum()
        image = noise(1, 1, *SIZE, seed=1)
        # The first eigenvalue is 1 for any guide, to rounding and a clamp.
        return spectrum.eigenvalues[:, 1:], captured_energy(spectrum, image), operator @ image

    assert gradcheck(call, (small(),), fast_mode=completion == "none")


def test_automatic_bandwidth_counts_as_constant() -> None:
    guide = small(1, seed=3)
    bandwidth = estimate_bandwidth(guide)
    assert not bandwidth.requires_grad
    result, expected = (
        torch.autograd.grad(weighted(build(guide, "diagonal", photometric_bandwidth=h) @ guide), guide)[0]
        for h in ("auto", bandwidth)
    )
    torch.testing.assert_close(result, expected)


# Plain autograd -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["chelsea", "camera"])
@pytest.mark.parametrize("completion", COMPLETIONS)
def test_gradient_is_that_of_plain_autograd_through_unrolled_balancing(completion: str, name: str) -> None:
    guide = picture(name, 24, 20).requires_grad_()
    leaves = (guide, scalar(0.5 * BANDWIDTHS[completion]), scalar(20.0), scalar(2.0))

    def gradients(filtered: Callable[..., Tensor]) -> tuple[Tensor, ...]:
        alpha = torch.stack([leaves[3], leaves[3] - 0.5, *torch.tensor([0.7, 1.0]).double()])
        return torch.autograd.grad(weighted(filtered(alpha)), leaves)

    options = {"photometric_bandwidth": leaves[1], "spatial_bandwidth": leaves[2], "num_landmarks": 25}
    implicit = gradients(
        lambda alpha: polynomial_filter(nonlocal_operator(guide, completion=completion, **options), guide, alpha)
    )
    unrolled = gradients(lambda alpha: plain_filter(guide, guide, alpha, completion=completion, steps=45, **options))
    for result, expected in zip(implicit, unrolled, strict=True):
        assert (result - expected).abs().max() <= 1e-6 * expected.abs().max()


# Repeated eigenvalues -----------------------------------------------------------------------------------------------


def degenerate_guides() -> dict[str, Tensor]:
    """Images whose filter has repeated eigenvalues, by symmetry or for lack of different pixels."""
    half = noise(1, 1, 8, 5, seed=5)
    images = {name: torch.from_numpy(hard_images()[name][:8, 18:28].copy()) for name in ("constant", "checkerboard")}
    images["two colours"] = torch.from_numpy(hard_images()["two colours"][:8, 19:29].copy())
    guides = {name: image[None, None] for name, image in images.items()}
    guides["mirrored"] = torch.cat([half, half.flip(-1)], dim=3)
    # There are only four different patches, so that some of the eight landmarks coincide.
    guides["duplicated landmarks"] = noise(1, 1, 2, 2, seed=6).repeat(1, 1, 4, 5)
    return guides


GUIDES = degenerate_guides()


def directional(
    function: Callable[[Tensor], Tensor], at: Tensor, directions: list[Tensor], step: float = 1e-5
) -> tuple[Tensor, Tensor]:
    """Return directional derivatives by backward and by central differences of fourth order."""
    at = at.detach().requires_grad_()
    gradient = torch.autograd.grad(function(at), at)[0]
    result, expected = [], []
    with torch.no_grad():
        for direction in directions:
            f = {k: function(at + k * step * direction) for k in (-2, -1, 1, 2)}
            result.append((gradient * direction).sum())
            expected.append((8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * step))
    return torch.stack(result), torch.stack(expected)


def spectral_sum(spectrum: Spectrum, image: Tensor) -> Tensor:
    return weighted(spectral_filter(spectrum, image, lambda s: s * (2 - s)))


def mask_sum(spectrum: Spectrum, image: Tensor) -> Tensor:
    region = torch.zeros_like(image)
    region[..., 1:3, 2:4] = 1
    return weighted(diffusion_mask(spectrum, region, time=1.0))


def directions_that_keep_the_rank(guide: Tensor) -> list[Tensor]:
    """Changes that keep equal pixels equal: each grey level changes by an amount of its own."""
    _, level = guide.flatten().unique(return_inverse=True)
    return [noise(int(level.max()) + 1, seed=seed)[level].view_as(guide) - 0.5 for seed in range(5)]


@pytest.mark.parametrize(("completion", "name", "function"), pairwise(COMPLETIONS, GUIDES, [spectral_sum, mask_sum]))
def test_gradient_in_a_degenerate_guide_is_the_finite_difference(
    function: Callable[[Spectrum, Tensor], Tensor], name: str, completion: str
) -> None:
    image = noise(*GUIDES[name].shape, seed=7)

    def loss(guide: Tensor) -> Tensor:
        # Uniform landmarks, since k-means may assign equal pixels to other centroids as soon as they differ.
        operator = nonlocal_operator(
            guide, landmarks="uniform", num_landmarks=8, photometric_bandwidth=0.8, completion=completion
        )
        return function(operator.spectrum(), image)

    result, expected = directional(loss, GUIDES[name], directions_that_keep_the_rank(GUIDES[name]))
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", GUIDES)
def test_spectrum_and_products_agree_where_eigenvalues_meet(name: str) -> None:
    # Without completion W lies in the span of its eigenvectors, and products do not depend on eigenvalues.
    image, alpha = noise(*GUIDES[name].shape, seed=7), torch.tensor(ALPHA, dtype=torch.float64)
    gradients = []
    for by_spectrum in (False, True):
        guide = GUIDES[name].clone().requires_grad_()
        operator = nonlocal_operator(guide, num_landmarks=8, photometric_bandwidth=0.8, completion="none")
        if by_spectrum:
            filtered = spectral_filter(
                operator.spectrum(), image, lambda s: polynomial_response(s, alpha), residual=alpha[0]
            )
        else:
            filtered = polynomial_filter(operator, image, alpha)
        gradients.append(torch.autograd.grad(weighted(filtered), guide)[0])
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(("dtype", "name"), each_value([torch.float32, torch.float64], hard_images()))
def test_gradients_are_finite_on_hard_images(name: str, dtype: torch.dtype) -> None:
    guide = torch.from_numpy(hard_images()[name])[None, None].to(dtype).requires_grad_()
    # With half of all seeds, an eigenvalue of two colours is so small in float32 that the slope of its power overflows.
    operator = nonlocal_operator(guide, num_landmarks=20, generator=torch.Generator().manual_seed(2))
    spectrum = operator.spectrum()
    region = torch.zeros_like(guide)
    region[..., :3] = 1
    losses = {
        "products": weighted(polynomial_filter(operator, guide, torch.tensor(ALPHA))),
        "residual": weighted(polynomial_filter(operator, guide, torch.tensor(ALPHA), residual=1.0)),
        "power": weighted(spectral_filter(spectrum, guide, lambda s: s**0.1)),
        "mask": weighted(diffusion_mask(spectrum, region)),
        "strokes": weighted(propagate_strokes(spectrum, guide, region)),
        "eigenvalues": weighted(spectrum.eigenvalues),
    }
    for loss in losses.values():
        gradient = torch.autograd.grad(loss, guide, retain_graph=True)[0]
        assert gradient.isfinite().all()


# Precision and order ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["astronaut", "camera", "coffee"])
def test_float32_gradients_are_near_float64(name: str) -> None:
    gradients = []
    for dtype in (torch.float32, torch.float64):
        guide = picture(name, 64, 72, dtype).requires_grad_()
        bandwidth = torch.tensor(20 / 255, dtype=dtype, requires_grad=True)
        alpha = torch.tensor(ALPHA, dtype=dtype, requires_grad=True)
        operator = nonlocal_operator(guide, photometric_bandwidth=bandwidth, num_landmarks=60)
        weights = torch.randn(guide.shape, generator=seeded(9)).to(dtype)
        loss = (polynomial_filter(operator, guide, alpha) * weights).mean()
        gradients.append(torch.autograd.grad(loss, (guide, bandwidth, alpha)))
    for single, double in zip(*gradients, strict=True):
        assert (single - double).abs().max() <= 2e-3 * double.abs().max()


def test_patch_weights_of_0_have_a_gradient() -> None:
    guide, image = small().detach(), small(seed=1).detach()

    def total(weights: Tensor) -> Tensor:
        operator = nonlocal_operator(
            guide, patch_weights=weights, photometric_bandwidth=0.3, num_landmarks=12, landmarks="random"
        )
        return (operator @ image).square().sum()

    cross = torch.tensor([[0.0, 1, 0], [1, 2, 1], [0, 1, 0]], dtype=torch.float64, requires_grad=True)
    (result,) = torch.autograd.grad(total(cross), cross)
    for index in range(9):
        step = torch.zeros_like(cross)
        step.view(-1)[index] = 1e-5
        with torch.no_grad():
            wanted = (total(cross + step) - total(cross)) / 1e-5
        assert float(result.view(-1)[index]) == pytest.approx(float(wanted), abs=1e-6)
