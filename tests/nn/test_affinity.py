"""The layer that builds an operator."""

import copy
import math

import pytest
import torch

from nlfilter_torch import (
    NonlocalAffinity,
    NonlocalFilter,
    PolynomialSliders,
    detail_layers,
    nonlocal_operator,
)
from nlfilter_torch.operator.features import patch_window
from tests.layers import ALPHA, OPTIONS, everything, image
from tests.problems import noise


def test_affinity_and_sliders_are_the_parts_of_the_filter() -> None:
    affinity, sliders = NonlocalAffinity(**OPTIONS), PolynomialSliders(ALPHA)
    operator = affinity(image())
    expected = NonlocalFilter(ALPHA, **OPTIONS)(image())
    torch.testing.assert_close(sliders(operator, image()), expected)
    torch.testing.assert_close(sliders.combine(detail_layers(operator, image())), expected)


def test_patch_weights_that_need_a_gradient_are_constants_of_the_layer() -> None:
    layer = NonlocalFilter(patch_weights=torch.ones(3, 3, requires_grad=True), photometric_bandwidth=0.3)
    image = noise(1, 1, 12, 12, dtype=torch.float32).requires_grad_()
    for _ in range(2):
        copy.deepcopy(layer)(image).sum().backward()
    assert image.grad is not None


def test_a_given_window_is_the_start_of_patch_weights() -> None:
    window = patch_window(3) + 0.01
    layer = NonlocalAffinity(patch_weights=window, learn="patch_weights", **OPTIONS)
    torch.testing.assert_close(layer.patch_weights(), (window / window.sum()).float())
    fixed = NonlocalAffinity(patch_weights=window, **OPTIONS)
    torch.testing.assert_close(fixed(image()) @ image(), layer(image()) @ image(), atol=1e-5, rtol=0)
    assert not list(fixed.parameters())


def test_a_bandwidth_that_left_its_range_is_told() -> None:
    layer = everything()
    with torch.no_grad():
        layer.affinity.log_photometric_bandwidth.fill_(math.nan)
    with pytest.raises(ValueError, match="photometric_bandwidth must be positive and finite"):
        layer(image())


def test_bandwidths_can_be_assigned() -> None:
    affinity = NonlocalAffinity(photometric_bandwidth=0.3)
    affinity.photometric_bandwidth = 0.2
    torch.testing.assert_close(affinity(image()).factor, nonlocal_operator(image(), photometric_bandwidth=0.2).factor)
    learned = everything().affinity
    parameter = learned.log_photometric_bandwidth
    learned.photometric_bandwidth = 0.4
    assert learned.log_photometric_bandwidth is parameter
    assert learned.photometric_bandwidth.item() == pytest.approx(0.4)
    with pytest.raises(ValueError, match="photometric_bandwidth must be positive"):
        learned.photometric_bandwidth = -1.0
