"""Exported programs that run without this package; docs/clients.md runs a layer in ONNX."""

from typing import Any
from unittest.mock import Mock

import pytest
import torch

from nlfilter_torch import NonlocalFilter, Portable
from nlfilter_torch.operator import portable
from nlfilter_torch.operator.nystrom import JITTER, invert
from tests.problems import colour, noise

NLFILTER = torch.ops.nlfilter


@pytest.mark.client("ONNX, AOTInductor", "building included, by `Portable`; for images of one size")
@pytest.mark.parametrize(
    "options",
    [
        {"photometric_bandwidth": 20 / 255, "spatial_bandwidth": 9.0},
        {"landmarks": "uniform"},
        {"landmarks": "random", "completion": "none", "photometric_bandwidth": 40 / 255},
    ],
)
def test_the_exported_computation_is_the_layer(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The code paths of an export, run on tensors with values."""
    layer = NonlocalFilter((3.0, 3.0, 4.0, 1.05), learn=(), num_landmarks=50, **options)
    picture = torch.cat([colour("astronaut", 40, 50), colour("coffee", 40, 50)])
    expected = layer(picture)
    assert torch.equal(Portable(layer)(picture), expected)
    forms = {operator: Mock(side_effect=form) for operator, form in portable.FORMS.items()}
    monkeypatch.setattr(portable, "FORMS", forms)
    monkeypatch.setattr("torch.compiler.is_compiling", lambda: True)
    torch.testing.assert_close(Portable(layer)(picture), expected, atol=1e-4, rtol=0)
    automatic = forms.pop(torch.hypot)
    assert automatic.called == ("photometric_bandwidth" not in options)
    assert all(form.called for form in forms.values())


@pytest.mark.parametrize("points", [1.0, 0.01, 0.0], ids=["apart", "near", "equal"])
def test_the_inverse_root_is_that_of_the_same_matrix(points: float) -> None:
    places = points * noise(2, 3, 60)
    affinity = torch.exp(-torch.cdist(places.mT, places.mT).square()) + JITTER * torch.eye(60, dtype=torch.float64)
    root, lower = portable.inverse_root(affinity), invert(affinity)
    torch.testing.assert_close(root, root.mT)
    torch.testing.assert_close(root @ root, lower.mT @ lower, rtol=1e-6, atol=1e-6 / JITTER)


@pytest.mark.parametrize(("patch", "coordinates"), [(0, False), (1, False), (1, True)])
def test_landmarks_are_those_of_the_operator(patch: int, coordinates: bool) -> None:
    features = noise(2, 3, 2000, dtype=torch.float32) / 0.2
    arguments = features, [40, 50], 20, "kmeans", patch, coordinates
    for ours, theirs in zip(portable.choose(*arguments), NLFILTER.choose(*arguments), strict=True):
        assert torch.equal(ours, theirs)
    with pytest.raises(ValueError, match=r"num_landmarks must be at most 256 .*, got 300; use landmarks='uniform'"):
        portable.choose(features, [40, 50], 300, "kmeans", patch, coordinates)


def test_a_model_is_wanted() -> None:
    with pytest.raises(TypeError, match=r"module must be a Module, got .*; pass a layer such as"):
        Portable(lambda image: image)  # type: ignore[arg-type]
