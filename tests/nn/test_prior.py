"""The prior against dense matrices in float64, its gradients, and its promise of contraction."""

import copy

import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalFilter, NonlocalOperator, NonlocalPrior, nonlocal_operator, operator_from_features
from nlfilter_torch.filtering.prior import Form
from tests import reference
from tests.problems import noise, picture

FORMS: tuple[Form, ...] = ("red", "plug-and-play")
WEIGHTS = (1e-6, 0.01, 0.5, 1.0, 1.001, 3.0, 300.0)
IMAGE = picture("camera", 20, 20)


def dense_prox(w: Tensor, g: float, form: Form) -> Tensor:
    """By eigenvalues, as the inverse of a nearly singular matrix has rounding errors of its own."""
    if not torch.allclose(w, w.mT, atol=1e-4):
        unit = torch.eye(len(w), dtype=w.dtype)
        return (
            torch.linalg.inv(unit + g * (unit - w)) if form == "red" else w @ torch.linalg.inv((1 - g) * w + g * unit)
        )
    values, vectors = torch.linalg.eigh((w + w.mT) / 2)
    values = values.clamp(min=0.0)
    return (vectors * (1 / (1 + g * (1 - values)) if form == "red" else values / ((1 - g) * values + g))) @ vectors.mT


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_proximal_map_is_that_of_the_dense_matrix_to_rounding(form: Form, dtype: torch.dtype) -> None:
    images = noise(1, 3, 20, 20, dtype=dtype)
    for bandwidth in (5 / 255, 40 / 255):
        operator = nonlocal_operator(IMAGE.to(dtype), num_landmarks=30, photometric_bandwidth=bandwidth)
        w, prior = operator.to_dense()[0].double(), NonlocalPrior(operator, form)
        for g in WEIGHTS:
            wanted = (dense_prox(w, g, form) @ images[0].double().flatten(1).mT).mT
            error = (prior.prox(images, g)[0].double().flatten(1) - wanted).abs().max()
            assert error < 200 * torch.finfo(dtype).eps * max(1.0, g), (bandwidth, g)


@pytest.mark.parametrize("form", FORMS)
def test_with_a_landmark_for_every_pixel_the_prior_is_that_of_the_dense_paper(form: Form) -> None:
    guide = picture("camera", 10, 10)
    operator = nonlocal_operator(guide, num_landmarks=100, landmarks="uniform", photometric_bandwidth=0.1)
    w = torch.from_numpy(reference.filter_matrix(guide[0, 0].numpy(), 5, 0.1))
    found = NonlocalPrior(operator, form).prox(guide, 0.7)
    wanted = (dense_prox(w, 0.7, form) @ guide.flatten()).view_as(guide)
    torch.testing.assert_close(found, wanted, atol=1e-3, rtol=0)  # the jitter of the landmark block


def test_energy_and_gradient_belong_together() -> None:
    operator = nonlocal_operator(IMAGE.repeat(2, 1, 1, 1), num_landmarks=30, photometric_bandwidth=0.1)
    prior, images = NonlocalPrior(operator), noise(2, 3, 20, 20).requires_grad_()
    energies = prior.energy(images)
    assert energies.shape == (2,)
    (slope,) = torch.autograd.grad(energies.sum(), images)
    torch.testing.assert_close(slope, prior.gradient(images))
    rows = images.detach()[1].flatten(1)
    missing = torch.eye(400, dtype=torch.float64) - operator.to_dense()[1]
    torch.testing.assert_close(energies[1].detach(), (rows @ missing * rows).sum() / 2)
    assert (NonlocalPrior(nonlocal_operator(IMAGE)).energy(torch.ones_like(IMAGE)).abs() < 1e-8).all()


