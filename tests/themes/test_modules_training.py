"""The training conventions listed in docs/training.md, except the transforms of torch; one test for each row."""

import copy
import pickle

import pytest
import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from nlfilter_torch import compose_alpha, filter_regions, nonlocal_operator, spectral_filter
from nlfilter_torch.photo import Look
from tests.layers import backward, everything, image, untouched
from tests.problems import seeded


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_leaves_the_filter_in_full_precision(dtype: torch.dtype) -> None:
    layer = everything()
    expected, exact = layer(image()), backward(layer, image())
    layer.zero_grad()
    with torch.autocast("cpu", dtype=dtype):
        filtered = layer(image())
        inside = backward(layer, image())  # torch advises against it, as operations outside this package are rounded
    torch.testing.assert_close(filtered, expected, atol=0, rtol=0)
    layer.zero_grad()
    filtered.square().mean().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, exact[name], atol=0, rtol=0)
        assert (inside[name] - exact[name]).abs().max() <= 0.01 * exact[name].abs().max()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_network_before_the_layer_learns(dtype: torch.dtype) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = nn.Conv2d(3, 4, 3, padding=1)
    layer = everything(photometric_bandwidth=0.5)
    with torch.autocast("cpu", dtype=dtype):
        guide = network(image())
        assert guide.dtype == dtype
        filtered = layer(image(), guide)
        assert filtered.dtype == torch.float32
        loss = filtered.square().mean()
    loss.backward()
    for parameter in (*network.parameters(), *layer.parameters()):
        assert parameter.grad.isfinite().all()
    assert network.weight.grad.abs().max() > 0


def test_autocast_on_a_dtype_that_cannot_work_is_told() -> None:
    layer = everything()
    with untouched(layer):
        # torch refuses to cast to it, warns, and continues without autocast.
        with pytest.warns(UserWarning, match="autocast"), torch.autocast("cpu", dtype=torch.float64):
            torch.testing.assert_close(layer(image()), everything()(image()), atol=0, rtol=0)
        with pytest.raises(TypeError, match="guide must have a floating-point dtype"):
            layer(image(), guide=image().to(torch.float8_e5m2))


@pytest.mark.parametrize("reentrant", [False, True])
def test_gradient_checkpointing(reentrant: bool) -> None:
    layer = everything()
    exact = backward(layer, image())
    layer.zero_grad()
    tracked = image().requires_grad_()  # the reentrant variant requires an input with a gradient
    checkpoint(layer, tracked, use_reentrant=reentrant).square().mean().backward()
    for name, parameter in layer.named_parameters():  # to rounding: torch may sum contributions in another order
        torch.testing.assert_close(parameter.grad, exact[name], atol=1e-7, rtol=1e-5)


@pytest.mark.client("`state_dict`, pickle, deep copy", "with the generator's state")
@pytest.mark.parametrize("generator", [False, True])
def test_state_dict_pickle_and_deep_copy(generator: bool) -> None:
    layer = everything(generator=seeded(3) if generator else None)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter += 0.1
    copies = [copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), everything()]
    copies[2].load_state_dict(layer.state_dict())
    if generator:
        copies[2].affinity.generator = seeded(3)
    expected = [layer(image()), layer(image())]
    assert torch.equal(*expected) != generator  # a generator advances, and each copy has its own
    for other in copies:
        for output in expected:
            torch.testing.assert_close(other(image()), output, atol=0, rtol=0)
        assert not {id(p) for p in other.parameters()} & {id(p) for p in layer.parameters()}


@pytest.mark.parametrize("frozen", ["sliders.alpha", "affinity.log_photometric_bandwidth"])
def test_frozen_parameters_stay_and_the_others_move(frozen: str) -> None:
    layer = everything()
    layer.get_parameter(frozen).requires_grad_(False)
    before = copy.deepcopy(layer.state_dict())
    result = backward(layer, image())
    assert frozen not in result
    torch.optim.SGD(layer.parameters(), lr=0.1).step()
    for name, value in layer.state_dict().items():
        assert torch.equal(value, before[name]) == (name == frozen), name


def test_a_layer_that_is_frozen_whole_costs_no_graph() -> None:
    layer = everything().requires_grad_(False)
    assert not layer(image()).requires_grad
    tracked = image().requires_grad_()
    layer(tracked).sum().backward()
    assert tracked.grad is not None


def test_gradient_accumulation_is_the_gradient_of_the_sum() -> None:
    layer = everything()
    images = [image(seed) for seed in range(3)]
    separate = [backward(layer, picture) for picture in images]
    layer.zero_grad()
    for picture in images:
        layer(picture).square().mean().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, sum(g[name] for g in separate))


def test_gradient_of_a_batch_is_that_of_its_images() -> None:
    layer = everything()
    together = backward(layer, image())
    alone = [backward(layer, picture.unsqueeze(0)) for picture in image()]
    for name, gradient in together.items():
        torch.testing.assert_close(gradient, (alone[0][name] + alone[1][name]) / 2, rtol=1e-3, atol=1e-6)


def test_evaluation_keeps_nothing_from_call_to_call() -> None:
    layer = everything().eval()
    attributes = {name: set(vars(module)) for name, module in layer.named_modules()}
    with torch.inference_mode():
        first = layer(image())
        layer(image(1), guide=image(2))
        torch.testing.assert_close(layer(image()), first, atol=0, rtol=0)
        layer.sliders.alpha.mul_(2.0)
        assert not torch.allclose(layer(image()), first)
    assert {name: set(vars(module)) for name, module in layer.named_modules()} == attributes
    torch.testing.assert_close(layer.train()(image()), layer.eval()(image()), atol=0, rtol=0)


def test_the_global_generator_is_not_used() -> None:
    before = torch.random.get_rng_state()
    backward(everything(), image())
    backward(everything(generator=seeded(1), landmarks="random"), image())
    assert torch.equal(torch.random.get_rng_state(), before)


def test_autocast_does_not_reach_eigenvectors_sliders_of_regions_and_colours() -> None:
    operator = nonlocal_operator(image()[:1], num_landmarks=20)
    size = tuple(image().shape[-2:])
    masks = torch.zeros(1, 2, *size)
    masks[:, 0, : size[0] // 2], masks[:, 1, size[0] // 2 :] = 1, 0.7
    sliders = torch.tensor([[3.0, 3.0, 4.0, 1.05], [1.0, 0.9, 1.1, 1.0]])
    many = torch.rand(1, 12, *size, generator=seeded(3))
    look = Look({"matrix": torch.eye(3) + 0.03}, photometric_bandwidth=0.1, num_landmarks=30)

    def results() -> list[torch.Tensor]:
        spectrum = operator.spectrum()
        vectors = spectrum.eigenvectors
        return [
            vectors,
            spectral_filter(spectrum, many, torch.sqrt),
            compose_alpha(masks, sliders),
            filter_regions(operator, image()[:1], masks, sliders),
            look(image()[:1]),
        ]

    wanted = results()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = results()
    for inside, outside in zip(result, wanted, strict=True):
        torch.testing.assert_close(inside, outside, rtol=0, atol=0)
