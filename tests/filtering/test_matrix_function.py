"""f(W) against the dense eigen-decomposition, for every kind of response."""

import math

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalOperator, apply_function, nonlocal_operator, operator_from_features
from nlfilter_torch.core.rational import rational_form
from nlfilter_torch.filtering import lanczos
from nlfilter_torch.filtering.matrix_function import pole_terms, rational_product, weigh_poles
from nlfilter_torch.operator.pixel_matrix import PixelMatrix
from tests.problems import noise, picture

IMAGE = picture("camera", 32, 32)
NETWORK = torch.nn.Sequential(torch.nn.Linear(1, 32), torch.nn.Tanh(), torch.nn.Linear(32, 1)).double()
with torch.no_grad():
    for number, parameter in enumerate(NETWORK.parameters()):
        parameter.copy_(4 * noise(*parameter.shape, seed=number) - 2)


def network(values: Tensor) -> Tensor:
    gains: Tensor = NETWORK(values.double().unsqueeze(-1)).squeeze(-1)
    return gains.to(values)


RESPONSES = {f"power {p}": (lambda s, p=p: s**p) for p in (0.1, 0.2, 0.5, 1.5, 3, 20)}
RESPONSES |= {
    "exp": torch.exp,
    "network": network,
    "kink": lambda s: (s - 0.3).abs(),
    "log": lambda s: (s + 0.01).log(),
}


def dense(operator: NonlocalOperator) -> tuple[Tensor, Tensor]:
    w = operator.to_dense()[0]
    values, vectors = torch.linalg.eigh((w + w.mT) / 2)
    return values.clamp(0, 1), vectors


@pytest.mark.parametrize("count", [20, 300])
def test_functions_are_those_of_the_dense_matrix(count: int) -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=count, photometric_bandwidth=20 / 255)
    values, vectors = dense(operator)
    gaps = values.diff()
    place = float((values[:-1] + values[1:])[gaps.argmax()] / 2)
    steps = {"step": lambda s: s > place} if gaps.max() > 0.02 else {}
    for name, response in (RESPONSES | steps).items():
        wanted = vectors @ (response(values).double() * (vectors.mT @ IMAGE.flatten()))
        result = apply_function(operator, IMAGE, response)
        assert (result.image.flatten() - wanted).abs().max() < 1e-3, name
        assert result.products + result.shifts <= 200, name
        assert result.error <= 3e-4, name
        single = apply_function(operator.to(torch.float32), IMAGE.float(), response)
        assert (single.image.flatten() - wanted).abs().max() < 1e-3, name


def test_a_smaller_tolerance_gives_a_smaller_error() -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=50, photometric_bandwidth=0.3)
    values, vectors = dense(operator)
    wanted = vectors @ (values**0.3 * (vectors.mT @ IMAGE.flatten()))
    costs = []
    for tolerance in (1e-2, 1e-4, 1e-6):
        result = apply_function(operator, IMAGE, lambda s: s**0.3, tolerance=tolerance)
        assert (result.image.flatten() - wanted).abs().max() < 2 * tolerance
        costs.append(result.shifts)
    assert sorted(set(costs)) == costs


