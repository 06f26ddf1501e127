"""Exported programs that run without this package; docs/clients.md runs a layer in ONNX."""

from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import nn

from nlfilter_torch import NonlocalFilter, Portable, nonlocal_operator
from nlfilter_torch.core.torch_internals import DEFINITIONS
from nlfilter_torch.nn import portable
from nlfilter_torch.operator.nystrom import JITTER, inverse_root, invert
from tests.problems import colour, noise

NLFILTER = torch.ops.nlfilter


def given(num_landmarks: int, **options: Any) -> NonlocalFilter:
    """A layer with the landmarks of an operator."""
    operator = nonlocal_operator(colour("astronaut", 40, 50), num_landmarks=num_landmarks, **options)
    return NonlocalFilter((3.0, 3.0, 4.0, 1.05), learn=(), landmarks=operator, hold="features", **options)


@pytest.mark.client("ONNX, AOTInductor", "building included, by `Portable`; for images of one size and landmarks given")
@pytest.mark.parametrize(
    "layer",
    [
        given(50, photometric_bandwidth=20 / 255, spatial_bandwidth=9.0),
        given(50, completion="none", photometric_bandwidth=40 / 255),
        NonlocalFilter((3.0, 3.0, 4.0, 1.05), learn=(), landmarks="uniform", num_landmarks=50),
    ],
)
def test_the_exported_computation_is_the_layer(layer: NonlocalFilter, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code paths of an export, run on tensors with values."""
    picture = torch.cat([colour("astronaut", 40, 50), colour("coffee", 40, 50)])
    expected = layer(picture)
    assert torch.equal(Portable(layer)(picture), expected)
    called = {getattr(NLFILTER, name).default for name in ("columns", "invert", "moment", "sinkhorn", "spread")}
    mocks = {operator: Mock(side_effect=definition) for operator, definition in DEFINITIONS.items()}
    monkeypatch.setattr(portable, "DEFINITIONS", mocks)
    monkeypatch.setattr("torch.compiler.is_compiling", lambda: True)
    torch.testing.assert_close(Portable(layer)(picture), expected, atol=1e-4, rtol=0)
    assert all(mocks[operator].called for operator in called)


@pytest.mark.parametrize("points", [1.0, 0.01, 0.0], ids=["apart", "near", "equal"])
def test_the_inverse_root_is_that_of_the_same_matrix(points: float) -> None:
    places = points * noise(2, 3, 60)
    affinity = torch.exp(-torch.cdist(places.mT, places.mT).square()) + JITTER * torch.eye(60, dtype=torch.float64)
    root, lower = inverse_root(affinity), invert(affinity)
    torch.testing.assert_close(root, root.mT)
    torch.testing.assert_close(root @ root, lower.mT @ lower, rtol=1e-6, atol=1e-6 / JITTER)


@pytest.mark.parametrize("sampling", ["kmeans", "random"])
def test_landmarks_are_not_chosen_in_a_program(sampling: Any) -> None:
    layer: nn.Module = NonlocalFilter(learn=(), num_landmarks=20, landmarks=sampling)
    with pytest.raises(ValueError, match=rf"landmarks must be given or 'uniform' .*, got '{sampling}'; pass an operat"):
        torch.export.export(Portable(layer), (colour("astronaut", 16, 20),))


def test_a_model_is_wanted() -> None:
    with pytest.raises(TypeError, match=r"module must be a Module, got .*; pass a layer such as"):
        Portable(lambda image: image)  # type: ignore[arg-type]
