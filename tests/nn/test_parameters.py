"""Learned parameters of the layers: their choice, initial values and ranges, and sliders passed to a call."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    SegmentMask,
    nonlocal_operator,
    polynomial_filter,
)
from tests.layers import ALPHA, EVERYTHING, OPTIONS, backward, everything, image, untouched

LEARNED = ("photometric_bandwidth", "spatial_bandwidth")


@pytest.mark.parametrize("name", EVERYTHING)
def test_only_what_is_named_learns(name: str) -> None:
    layer = NonlocalFilter(ALPHA, learn=(name,), spatial_bandwidth=9.0, **OPTIONS)
    assert len(list(layer.parameters())) == 1
    for gradient in backward(layer, image()).values():
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0


def test_every_parameter_gets_a_gradient() -> None:
    assert set(backward(everything(), image())) == {
        "affinity.log_photometric_bandwidth",
        "affinity.log_spatial_bandwidth",
        "affinity.patch_weights.logits",
        "sliders.alpha",
        "sliders.residual",
    }


def test_learning_starts_from_the_function() -> None:
    operator = nonlocal_operator(image(), spatial_bandwidth=9.0, **OPTIONS)
    expected = polynomial_filter(operator, image(), torch.tensor(ALPHA), residual=ALPHA[0])
    torch.testing.assert_close(everything()(image()), expected, atol=1e-5, rtol=0)


def test_learned_numbers_are_shown_as_they_are() -> None:
    text = repr(everything())
    for part in ("photometric_bandwidth=0.2", "spatial_bandwidth=9", "residual=3.0", "5x5"):
        assert part in text
    assert "time=2.5, width=3" in repr(DiffusionMask(time=2.5, width=3.0, learn=("time", "width")))


@pytest.mark.parametrize("rate", [1.0, 30.0])
def test_positive_things_stay_positive_under_any_step(rate: float) -> None:
    layer = everything()
    optimizer = torch.optim.SGD(layer.parameters(), lr=rate)
    mask = DiffusionMask(learn=("time", "width"))
    for parameter in (*layer.parameters(), *mask.parameters()):
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    torch.optim.SGD(mask.parameters(), lr=rate).step()
    for positive in (layer.photometric_bandwidth, mask.time, mask.width, layer.affinity.patch_weights()):
        assert (positive > 0).all()
    torch.testing.assert_close(layer.affinity.patch_weights().sum(), torch.tensor(1.0))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: NonlocalFilter(learn=("alpha", "gamma")),
            ValueError,
            r"learn must hold only names from 'alpha', .*, got 'gamma'",
        ),
        (lambda: NonlocalFilter(learn="bandwidth"), ValueError, "got 'bandwidth'"),
        (
            lambda: NonlocalAffinity(learn=("alpha",)),
            ValueError,
            "learn must hold only names from 'photometric_bandwidth'",
        ),
        (lambda: PolynomialSliders(learn=("time",)), ValueError, "learn must hold only names from 'alpha', 'residual'"),
        (lambda: DiffusionMask(learn=("alpha",)), ValueError, "learn must hold only names from 'time', 'width'"),
        (lambda: NonlocalFilter(photometric_bandwidth=0.0), ValueError, "photometric_bandwidth must be positive"),
        (
            lambda: NonlocalFilter(photometric_bandwidth=-1.0, learn="photometric_bandwidth"),
            ValueError,
            "photometric_bandwidth must be positive and finite, got -1",
        ),
        (
            lambda: NonlocalFilter(photometric_bandwidth="car"),
            ValueError,
            "photometric_bandwidth must be one of 'auto'",
        ),
        (
            lambda: NonlocalFilter(learn="photometric_bandwidth"),
            ValueError,
            "photometric_bandwidth must be a number if it is learned, got 'auto'; pass",
        ),
        (lambda: NonlocalFilter(landmarks=48), ValueError, "landmarks must be one of .*, got 48; .* num_landmarks"),
        (lambda: NonlocalAffinity(landmarks=48), ValueError, "landmarks must be one of .*, got 48; .* num_landmarks"),
        (lambda: NonlocalFilter(num_landmarks="48"), TypeError, "num_landmarks must be an int, got str"),
        (lambda: NonlocalFilter(patch_size=4), ValueError, "patch_size must be odd"),
        (lambda: NonlocalFilter(patch_size=100001), ValueError, "patch_size must be at most 101, got 100001"),
        (lambda: NonlocalFilter(completion="all"), ValueError, "completion must be one of"),
        (lambda: NonlocalFilter(guide_channels="rgb"), ValueError, "guide_channels must be one of"),
        (lambda: NonlocalFilter(tolerance=0.0), ValueError, "tolerance must be positive"),
        (lambda: NonlocalFilter(tolerance=torch.tensor(1e-5)), TypeError, "tolerance must be a number, got Tensor"),
        (lambda: NonlocalFilter(generator=1), TypeError, "generator must be a Generator, got int"),
        (lambda: NonlocalFilter(group="all"), TypeError, "group must be a process group"),
        (lambda: NonlocalFilter(patch_weights=torch.ones(2, 2)), ValueError, "patch_weights must have shape"),
        (lambda: NonlocalFilter(residual=math.nan), ValueError, "residual must be finite, got nan"),
        (lambda: NonlocalFilter(residual="all"), TypeError, "residual must be a number or a tensor, got str"),
        (lambda: NonlocalFilter(learn=3), TypeError, "learn must be a list of names, got 3"),
        (
            lambda: NonlocalFilter("1, 1"),
            TypeError,
            "alpha must be numbers or rows of numbers of equal length, got '1, 1'",
        ),
        (lambda: DiffusionMask(time="long"), TypeError, "time must be a number or a tensor, got str"),
        (lambda: SegmentMask(time=-1.0), ValueError, "time must be positive"),
        (lambda: NonlocalFilter(spatial_bandwidth=-3.0), ValueError, "spatial_bandwidth must be positive"),
        (lambda: NonlocalFilter(learn="spatial_bandwidth"), ValueError, "spatial_bandwidth must be a number of pixels"),
        (lambda: NonlocalFilter(patch_size=4, learn="patch_weights"), ValueError, "patch_size must be odd"),
        (lambda: DiffusionMask(width=0.0), ValueError, "width must be positive"),
        (lambda: DiffusionMask(time=-1.0, learn="time"), ValueError, "time must be positive"),
        (lambda: NonlocalFilter((1.0,)), ValueError, "alpha must have at least two entries"),
        (lambda: NonlocalFilter((1.0, math.nan)), ValueError, "alpha must be finite"),
    ],
)
def test_bad_construction_is_one_clear_sentence(
    make: Callable[[], nn.Module], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (
            lambda f: f(image(), alpha=torch.ones(3, 4)),
            ValueError,
            "alpha must have the batch size of the layers, 2, got 3",
        ),
        (lambda f: f(image(), alpha=torch.ones(2, 4, 5, 5)), ValueError, "alpha must have the height and width"),
        (lambda f: f(image(), alpha=torch.ones(2, 1)), ValueError, "alpha must have at least two entries"),
        (lambda f: f(image(), alpha=torch.ones(2, 2, 2)), ValueError, "alpha must have shape"),
        (lambda f: f(image(), guide=image(batch=3)), ValueError, "batch size"),
        (lambda f: f(image(), mask=torch.ones(2, 1, 5, 5)), ValueError, "mask must have the height and width"),
        (lambda f: f(image(), mask=1.5 * torch.ones_like(image())), ValueError, r"mask must be in \[0, 1\]"),
        (lambda f: f(image().to(torch.float8_e4m3fn)), TypeError, "must have a floating-point dtype .*float8"),
        (lambda f: f(image(), guide=image().to(torch.int32)), TypeError, "guide must have a floating-point dtype"),
        (lambda f: f(image().to(torch.complex64)), TypeError, "must have a floating-point dtype"),
    ],
)
def test_bad_call_leaves_the_parameters_untouched(
    call: Callable[[nn.Module], Tensor], error: type[Exception], message: str
) -> None:
    layer = everything()
    with untouched(layer), pytest.raises(error, match=message):
        call(layer).mean().backward()


def test_parts_of_a_filter_are_its_own_attributes() -> None:
    layer = everything()
    assert layer.alpha is layer.sliders.alpha
    assert layer.residual is layer.sliders.residual
    assert layer.photometric_bandwidth.item() == pytest.approx(0.2)
    assert layer.spatial_bandwidth.item() == pytest.approx(9.0)
    layer.spatial_bandwidth.backward()
    assert layer.affinity.log_spatial_bandwidth.grad.item() == pytest.approx(9.0)
    fixed = NonlocalFilter(ALPHA, photometric_bandwidth=0.3)
    assert (fixed.photometric_bandwidth, fixed.spatial_bandwidth, fixed.residual) == (0.3, None, None)
    assert NonlocalAffinity().photometric_bandwidth == "auto"
    assert (DiffusionMask(time=2.5).time, DiffusionMask().width) == (2.5, 4.0)


def test_state_dicts_load() -> None:
    layer = everything()
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter += 0.1
    saved = layer.state_dict()
    assert saved["sliders.residual"].shape == (1,)  # FSDP cannot shard parameters of shape ()
    assert {f"affinity.log_{name}" for name in LEARNED} < saved.keys()
    other = everything()
    other.load_state_dict(saved)
    torch.testing.assert_close(other(image()), layer(image()), atol=0, rtol=0)
    mask = DiffusionMask(learn=("time", "width"))
    logarithms = {"time": 0.5, "width": 1.5}
    mask.load_state_dict({f"log_{name}": torch.tensor([value]) for name, value in logarithms.items()})
    assert other.photometric_bandwidth.shape == mask.time.shape == ()  # type: ignore[union-attr]
    assert (mask.time.item(), mask.width.item()) == pytest.approx((math.exp(0.5), math.exp(1.5)))


@pytest.mark.parametrize("name", LEARNED)
def test_a_learned_bandwidth_needs_a_layer_that_learns_it(name: str) -> None:
    saved = {"sliders.alpha": torch.ones(4), f"affinity.log_{name}": torch.tensor([math.log(0.25)])}
    layer = NonlocalFilter(ALPHA, **OPTIONS)
    with pytest.raises(RuntimeError, match=rf"{name} must be learned .* add '{name}' to learn and pass {name}=0.25"):
        layer.load_state_dict(saved)
    layer.load_state_dict(saved, strict=False)
    assert layer.photometric_bandwidth == 0.2
    torch.testing.assert_close(layer.alpha, torch.ones(4))
