"""The non-local block: what it computes, its shapes, gradients, extreme features, and errors."""

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nlfilter_torch import NonlocalBlock
from nlfilter_torch.nn.block import coordinates, standardised
from tests import reference
from tests.problems import noise

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def block(channels: int = 6, dtype: torch.dtype = torch.float64, **options: Any) -> NonlocalBlock:
    """A block with reproducible weights, none of them zero."""
    layer = NonlocalBlock(channels, **options).to(dtype)
    for seed, (name, parameter) in enumerate(layer.named_parameters()):
        if not name.startswith("log_"):
            parameter.data = noise(*parameter.shape, seed=seed, dtype=dtype) - 0.3
    return layer


def dense(layer: NonlocalBlock, x: Tensor, places: Tensor | None = None) -> Tensor:
    """The block of one feature map with the whole matrix, by the reference."""
    points = x[0].flatten(1).double()
    embedded = layer.embedding.weight[:, :, 0].double() @ points
    embedded = embedded - embedded.mean(1, keepdim=True)
    embedded = embedded * layer.fixed["temperature"] / embedded.square().sum(0).mean().sqrt()
    features = (embedded if places is None else torch.cat([embedded, places])).detach().mT.numpy()
    attention = torch.from_numpy(reference.balanced(reference.affinity(features, features), steps=200))
    attended = nn.functional.conv1d(points[None], layer.value.weight.double(), layer.value.bias.double()) @ attention
    added = nn.functional.conv1d(attended, layer.output.weight.double(), layer.output.bias.double())
    return x + layer.norm(added.to(x)).view(x.shape)


@DTYPES
@pytest.mark.parametrize("norm", ["batch", "none"])
def test_with_all_pixels_as_landmarks_it_is_the_dense_attention(dtype: torch.dtype, norm: Any) -> None:
    layer = block(dtype=dtype, num_landmarks=200, norm=norm).eval()
    x = noise(1, 6, 8, 9, dtype=dtype)
    torch.testing.assert_close(layer(x), dense(layer, x), rtol=2e-4, atol=2e-4)  # of the jitter of the landmark block


def test_coordinates_count_in_frames_rows_and_columns() -> None:
    places = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in (2, 3, 5)), indexing="ij")).flatten(1)
    torch.testing.assert_close(coordinates((2, 3, 5), places)[0], places)
    layer = block(num_landmarks=30, spatial_bandwidth=2.0, temperature=1.0, norm="none")
    x = noise(1, 6, 2, 3, 5)
    torch.testing.assert_close(layer(x), dense(layer, x, places / 2), rtol=2e-4, atol=2e-4)


def test_frames_and_tokens_are_folded() -> None:
    layer = block(num_landmarks=12)
    clip = noise(2, 6, 3, 4, 5)
    flat = layer(clip.flatten(2))
    assert layer(clip).shape == clip.shape
    torch.testing.assert_close(layer(clip).flatten(2), flat)
    torch.testing.assert_close(layer(clip.flatten(2, 3)).flatten(2), flat)
    assert layer(clip.to(memory_format=torch.channels_last_3d)).equal(layer(clip))


@pytest.mark.parametrize("norm", ["batch", "none"])
def test_a_new_block_changes_nothing_and_learns(norm: Any) -> None:
    layer, x = NonlocalBlock(8, num_landmarks=16, norm=norm), noise(2, 8, 7, 6, dtype=torch.float32)
    assert layer(x).equal(x)
    optimizer = torch.optim.SGD(layer.parameters(), lr=0.1)
    for _ in range(2):  # what comes before the zeros has gradients from the second step on
        optimizer.zero_grad()
        (layer(x) * noise(*x.shape, seed=1, dtype=torch.float32)).sum().backward()
        optimizer.step()
    for name, parameter in layer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        if name != "output.bias":  # batch normalisation removes it
            assert parameter.grad.abs().max() > 0, name


