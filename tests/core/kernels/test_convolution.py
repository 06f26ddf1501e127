"""Convolutions of rectified features: the kernel in C, and what is left to the definition in torch."""

from contextlib import nullcontext

import pytest
import torch
from torch import Tensor

from nlfilter_torch.core.kernels import convolution, definitions_only
from tests.native import random
from tests.pairwise import pairwise


@pytest.mark.parametrize(
    ("size", "dilation", "planes"),
    pairwise(
        [(1, 1), (3, 4), (4, 5), (13, 40), (37, 65)],
        [1, 2, 3, 5],
        [(16, 16), (48, 48), (32, 28), (16, 1), (6, 48)],
    ),
)
def test_convolution(size: tuple[int, int], dilation: int, planes: tuple[int, int]) -> None:
    channels, outputs = planes
    inputs = (
        random(2, channels, *size),
        random(outputs, channels, 3, 3, seed=1) / (3 * channels**0.5),
        random(outputs, seed=2),
        dilation,
        random(2, outputs, *size, seed=3),
    )
    features, weight, bias, _, added = (t.double() if isinstance(t, Tensor) else t for t in inputs)
    rectified = torch.where(features < 0, 0.1 * features, features)
    exact = torch.nn.functional.conv2d(rectified, weight, bias, padding=dilation, dilation=dilation)
    for context in (nullcontext(), definitions_only()):
        with context:
            torch.testing.assert_close(convolution.convolve(*inputs).double(), exact + added, atol=3e-5, rtol=0)
            torch.testing.assert_close(convolution.convolve(*inputs[:4]).double(), exact, atol=3e-5, rtol=0)


def test_convolution_under_autocast_and_vmap() -> None:
    features, weight = random(2, 16, 9, 7), random(16, 16, 3, 3, seed=1) / 12
    wanted = convolution.convolve(features, weight)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(convolution.convolve(features, weight).float(), wanted, atol=0.05, rtol=0)
    results = torch.vmap(lambda sample: convolution.convolve(sample[None], weight)[0])(features)
    torch.testing.assert_close(results, wanted)


def test_convolution_of_other_shapes_is_left_to_the_definition() -> None:
    features, weight = random(1, 16, 9, 7), random(16, 16, 3, 3, seed=1) / 12
    wanted = convolution.convolve(features, weight)
    torch.testing.assert_close(convolution.convolve(features, weight, added=torch.ones(1, 16, 1, 1)), wanted + 1)
    with pytest.raises(RuntimeError, match="bias"):
        convolution.convolve(features, weight, torch.ones(3))
    with pytest.raises(RuntimeError, match="channels"):
        convolution.convolve(features[:, :8], weight)
