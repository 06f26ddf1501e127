"""Derivatives by ``torch.func`` and ``torch.autograd.functional``, as in the table of docs/training.md."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, grad, vmap

from docs import transforms
from nlfilter_torch import (
    NonlocalDenoiser,
    NonlocalFilter,
    detail_layers,
    nonlocal_operator,
    polynomial_filter,
    segment_mask,
    spectral_filter,
)
from tests.problems import noise

PAGE = Path(__file__).resolve().parents[2] / "docs" / "training.md"
OPTIONS: dict[str, Any] = {"num_landmarks": 7, "photometric_bandwidth": 0.3}
GUIDES, IMAGES = noise(3, 1, 6, 7), noise(3, 2, 6, 7, seed=1)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.* is deprecated:DeprecationWarning")
def test_the_table_of_transforms_is_measured() -> None:
    table = transforms.table()
    assert not [cell for row in table.splitlines()[2:] for cell in row.split(" | ")[1:] if "error" in cell]
    assert table in PAGE.read_text(encoding="utf-8"), "run python -m docs.transforms docs/training.md"


def test_gradients_per_sample_with_an_operator_for_each() -> None:
    alpha = torch.tensor([2.0, 1.5, 1.0], dtype=torch.float64)
    operators, targets = nonlocal_operator(GUIDES, **OPTIONS), IMAGES.flip(0)

    def loss(alpha: Tensor, number: Tensor, image: Tensor, target: Tensor) -> Tensor:
        return (polynomial_filter(operators[number], image[None], alpha) - target).square().mean()

    gradients = vmap(grad(loss), in_dims=(None, 0, 0, 0))(alpha, torch.arange(3), IMAGES, targets)
    rows = alpha.expand(3, -1).clone().requires_grad_()
    losses = (polynomial_filter(operators, IMAGES, rows) - targets).square().mean((1, 2, 3))
    torch.testing.assert_close(gradients, torch.autograd.grad(losses.sum(), rows)[0])


def test_gradients_per_sample_of_a_layer_with_a_fixed_guide() -> None:
    layer = NonlocalFilter((2.0, 1.5, 1.0), residual=0.5, learn=("alpha", "residual"), **OPTIONS).double()
    parameters = dict(layer.named_parameters())

    def loss(parameters: dict[str, Tensor], image: Tensor) -> Tensor:
        return functional_call(layer, parameters, (image[None], GUIDES[:1] / 2)).square().mean()

    gradients = vmap(grad(loss), in_dims=(None, 0))(parameters, IMAGES)
    for image, *ours in zip(IMAGES, *gradients.values(), strict=True):
        expected = torch.autograd.grad(layer(image[None], GUIDES[:1] / 2).square().mean(), list(parameters.values()))
        for gradient, theirs in zip(ours, expected, strict=True):
            torch.testing.assert_close(gradient, theirs)


def test_batched_gradients_of_a_network_for_the_guide() -> None:
    network = nn.Conv2d(1, 2, 3, padding=1, dtype=torch.float64)
    result = nonlocal_operator(network(GUIDES[:1]), **OPTIONS).spectrum().eigenvalues
    basis = torch.eye(result.numel(), dtype=torch.float64).view(-1, *result.shape)
    weights = list(network.parameters())
    batched = torch.autograd.grad(result, weights, basis, is_grads_batched=True, retain_graph=True)
    mapped = vmap(lambda row: torch.autograd.grad(result, weights, row, retain_graph=True))(basis)
    for number, row in enumerate(basis):
        expected = torch.autograd.grad(result, weights, row, retain_graph=True)
        for ours, others, theirs in zip(batched, mapped, expected, strict=True):
            torch.testing.assert_close(ours[number], theirs)
            torch.testing.assert_close(others[number], theirs)


@pytest.mark.parametrize("name", ["guide", "photometric_bandwidth", "spatial_bandwidth", "patch_weights", "weights"])
def test_the_refusal_names_what_is_transformed(name: str) -> None:
    fixed = {"guide": GUIDES[:1], "photometric_bandwidth": torch.tensor(0.3), "spatial_bandwidth": torch.tensor(5.0)}
    fixed |= {"patch_weights": torch.ones(3, 3), "weights": torch.ones_like(GUIDES[:1])}
    with pytest.raises(TypeError, match=rf"^{name} must not be transformed by torch.func"):
        grad(lambda value: nonlocal_operator(**fixed | {name: value, "num_landmarks": 7}).factor.sum())(fixed[name])


def test_the_denoiser_refuses_transforms_of_its_weights() -> None:
    denoiser = NonlocalDenoiser()
    with pytest.raises(TypeError, match=r"^weights must not be transformed"):
        grad(lambda weights: functional_call(denoiser, weights, (GUIDES[:1].float(), 0.1)).sum())(
            {name: value.detach() for name, value in denoiser.named_parameters()}
        )


def test_values_made_in_inference_mode_are_trained_with_later() -> None:
    layer = NonlocalFilter((2.0, 1.5, 1.0), residual=0.5, learn=("alpha", "residual"), **OPTIONS).double()
    with torch.inference_mode():
        layer(IMAGES)
        operator = nonlocal_operator(GUIDES, **OPTIONS)
        spectrum, shared, image = operator.spectrum(), operator[1:], IMAGES.clone()
        vectors, dense = spectrum.eigenvectors, operator.to(torch.float32).to(torch.float64)
    power = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    for filtered in (
        layer(IMAGES),
        layer(image),
        layer.sliders(operator, image),
        layer.sliders(shared, IMAGES[1:]),
        layer.sliders(dense, IMAGES),
        spectral_filter(spectrum, image, lambda s: s**power),
        power * vectors,
        detail_layers(operator, image) * power,
        operator @ (IMAGES * power),
        segment_mask(spectrum, (IMAGES > 0.5).double()) * power,
    ):
        filtered.square().mean().backward()


def test_an_image_made_in_inference_mode_is_a_guide_that_is_trained_with() -> None:
    layer = NonlocalFilter(learn=("photometric_bandwidth", "spatial_bandwidth"), spatial_bandwidth=5.0, **OPTIONS)
    with torch.inference_mode():
        image = IMAGES.clone()
    layer.double()(image).square().mean().backward()
    assert layer.affinity.log_photometric_bandwidth.grad is not None