@pytest.mark.parametrize("form", FORMS)
def test_with_weights_the_map_is_the_minimum_in_their_product(form: Form) -> None:
    weights = noise(2, 48, seed=3) + 0.2
    operator = operator_from_features(noise(2, 2, 48), size=(6, 8), num_landmarks=10, weights=weights)
    prior, images = NonlocalPrior(operator, form), noise(2, 3, 6, 8, seed=1)
    found = prior.prox(images, torch.tensor([0.4, 2.5]))
    for b, g in enumerate((0.4, 2.5)):
        wanted = images[b].flatten(1) @ dense_prox(operator.to_dense()[b], g, form).mT
        torch.testing.assert_close(found[b].flatten(1), wanted)
    if form == "red":
        near = prior.prox(images, 0.7)
        torch.testing.assert_close(near + 0.7 * prior.gradient(near), images)
        nearby = near + 1e-3 * noise(*near.shape, seed=9)

        def objective(z: Tensor) -> Tensor:
            squares = (weights.view(2, 1, 6, 8) * (z - images).square()).sum((1, 2, 3))
            return 0.7 * prior.energy(z) + squares / 2

        assert (objective(near) < objective(nearby)).all()


@pytest.mark.parametrize("form", FORMS)
def test_gradients_reach_image_weight_guide_and_bandwidths(form: Form) -> None:
    guide, image = noise(2, 1, 4, 5), noise(2, 2, 4, 5, seed=1)
    held = nonlocal_operator(guide, num_landmarks=6, photometric_bandwidth=0.3, spatial_bandwidth=4.0).assignment
    assert held is not None

    def restored(guide: Tensor, image: Tensor, g: Tensor, photometric: Tensor, spatial: Tensor) -> Tensor:
        operator = nonlocal_operator(
            guide, landmarks=held, photometric_bandwidth=photometric, spatial_bandwidth=spatial, tolerance=1e-13
        )
        return NonlocalPrior(operator, form).prox(image, g)

    numbers = [torch.tensor(v, dtype=torch.float64) for v in ([0.3, 1.7], 0.3, 4.0)]
    inputs = [tensor.clone().requires_grad_() for tensor in (guide, image, *numbers)]
    assert torch.autograd.gradcheck(restored, inputs, atol=1e-5, fast_mode=True)


def test_a_fixed_operator_is_differentiable_twice_in_the_image() -> None:
    prior = NonlocalPrior(nonlocal_operator(noise(1, 1, 5, 6), num_landmarks=6, photometric_bandwidth=0.3))
    image = noise(1, 2, 5, 6, seed=1).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: prior.prox(x, 0.5).square(), image)


@pytest.mark.parametrize("form", FORMS)
def test_batches_are_those_of_single_images(form: Form) -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.1)
    prior, images, g = NonlocalPrior(operator, form), noise(3, 2, 20, 20), torch.tensor([0.5, 0.0, 20.0])
    together = prior.prox(images, g)
    for b in range(3):
        torch.testing.assert_close(together[b : b + 1], prior.prox(images[b : b + 1], float(g[b])))
    torch.testing.assert_close(together[1], images[1], atol=0, rtol=0)
    joined = NonlocalPrior(NonlocalOperator.cat([operator] * 3), form)
    torch.testing.assert_close(joined.prox(images[:1], g), torch.cat([prior.prox(images[:1], float(v)) for v in g]))
    assert prior.prox(images[:0], 0.5).shape == (0, 2, 20, 20)


def test_plug_and_play_is_w_at_one_and_the_identity_at_zero() -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.1)
    prior, image = NonlocalPrior(operator, "plug-and-play"), noise(1, 2, 20, 20)
    torch.testing.assert_close(prior(image, 1.0), operator @ image)
    torch.testing.assert_close(prior(image, 0.0), image, atol=0, rtol=0)


def test_the_layer_moves_with_its_operator_and_keeps_no_matrix_of_another() -> None:
    prior = NonlocalPrior(nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.1))
    image = noise(1, 1, 20, 20)
    before = prior.prox(image, 0.5)
    single = copy.deepcopy(prior).float()
    assert single.operator.dtype == torch.float32
    torch.testing.assert_close(single.prox(image.float(), 0.5), before.float(), atol=1e-5, rtol=0)
    prior.operator = nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.3)
    torch.testing.assert_close(prior.prox(image, 0.5), NonlocalPrior(prior.operator).prox(image, 0.5))
    assert "form='red'" in repr(prior)


def test_points_and_volumes_have_priors() -> None:
    volume = noise(1, 1, 4, 5, 6)
    prior = NonlocalPrior(nonlocal_operator(volume, num_landmarks=8, photometric_bandwidth=0.3, patch_size=3))
    assert prior.prox(volume, 0.5).shape == volume.shape
    assert prior.prox(volume.flatten(2), 0.5).shape == (1, 1, 120)
    assert "4x5x6" in repr(prior)


