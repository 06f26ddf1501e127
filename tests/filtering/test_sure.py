"""Stein's estimate equals its definition with the dense matrix, and its mean is the squared error."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    NoiseProfile,
    NonlocalOperator,
    detail_layers,
    fit_alpha,
    nonlocal_operator,
    operator_from_features,
    polynomial_filter,
    sure,
)
from nlfilter_torch.filtering.sure import layer_divergences
from tests.problems import noise, picture, seeded

LEVEL = 0.08


def normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(shape, generator=seeded(seed), dtype=torch.float64).to(dtype)


def level_map(*shape: int) -> Tensor:
    return 0.02 + 0.1 * noise(*shape, seed=5)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("order", [1, 2, 4])
def test_traces_of_the_layers_are_those_of_the_dense_matrix(order: int, weighted: bool) -> None:
    counts = 1 + 3 * noise(2, 60, seed=1) if weighted else None
    operator = operator_from_features(1.5 * noise(2, 3, 60), size=(6, 10), num_landmarks=9, weights=counts)
    image, levels, shares = noise(2, 3, 6, 10), level_map(2, 3, 6, 10), noise(2, 3, 60, seed=2)
    dense = operator.to_dense()
    powers = [torch.linalg.matrix_power(dense, power).diagonal(dim1=1, dim2=2) for power in range(order + 1)]
    diagonals = [before - after for before, after in pairwise(powers)] + powers[-1:]
    amounts = (levels.square().flatten(2) * shares).sum(1)
    wanted = torch.stack([(amounts * diagonal).sum(1) for diagonal in diagonals], dim=1)
    torch.testing.assert_close(layer_divergences(operator, image, levels, shares, order), wanted)


def test_of_an_operator_it_is_the_definition() -> None:
    guide, image = picture("camera", 12, 14), noise(1, 2, 12, 14)
    operator, levels = nonlocal_operator(guide, num_landmarks=12), level_map(1, 1, 12, 14)
    alpha = torch.tensor([0.3, 1.4, 0.9], dtype=torch.float64)
    dense = operator.to_dense()[0]
    eye = torch.eye(len(dense), dtype=torch.float64)
    matrix = alpha[0] * (eye - dense) + alpha[1] * dense @ (eye - dense) + alpha[2] * dense @ dense
    trace = 2 * (matrix.diagonal() * levels.square().flatten()).sum()
    error = (matrix @ image.flatten(2)[0].T - image.flatten(2)[0].T).square().sum()
    wanted = (error + 2 * (trace - levels.square().sum())) / image.numel()
    torch.testing.assert_close(sure(operator, image, levels, alpha=alpha), wanted[None])
    torch.testing.assert_close(sure(operator, image.float(), levels.float(), alpha=alpha)[0], wanted.float())


def test_its_mean_is_the_squared_error() -> None:
    clean = picture("camera", 24, 24)
    operator = nonlocal_operator(clean, num_landmarks=20)
    draws = clean + LEVEL * normal(400, 1, 24, 24)
    true = (operator @ draws - clean).square().mean((1, 2, 3))
    estimate = sure(operator, draws, LEVEL)
    error = (estimate - true).std() / 20
    assert (estimate.mean() - true.mean()).abs() < 4 * error
    assert error < 0.05 * true.mean()


@pytest.mark.parametrize("step", [None, 1e-3])
def test_probes_agree_with_the_trace(step: float | None) -> None:
    operator, image = nonlocal_operator(picture("camera", 24, 24), num_landmarks=20), noise(2, 1, 24, 24)
    exact = sure(operator, image, LEVEL)
    probed = sure(lambda y: operator @ y, image, LEVEL, step=step, probes=200)
    torch.testing.assert_close(probed, exact, rtol=0, atol=0.02 * float(exact.max()))
    again = sure(lambda y: operator @ y, image, LEVEL, step=step, probes=3, generator=seeded(0))
    assert torch.equal(again, sure(lambda y: operator @ y, image, LEVEL, step=step, probes=3))


def test_a_guide_that_depends_on_the_image_counts_with_held_landmarks() -> None:
    clean = picture("coins", 64, 64)
    estimates, fixed, errors = [], [], []
    for seed in range(12):
        noisy = clean + LEVEL * normal(1, 1, 64, 64, seed=seed)
        first = nonlocal_operator(noisy, photometric_bandwidth=0.12, num_landmarks=40)

        def filtered(y: Tensor, first: NonlocalOperator = first) -> Tensor:
            return nonlocal_operator(y, photometric_bandwidth=0.12, landmarks=first) @ y

        errors.append(float((filtered(noisy) - clean).square().mean()))
        estimates.append(float(sure(filtered, noisy, LEVEL)))
        fixed.append(float(sure(first, noisy, LEVEL)))
    true = sum(errors)
    assert abs(sum(estimates) - true) < 0.05 * true
    assert true - sum(fixed) > 2 * abs(sum(estimates) - true)


def test_gradients_of_the_exact_estimate() -> None:
    image = noise(1, 1, 7, 8)
    alpha = torch.tensor([0.2, 1.3, 0.9], dtype=torch.float64)

    def of(guide: Tensor, bandwidth: Tensor, y: Tensor, sliders: Tensor) -> Tensor:
        operator = nonlocal_operator(
            guide, photometric_bandwidth=bandwidth, num_landmarks=6, landmarks="uniform", tolerance=1e-14
        )
        return sure(operator, y, LEVEL, alpha=sliders)

    inputs = (noise(1, 1, 7, 8, seed=3), torch.tensor(0.3, dtype=torch.float64), image, alpha)
    torch.autograd.gradcheck(of, tuple(value.requires_grad_() for value in inputs), rtol=1e-4, atol=1e-7)


def test_differences_have_a_gradient_in_the_bandwidth() -> None:
    noisy = picture("camera", 16, 16) + LEVEL * normal(1, 1, 16, 16)
    first = nonlocal_operator(noisy, photometric_bandwidth=0.2, num_landmarks=12)

    def of(bandwidth: Tensor) -> Tensor:
        def filtered(y: Tensor) -> Tensor:
            return nonlocal_operator(y, photometric_bandwidth=bandwidth, landmarks=first, tolerance=1e-14) @ y

        return sure(filtered, noisy, LEVEL, step=0.01)

    torch.autograd.gradcheck(of, torch.tensor(0.2, dtype=torch.float64).requires_grad_(), rtol=1e-4, atol=1e-7)


def test_sliders_without_a_target_minimise_the_estimate() -> None:
    clean = picture("camera", 48, 48)
    noisy = clean + LEVEL * normal(1, 1, 48, 48)
    operator = nonlocal_operator(clean, num_landmarks=40)
    alpha = fit_alpha(operator, noisy, noise=LEVEL)
    least = sure(operator, noisy, LEVEL, alpha=alpha)
    for change in 0.02 * torch.eye(4, dtype=torch.float64):
        assert (sure(operator, noisy, LEVEL, alpha=alpha + change) > least).all()
        assert (sure(operator, noisy, LEVEL, alpha=alpha - change) > least).all()
    best = fit_alpha(operator, noisy, clean, rounding=0.0)
    errors = [(polynomial_filter(operator, noisy, sliders) - clean).square().mean() for sliders in (alpha, best)]
    assert errors[1] <= errors[0] < 1.05 * errors[1]


def test_sliders_under_a_mask_and_for_a_batch() -> None:
    clean = picture("camera", 32, 32)
    operator, mask = nonlocal_operator(clean, num_landmarks=30), torch.zeros(1, 1, 32, 32, dtype=torch.float64)
    mask[..., 8:24, 8:] = 1
    images = clean + LEVEL * normal(3, 1, 32, 32)
    together = fit_alpha(operator, images, noise=LEVEL, mask=mask, order=2)
    for image, alpha in zip(images.split(1), together, strict=True):
        torch.testing.assert_close(fit_alpha(operator, image, noise=LEVEL, mask=mask, order=2)[0], alpha)
    changed = torch.where(mask > 0, images[:1], images[:1] + 1e-9)
    torch.testing.assert_close(fit_alpha(operator, changed, noise=LEVEL, mask=mask, order=2)[0], together[0])
    assert fit_alpha(operator, images, noise=LEVEL, shared=True).shape == (1, 4)
    torch.testing.assert_close(fit_alpha(operator, images, noise=0.0), torch.ones(3, 4, dtype=torch.float64))


def test_sliders_of_a_function_that_builds_the_operator() -> None:
    clean = picture("coins", 64, 64)
    noisy = clean + LEVEL * normal(1, 1, 64, 64)
    first = nonlocal_operator(noisy, photometric_bandwidth=0.12, num_landmarks=40)
    best = fit_alpha(first, noisy, clean, rounding=0.0)
    errors = []
    for operator in (partial(nonlocal_operator, photometric_bandwidth=0.12, landmarks=first), first):
        errors.append(float((fit_alpha(operator, noisy, noise=LEVEL) - best).norm()))
    assert errors[0] < 0.7 * errors[1]


def test_correlated_noise() -> None:
    clean = picture("camera", 48, 48)
    operator = nonlocal_operator(clean, num_landmarks=40)
    profile = NoiseProfile.white(torch.tensor([LEVEL], dtype=torch.float64), channels=1)
    exact = sure(operator, clean, LEVEL)
    torch.testing.assert_close(sure(operator, clean, profile, probes=60), exact, rtol=0.05, atol=0)
    alpha = fit_alpha(operator, clean, noise=profile, probes=60)
    torch.testing.assert_close(alpha, fit_alpha(operator, clean, noise=LEVEL), atol=0.05, rtol=0.05)


def test_layers_of_one_probe_add_up() -> None:
    image = noise(1, 1, 12, 12)
    operator = nonlocal_operator(image, num_landmarks=9)
    traces = layer_divergences(operator, image, LEVEL, None, 3)
    torch.testing.assert_close(traces.sum(), torch.tensor(144 * LEVEL**2, dtype=torch.float64))
    assert detail_layers(operator, image).shape[1] == traces.shape[1]


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda op, y: sure(op, y, -0.1), ValueError, "noise must be at least 0"),
        (lambda op, y: sure(op, y, level_map(1, 1, 5, 5)), ValueError, "noise"),
        (lambda op, y: sure(lambda x: x, y, 0.1, alpha=torch.ones(2)), ValueError, "alpha must be None"),
        (lambda op, y: sure(lambda x: x.detach(), y, 0.1), ValueError, "pass step=0.05"),
        (lambda op, y: sure(lambda x: x[..., :2], y, 0.1), ValueError, "the result of function"),
        (lambda op, y: sure(lambda x: x, y, 0.1, step=0.0), ValueError, "step"),
        (lambda op, y: sure(lambda x: x, y, 0.1, probes=0), ValueError, "probes"),
        (lambda op, y: sure(op, y[..., :4], 0.1), ValueError, "image"),
        (lambda op, y: fit_alpha(op, y), ValueError, "got neither"),
        (lambda op, y: fit_alpha(op, y, y, noise=0.1), ValueError, "got both"),
        (lambda op, y: fit_alpha(op, y, noise=0.1, rounding=0.1), ValueError, "they need a target"),
        (lambda op, y: fit_alpha(op, y, noise=-0.1), ValueError, "noise must be at least 0"),
        (lambda op, y: fit_alpha(lambda x: x, y, noise=0.1), TypeError, "operator"),
    ],
)
def test_refusals(call: Callable[[NonlocalOperator, Tensor], object], error: type[Exception], words: str) -> None:
    image = noise(1, 1, 8, 8)
    with pytest.raises(error, match=words):
        call(nonlocal_operator(image, num_landmarks=5), image)