@pytest.mark.parametrize("response", ["power 0.5", "exp", "kink"])
def test_batches_channels_and_weights(response: str) -> None:
    weights = noise(2, 48, seed=3) + 0.2
    operator = operator_from_features(noise(2, 2, 48), size=(6, 8), num_landmarks=10, weights=weights)
    images = noise(2, 3, 6, 8, seed=1)
    result = apply_function(operator, images, RESPONSES[response]).image
    for b in range(2):
        root = weights[b].sqrt()
        symmetric = root.unsqueeze(1) * operator.to_dense()[b] / root
        values, vectors = torch.linalg.eigh((symmetric + symmetric.mT) / 2)
        function = (vectors * RESPONSES[response](values.clamp(0, 1))) @ vectors.mT
        wanted = images[b].flatten(1) @ (function * root / root.unsqueeze(1)).mT
        torch.testing.assert_close(result[b].flatten(1), wanted, atol=1e-3, rtol=0)
    one = apply_function(operator, images[:1], RESPONSES[response]).image
    torch.testing.assert_close(one[0], result[0], atol=1e-3, rtol=0)
    single = nonlocal_operator(images[:1], num_landmarks=10)
    many = apply_function(single, images, RESPONSES[response]).image
    torch.testing.assert_close(
        many[1:], apply_function(single, images[1:], RESPONSES[response]).image, atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("response", ["power 0.5", "exp", "kink"])
def test_pixels_that_do_not_count_change_nothing(response: str) -> None:
    features, image = noise(1, 2, 48), noise(1, 2, 6, 8, seed=1)
    weights = torch.ones(1, 48, dtype=torch.float64)
    weights[:, 40:] = 0
    landmarks = features[:, :, :40:4]
    padded = operator_from_features(features, size=(6, 8), landmarks=landmarks, weights=weights)
    valid = operator_from_features(features[:, :, :40], size=(5, 8), landmarks=landmarks)
    result, wanted = (
        apply_function(operator, planes, RESPONSES[response]).image
        for operator, planes in ((padded, image), (valid, image[:, :, :5]))
    )
    assert result.isfinite().all()
    torch.testing.assert_close(result[:, :, :5], wanted, atol=1e-4, rtol=0)


@pytest.mark.parametrize("response", ["power 0.1", "exp", "kink"])
def test_degenerate_images(response: str) -> None:
    for image in (torch.full((1, 1, 1, 1), 0.4), torch.full((1, 3, 5, 4), 0.4), torch.zeros(1, 1, 4, 4)):
        operator = nonlocal_operator(image, num_landmarks=1)
        gain = float(RESPONSES[response](torch.ones(1)))
        torch.testing.assert_close(
            apply_function(operator, image, RESPONSES[response]).image, gain * image, atol=2e-4, rtol=0
        )
    flat = torch.zeros(1, 1, 6, 6)
    flat[..., 3:] = 1
    result = apply_function(nonlocal_operator(flat, num_landmarks=10), flat, RESPONSES[response])
    assert result.image.isfinite().all()
    empty = apply_function(nonlocal_operator(flat, num_landmarks=10), flat[:0], RESPONSES[response])
    assert empty.image.shape == (0, 1, 6, 6)


@pytest.mark.parametrize("response", ["power", "kink"])
def test_gradients(response: str) -> None:
    leaves = noise(1, 1, 4, 5), noise(1, 2, 4, 5, seed=1), torch.tensor(0.4, dtype=torch.float64)
    leaves = tuple(leaf.clone().requires_grad_() for leaf in leaves)

    def filtered(guide: Tensor, image: Tensor, number: Tensor) -> Tensor:
        operator = nonlocal_operator(guide, num_landmarks=6, photometric_bandwidth=0.4, landmarks="uniform")
        if response == "power":
            return apply_function(operator, image, lambda s: s**number).image
        return apply_function(operator, image, lambda s: (s - number).relu() + number * s).image

    assert torch.autograd.gradcheck(filtered, leaves, atol=1e-6)


@pytest.mark.parametrize("response", ["power 0.1", "kink"])
def test_batched_gradients(response: str) -> None:
    guide = noise(1, 1, 8, 8).requires_grad_()
    result = apply_function(nonlocal_operator(guide, num_landmarks=6), guide.detach(), RESPONSES[response]).image
    gradients = noise(3, *result.shape, seed=2)
    singly = torch.stack([torch.autograd.grad(result, guide, gradient, retain_graph=True)[0] for gradient in gradients])
    batched = torch.autograd.grad(result, guide, gradients, is_grads_batched=True)[0]
    assert singly.abs().max() > 1e-3
    torch.testing.assert_close(batched, singly)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")  # in torch.func itself
def test_transforms_for_a_fixed_operator() -> None:
    operator, image = nonlocal_operator(IMAGE, num_landmarks=20), IMAGE.expand(2, -1, -1, -1)
    power = torch.tensor(0.4, dtype=torch.float64)

    def total(power: Tensor) -> Tensor:
        return apply_function(operator, IMAGE, lambda s: s**power, tolerance=1e-6).image.square().sum()

    step = 1e-4
    slope = (total(power + step) - total(power - step)) / (2 * step)
    for transform in (torch.func.grad, torch.func.jacfwd, torch.func.jacrev):
        torch.testing.assert_close(transform(total)(power), slope, rtol=1e-3, atol=0)
    mapped = torch.func.vmap(lambda y: apply_function(operator, y.unsqueeze(0), torch.sqrt).image[0])(image)
    torch.testing.assert_close(mapped, apply_function(operator, image, torch.sqrt).image, atol=1e-3, rtol=0)


def test_a_missed_tolerance_warns_with_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanczos, "STEPS", (32, 32))
    operator = nonlocal_operator(IMAGE, num_landmarks=20, photometric_bandwidth=0.05)
    share = float(operator.remainder.median())
    with pytest.warns(UserWarning, match=r"response must be smooth where W has eigenvalues, .* after 32 products"):
        result = apply_function(operator, IMAGE, lambda s: s > share)
    assert 3e-4 < result.error < math.inf


