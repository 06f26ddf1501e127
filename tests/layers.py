"""Layers with learned parameters, their inputs, and the gradients of a loss in their parameters."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from nlfilter_torch import NonlocalFilter
from tests.problems import noise

ALPHA = (3.0, 0.5, 4.0, 1.05)
OPTIONS = {"photometric_bandwidth": 0.2, "num_landmarks": 20}
EVERYTHING = ("alpha", "residual", "photometric_bandwidth", "spatial_bandwidth", "patch_weights")


def image(seed: int = 0, batch: int = 2, *, dtype: torch.dtype = torch.float32) -> Tensor:
    return noise(batch, 3, 12, 13, seed=seed, dtype=dtype)


def everything(**options: object) -> NonlocalFilter:
    return NonlocalFilter(ALPHA, learn=EVERYTHING, **(OPTIONS | {"spatial_bandwidth": 9.0} | options))  # type: ignore[arg-type]


def backward(layer: nn.Module, *arguments: Tensor) -> dict[str, Tensor]:
    """Return the gradients of a loss in the layer's parameters, by name."""
    layer.zero_grad()
    layer(*arguments).square().mean().backward()
    return {name: p.grad.clone() for name, p in layer.named_parameters() if p.grad is not None}


@contextmanager
def untouched(layer: nn.Module) -> Iterator[None]:
    """Check that the parameters of a layer do not change and receive no gradients."""
    before = copy.deepcopy(layer.state_dict())
    yield
    for name, value in layer.state_dict().items():
        torch.testing.assert_close(value, before[name], atol=0, rtol=0)
    assert all(p.grad is None for p in layer.parameters())
