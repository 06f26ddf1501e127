"""Learned parameters of the layers: their choice, initial values and ranges, and sliders passed to a call."""

import math

import pytest
import torch
from torch import Tensor

from nlfilter_torch import (
    DiffusionMask,
    NonlocalAffinity,
    NonlocalFilter,
    nonlocal_operator,
    polynomial_filter,
)
from tests.layers import ALPHA, EVERYTHING, OPTIONS, backward, everything, image, untouched
from tests.refusals import check_refusals, refusals

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


def test_bad_calls_leave_the_parameters_untouched() -> None:
    layer = everything()

    def call(x: Tensor, **arguments: Tensor) -> None:
        layer(x, **arguments).mean().backward()

    with untouched(layer):
        check_refusals(
            refusals(
                call,
                {"x": image()},
                ({"alpha": torch.ones(3, 4)}, "^alpha must have the batch size of the layers, 2, got 3"),
                ({"alpha": torch.ones(2, 4, 5, 5)}, "^alpha must have the height and width"),
                ({"alpha": torch.ones(2, 1)}, "^alpha must have at least two entries"),
                ({"alpha": torch.ones(2, 2, 2)}, "^alpha must have shape"),
                ({"guide": image(batch=3)}, "batch size"),
                ({"mask": torch.ones(2, 1, 5, 5)}, "^mask must have the height and width"),
                ({"mask": 1.5 * torch.ones_like(image())}, r"^mask must be in \[0, 1\]"),
                ({"x": image().to(torch.float8_e4m3fn)}, "must have a floating-point dtype .*float8", TypeError),
                ({"guide": image().to(torch.int32)}, "^guide must have a floating-point dtype", TypeError),
                ({"x": image().to(torch.complex64)}, "must have a floating-point dtype", TypeError),
            )
        )


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