def test_wrong_arguments() -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=20)
    with pytest.raises(ValueError, match=r"tolerance must be positive and finite, got 0\.0; pass"):
        apply_function(operator, IMAGE, torch.sqrt, tolerance=0.0)
    with pytest.raises(TypeError, match=r"operator must be a NonlocalOperator, got Spectrum; make it"):
        apply_function(operator.spectrum(), IMAGE, torch.sqrt)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"response must be finite, got .* NaN or infinite value\(s\); replace them"):
        apply_function(operator, IMAGE, lambda s: (s - 0.5).sqrt())


FORMS = [(0, 0), (1, 0), (5, 0), (0, 1), (3, 5)]
GUIDE = noise(2, 1, 5, 6)


def product(guide: Tensor, planes: Tensor, coefficients: Tensor, degree: int, poles: int) -> Tensor:
    operator = nonlocal_operator(guide, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform")
    parts = operator.factor, operator.scaling, operator.remainder
    form = rational_form(6, degree, poles, 1.0, 0.15)
    return rational_product(PixelMatrix(*parts), planes, form, coefficients)


@pytest.mark.parametrize(("degree", "poles"), FORMS)
def test_products_are_those_of_the_dense_matrix(degree: int, poles: int) -> None:
    planes, coefficients = noise(2, 3, 30, seed=1), noise(2, degree + 1 + poles, seed=2)
    dense = nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform").to_dense()
    values, vectors = torch.linalg.eigh((dense + dense.mT) / 2)
    form = rational_form(6, degree, poles, 1.0, 0.15)
    points = values.clamp(1e-6, 1).unsqueeze(2)
    terms = [torch.cos(torch.acos(2 * points - 1) * torch.arange(degree + 1)), form.shifts / (points + form.shifts)]
    gains = (torch.cat(terms, dim=2) @ coefficients.unsqueeze(2)).squeeze(2)
    wanted = planes @ ((vectors * gains.unsqueeze(1)) @ vectors.mT)
    torch.testing.assert_close(product(GUIDE, planes, coefficients, degree, poles), wanted, atol=2e-5, rtol=0)


@pytest.mark.parametrize(("degree", "poles"), FORMS)
def test_gradients_of_a_rational_product(degree: int, poles: int) -> None:
    leaves = GUIDE[:, :, 1:, 1:], noise(2, 2, 20, seed=1), noise(2, degree + 1 + poles, seed=2)
    leaves = tuple(leaf.clone().requires_grad_() for leaf in leaves)
    assert torch.autograd.gradcheck(
        lambda guide, planes, c: product(guide, planes, c, degree, poles), leaves, atol=1e-6
    )


def test_second_derivatives_for_a_fixed_operator() -> None:
    planes, coefficients = noise(2, 1, 16, seed=1).requires_grad_(), noise(2, 9, seed=2).requires_grad_()
    guide = GUIDE[:, :, 1:, 2:]
    assert torch.autograd.gradgradcheck(lambda y, c: product(guide, y, c, 3, 5), (planes, coefficients), atol=1e-6)


def test_poles_are_weighed_after_their_systems_are_solved() -> None:
    operator = nonlocal_operator(GUIDE, num_landmarks=7, photometric_bandwidth=0.4, landmarks="uniform")
    planes, weights, form = noise(2, 3, 30, seed=1), noise(2, 5, seed=2), rational_form(6, 0, 4, 1.0, 0.15)
    matrix = operator.matrix
    result = weigh_poles(planes, pole_terms(matrix, planes, form), weights)
    torch.testing.assert_close(result, rational_product(matrix, planes, form, weights))