@pytest.mark.parametrize(
    ("g", "message"),
    [
        (-0.1, "g must be at least 0 and finite"),
        (float("inf"), "g must be"),
        (float("nan"), "g must be"),
        (torch.tensor([1.0, 2.0]), "g must be a number or have shape"),
        (1e9, "g must be at most 1e\\+05 in torch.float32"),
    ],
)
def test_weights_that_are_refused(g: float | Tensor, message: str) -> None:
    operator = nonlocal_operator(IMAGE.float(), num_landmarks=30, landmarks="uniform", photometric_bandwidth=0.3)
    with pytest.raises(ValueError, match=message):
        NonlocalPrior(operator).prox(IMAGE.float(), g)


def test_what_is_refused() -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=30)
    with pytest.raises(TypeError, match="operator must be"):
        NonlocalPrior(IMAGE)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="form must be one of 'red', 'plug-and-play'"):
        NonlocalPrior(operator, "pnp")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="infinite outside the range of W"):
        NonlocalPrior(operator, "plug-and-play").energy(IMAGE)
    with pytest.raises(ValueError, match="form must be 'red' for the gradient"):
        NonlocalPrior(operator, "plug-and-play").gradient(IMAGE)
    for method in (NonlocalPrior(operator).energy, lambda x: NonlocalPrior(operator).prox(x, 1.0)):
        with pytest.raises(ValueError, match="height and width of the operator, 20x20, got 10x20"):
            method(IMAGE[:, :, :10])


def test_the_promise_of_a_known_problem_is_exact() -> None:
    """If A is the identity, the factor is 1 - t, since W keeps constant images."""
    prior = NonlocalPrior(nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.1))
    found = prior.contraction(lambda x: x, lambda y: y, strength=0.5, step=0.25)
    assert 0.75 <= float(found.factor) + 1e-9 < 0.76
    assert abs(float(found.squared_norm) - 1) < 1e-9
    assert abs(float(found.at_least) - 0.75) < 0.01
    lost = prior.contraction(lambda x: x - x.mean((2, 3), keepdim=True), lambda y: y - y.mean((2, 3), keepdim=True))
    assert float(lost.factor) > 1 - 1e-9  # constant images are lost by A and by I - W


def test_what_a_contraction_refuses_and_warns_of() -> None:
    operator = nonlocal_operator(IMAGE, num_landmarks=30, photometric_bandwidth=0.1)
    prior = NonlocalPrior(operator)
    with pytest.warns(UserWarning, match="forward must be linear"):
        prior.contraction(torch.sin, lambda y: y)
    with pytest.raises(ValueError, match="transpose must satisfy"):
        prior.contraction(lambda x: x.cumsum(3), lambda y: y.cumsum(3))
    with pytest.raises(ValueError, match="transpose must return images of the shape"):
        prior.contraction(lambda x: x[..., ::2], lambda y: y)
    with pytest.raises(ValueError, match=r"step must be below 2 / \|A\|\^2, 2, got 3"):
        prior.contraction(lambda x: x, lambda y: y, step=3.0)
    with pytest.raises(ValueError, match="forward must not be zero"):
        prior.contraction(lambda x: 0 * x, lambda y: 0 * y)
    with pytest.raises(ValueError, match="failure must be between 0 and 1"):
        prior.contraction(lambda x: x, lambda y: y, failure=0.0)
    with pytest.raises(ValueError, match="strength must be positive"):
        prior.contraction(lambda x: x, lambda y: y, strength=0.0)
    with pytest.raises(TypeError, match="forward must be a function"):
        prior.contraction(IMAGE, lambda y: y)  # type: ignore[arg-type]


def test_a_learned_filter_may_be_the_prior() -> None:
    layer = NonlocalFilter(photometric_bandwidth=0.1, learn=("photometric_bandwidth",), num_landmarks=20).double()
    NonlocalPrior(layer.affinity(IMAGE)).prox(IMAGE, 0.5).square().sum().backward()
    parameter = layer.affinity.get_parameter("log_photometric_bandwidth")
    assert parameter.grad is not None
    assert parameter.grad.abs() > 0