def test_gradients_are_those_of_finite_differences() -> None:
    options = {"num_landmarks": 8, "landmarks": "uniform", "spatial_bandwidth": 3.0}
    layer = block(4, **options, learn=("temperature", "spatial_bandwidth"))
    x = noise(1, 4, 4, 5).requires_grad_()
    names = [name for name, _ in layer.named_parameters()]

    def output(x: Tensor, *values: Tensor) -> Tensor:
        result: Tensor = torch.func.functional_call(layer, dict(zip(names, values, strict=True)), (x,))
        return result

    assert torch.autograd.gradcheck(output, (x, *layer.parameters()), atol=1e-5)


@DTYPES
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4, 1e18])
def test_attention_does_not_depend_on_the_scale_of_the_embedding(dtype: torch.dtype, scale: float) -> None:
    layer, x = block(dtype=dtype, num_landmarks=20, norm="none"), noise(1, 6, 8, 8, dtype=dtype)
    scaled = copy.deepcopy(layer)
    with torch.no_grad():
        scaled.embedding.weight *= scale
    torch.testing.assert_close(scaled(x), layer(x), rtol=1e-3, atol=1e-3)
    x.requires_grad_()
    scaled(x).square().sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


@DTYPES
@pytest.mark.parametrize("value", [0.0, 0.7, 1e4, 1e20])
def test_equal_pixels_attend_to_all_alike(dtype: torch.dtype, value: float) -> None:
    layer = block(dtype=dtype, num_landmarks=5, norm="none")
    x = torch.full((1, 6, 4, 5), value, dtype=dtype, requires_grad=True)
    values = layer.output(layer.value(x.flatten(2))).view(x.shape)
    torch.testing.assert_close(layer(x), x + values, rtol=1e-4, atol=1e-4)
    layer(x).sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()
    assert standardised(x.flatten(2)).abs().max() < 0.05  # only what rounding leaves


def test_one_pixel_two_colours_and_an_empty_batch() -> None:
    layer = block(num_landmarks=5, norm="none")
    assert layer(noise(2, 6, 1, 1)).isfinite().all()
    assert layer(noise(0, 6, 3, 4)).shape == (0, 6, 3, 4)
    colours = torch.zeros(1, 6, 4, 4, dtype=torch.float64)
    colours[..., 2:] = 1.0
    assert layer(colours)[..., 2:].std((2, 3)).max() < 1e-5


def test_autocast_and_half_precision() -> None:
    layer, x = block(dtype=torch.float32, num_landmarks=20), noise(1, 6, 8, 8, dtype=torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = layer(x)
    torch.testing.assert_close(rounded.float(), layer(x), rtol=0.1, atol=0.1)
    half = layer.bfloat16()(x.bfloat16())
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half, rounded.bfloat16(), rtol=0.2, atol=0.2)


def test_equal_calls_give_equal_results_and_draw_no_random_number() -> None:
    layer, x = block(dtype=torch.float32, num_landmarks=20), noise(2, 6, 16, 16, dtype=torch.float32)
    state = torch.get_rng_state()
    assert layer(x).equal(layer(x))
    assert torch.get_rng_state().equal(state)
    again = NonlocalBlock(6, num_landmarks=20)
    again.load_state_dict(layer.state_dict())
    layer.eval(), again.eval()
    assert again(x).equal(layer(x))


def test_values_bound_the_result() -> None:
    layer = block(num_landmarks=20, norm="none")
    x = noise(1, 6, 10, 10)
    attended = layer(x) - x
    values = layer.output(layer.value(x.flatten(2)))
    torch.testing.assert_close(attended.flatten(2).mean(2), values.mean(2))  # columns sum to 1


def test_description() -> None:
    text = repr(NonlocalBlock(8, spatial_bandwidth=9.0))
    assert "8, num_landmarks=64, landmarks='kmeans', temperature=2, spatial_bandwidth=9" in text


def map_of(*shape: int) -> Tensor:
    return torch.zeros(shape)
