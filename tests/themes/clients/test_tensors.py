"""Operators and layers under torch: moving, saving, fake tensors, empty batches and transforms."""

import io
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch.autograd import forward_ad
from torch.func import jvp, vmap

from nlfilter_torch import (
    DiffusionMask,
    NonlocalFilter,
    NonlocalOperator,
    SegmentMask,
    detail_layers,
    diffusion_mask,
    fit_filter,
    nonlocal_operator,
    operator_from_features,
    polynomial_filter,
    spectral_filter,
)
from tests.layers import ALPHA, EVERYTHING, OPTIONS, image
from tests.pairwise import each_value

SLIDERS = torch.tensor(ALPHA)


def operator(**options: Any) -> NonlocalOperator:
    return nonlocal_operator(image(batch=1), **(OPTIONS | options))


def loaded(value: Any) -> Any:
    stream = io.BytesIO()
    torch.save(value, stream)
    stream.seek(0)
    return torch.load(stream, weights_only=True)


def tensors(value: Any) -> list[Tensor]:
    """All tensors of nested dataclasses and tuples."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, tuple):
        return [tensor for item in value for tensor in tensors(item)]
    if not is_dataclass(value):
        return []
    return [tensor for field in fields(value) for tensor in tensors(getattr(value, field.name))]


def edited(operator: NonlocalOperator, picture: Tensor) -> Tensor:
    """Apply every part of an operator: the operator, its spectrum, and columns of another picture."""
    fitted = fit_filter(operator, picture)
    return torch.cat([polynomial_filter(operator, picture, SLIDERS, residual=0.5), fitted(picture.flip(3), SLIDERS)])


# --- moved


@pytest.mark.client("`operator.to(device or dtype)`", "float32 and float64; spectra and fitted filters, too")
@pytest.mark.parametrize("target", [torch.float64, torch.zeros((), dtype=torch.float64)])
def test_an_operator_in_another_precision_is_the_same_filter(target: Any) -> None:
    single, picture = operator(spatial_bandwidth=9.0, landmarks="uniform"), image(1, 1)
    double = single.to(target)
    assert {t.dtype for t in tensors(double) if t.is_floating_point()} == {torch.float64}
    torch.testing.assert_close(edited(double, picture), edited(single, picture), atol=2e-5, rtol=0)
    there_and_back = double.to("cpu", torch.float32)
    torch.testing.assert_close(edited(there_and_back, picture), edited(single, picture), atol=0, rtol=0)


def test_everything_moves_to_another_device() -> None:
    parts = operator(), operator().spectrum(), fit_filter(operator(), image(batch=1))
    for value in parts:
        moved = value.to("meta")
        assert {t.device.type for t in tensors(moved)} == {"meta"}
        assert [(t.shape, t.dtype) for t in tensors(moved)] == [(t.shape, t.dtype) for t in tensors(value)]


def test_half_precision_is_refused() -> None:
    with pytest.raises(TypeError, match=r"^dtype must be torch.float32 or torch.float64, got torch.bfloat16;"):
        operator().to(torch.bfloat16)


def test_moving_keeps_gradients() -> None:
    guide = image(batch=1).requires_grad_()
    nonlocal_operator(guide, **OPTIONS).to(torch.float64).matmul(image(1, 1)).square().sum().backward()
    assert guide.grad is not None
    assert bool(guide.grad.abs().sum() > 0)


# --- saved


@pytest.mark.client(
    "`torch.load(..., weights_only=True)`",
    "after `from nlfilter_torch import NonlocalOperator` (or `Spectrum`, `FittedFilter`)",
)
@pytest.mark.parametrize("landmarks", ["kmeans", "uniform"])
def test_operators_spectra_and_fitted_filters_load_as_weights_only(landmarks: str) -> None:
    picture = image(1, 1)
    saved = operator(landmarks=landmarks, spatial_bandwidth=torch.tensor(9.0))
    torch.testing.assert_close(edited(loaded(saved), picture), edited(saved, picture), atol=0, rtol=0)
    spectrum = saved.spectrum()
    _ = spectrum.eigenvectors  # is cached in the spectrum
    again = loaded(spectrum)
    torch.testing.assert_close(again.eigenvectors, spectrum.eigenvectors, atol=0, rtol=0)
    torch.testing.assert_close(
        spectral_filter(again, picture, torch.sqrt), spectral_filter(spectrum, picture, torch.sqrt), atol=0, rtol=0
    )
    fitted = fit_filter(saved, picture)
    torch.testing.assert_close(loaded(fitted)(picture, SLIDERS), fitted(picture, SLIDERS), atol=0, rtol=0)


# --- without values


def build_and_filter(picture: Tensor, **options: Any) -> Tensor:
    layer = NonlocalFilter(ALPHA, learn=EVERYTHING, **(OPTIONS | {"spatial_bandwidth": 9.0} | options))
    return (layer.to("meta") if picture.is_meta else layer)(picture)  # torch converts no fake parameters


@pytest.mark.client('device "meta", `FakeTensorMode`', "yes; edits with scribbles need values")
@pytest.mark.parametrize(
    ("options", "dtype"),
    each_value([{}, {"landmarks": "uniform"}, {"completion": "none"}], [torch.float32, torch.float64, torch.bfloat16]),
)
def test_shapes_alone_are_enough(options: dict[str, Any], dtype: torch.dtype) -> None:
    picture = image().to(dtype)
    meta = build_and_filter(picture.to("meta").requires_grad_(), **options)
    assert meta.device.type == "meta"
    meta.float().square().sum().backward()
    with FakeTensorMode():
        fake = build_and_filter(torch.zeros(picture.shape, dtype=dtype, requires_grad=True), **options)
        fake.float().square().sum().backward()
    for result in (meta, fake):
        assert (result.shape, result.dtype) == (picture.shape, dtype)


# --- empty batches and memory formats


@pytest.mark.client("empty batches", "yes; edits, looks and strokes refuse them")
def test_empty_batches_stay_empty() -> None:
    none = image()[:0]
    layer = NonlocalFilter(ALPHA, learn=("alpha", "residual"), residual=0.5, **OPTIONS)
    assert layer(none).shape == none.shape
    assert layer(none, image(batch=1)).shape == none.shape
    assert layer(none, mask=none[:, :1]).shape == none.shape
    regions = NonlocalFilter((ALPHA, ALPHA), **OPTIONS)
    assert regions(none, mask=none[:, :2]).shape == none.shape
    layer(none).sum().backward()
    assert bool((layer.alpha.grad == 0).all())  # type: ignore[union-attr]
    empty = nonlocal_operator(none, **OPTIONS)
    assert (empty @ none).shape == none.shape
    assert DiffusionMask()(empty.spectrum(), none[:, :2]).shape == none[:, :2].shape
    assert SegmentMask()(empty.spectrum(), none[:, :2]).shape == none[:, :2].shape
    assert detail_layers(operator(), none).shape == (0, 4, 3, 12, 13)
    assert spectral_filter(operator().spectrum(), none, torch.sqrt).shape == none.shape
    assert operator_from_features(torch.zeros(0, 3, 20), size=(4, 5), num_landmarks=6).factor.shape == (0, 6, 20)


@pytest.mark.client("channels-last images", "stay so")
@pytest.mark.parametrize("order", [torch.contiguous_format, torch.channels_last])
def test_the_order_in_memory_is_kept(order: torch.memory_format) -> None:
    picture = image().contiguous(memory_format=order)
    layer, built = NonlocalFilter(ALPHA, **OPTIONS), operator()
    mask = torch.rand(2, 1, 12, 13, generator=torch.Generator().manual_seed(0))
    actual = [
        layer(picture),
        layer(picture, mask=mask),
        built @ picture,
        polynomial_filter(built, picture, SLIDERS),
        spectral_filter(built.spectrum(), picture, torch.sqrt),
        spectral_filter(built.spectrum(), picture, torch.sqrt, residual=0.5),
    ]
    for result in actual:
        assert result.is_contiguous(memory_format=order)
    torch.testing.assert_close(actual[0], layer(image()), atol=2e-6, rtol=0)


# --- transforms that building an operator refuses


def traced(function: Callable[[Tensor], Tensor]) -> object:
    return torch.jit.trace(function, (image(batch=1),))


def mapped(function: Callable[[Tensor], Tensor]) -> object:
    return vmap(function)(image().unsqueeze(1))


def pushed(function: Callable[[Tensor], Tensor]) -> object:
    return jvp(function, (image(),), (image(),))


def dual(function: Callable[[Tensor], Tensor]) -> object:
    with forward_ad.dual_level():
        return function(forward_ad.make_dual(image(), image()))


BUILDERS: list[Callable[[Tensor], Tensor]] = [
    lambda y: NonlocalFilter(**OPTIONS)(y),
    lambda y: nonlocal_operator(y, **OPTIONS).factor,
    lambda y: operator_from_features(y.flatten(2), size=(12, 13), num_landmarks=20).factor,
    lambda y: nonlocal_operator(torch.ones(1, 1, 12, 13), num_landmarks=20, photometric_bandwidth=y.mean()).factor,
]


@pytest.mark.client("`jit.trace`, `vmap`, `jvp` of building an operator", "refused")
@pytest.mark.filterwarnings("ignore:.*torch.jit.*is deprecated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning")
@pytest.mark.parametrize("build", BUILDERS)
@pytest.mark.parametrize("transform", [traced, mapped, pushed, dual])
def test_transforms_of_building_are_refused_in_one_sentence(
    transform: Callable[..., object], build: Callable[[Tensor], Tensor]
) -> None:
    message = r"^(guide|features|photometric_bandwidth) must .* while an operator is built, got .*; \w+"
    with pytest.raises(TypeError, match=message) as caught:
        transform(build)
    assert "\n" not in str(caught.value)


def test_forward_derivatives_elsewhere_do_not_stop_building() -> None:
    with forward_ad.dual_level():
        moving = forward_ad.make_dual(image(1), image(2))
        tangent = forward_ad.unpack_dual(polynomial_filter(operator(), moving, SLIDERS)).tangent
        _ = diffusion_mask(operator().spectrum(), torch.ones(1, 1, 12, 13))
    torch.testing.assert_close(tangent, polynomial_filter(operator(), image(2), SLIDERS))
