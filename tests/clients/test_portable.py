"""Layers in ONNX and compiled ahead of time, where nothing of this package runs: portable forms of its operators."""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor

from nlfilter_torch import NonlocalFilter, Portable
from nlfilter_torch.operator import portable
from nlfilter_torch.operator.nystrom import JITTER, invert
from tests.problems import colour, noise

NLFILTER = torch.ops.nlfilter


def small(landmarks: Any = "kmeans") -> NonlocalFilter:
    options: dict[str, Any] = {"num_landmarks": 3, "patch_size": 1, "photometric_bandwidth": 0.2}
    return NonlocalFilter((3.0, 1.05), landmarks=landmarks, learn=("alpha", "photometric_bandwidth"), **options)


def photograph() -> Tensor:
    return colour("chelsea", 8, 9)


@pytest.mark.parametrize(
    "options",
    [
        {"photometric_bandwidth": 20 / 255, "spatial_bandwidth": 9.0},
        {"landmarks": "uniform"},
        {"landmarks": "random", "completion": "none", "photometric_bandwidth": 40 / 255},
    ],
)
def test_the_exported_computation_is_the_layer(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is while a layer is exported, but on tensors with values."""
    layer = NonlocalFilter((3.0, 3.0, 4.0, 1.05), learn=(), num_landmarks=50, **options)
    picture = torch.cat([colour("astronaut", 40, 50), colour("coffee", 40, 50)])
    expected = layer(picture)
    assert torch.equal(Portable(layer)(picture), expected)
    forms = {operator: Mock(side_effect=form) for operator, form in portable.FORMS.items()}
    monkeypatch.setattr(portable, "FORMS", forms)
    monkeypatch.setattr("torch.compiler.is_compiling", lambda: True)
    torch.testing.assert_close(Portable(layer)(picture), expected, atol=1e-4, rtol=0)
    assert all(form.called for form in forms.values())


@pytest.mark.parametrize("points", [1.0, 0.01, 0.0], ids=["apart", "near", "equal"])
def test_the_inverse_root_is_that_of_the_same_matrix(points: float) -> None:
    places = points * noise(2, 3, 60)
    affinity = torch.exp(-torch.cdist(places.mT, places.mT).square()) + JITTER * torch.eye(60, dtype=torch.float64)
    root, lower = portable.inverse_root(affinity), invert(affinity)
    torch.testing.assert_close(root, root.mT)
    torch.testing.assert_close(root @ root, lower.mT @ lower, rtol=1e-6, atol=1e-6 / JITTER)


def test_landmarks_are_those_of_the_operator() -> None:
    features = noise(2, 3, 2000, dtype=torch.float32) / 0.2
    expected = NLFILTER.choose(features, 40, 50, 20, "kmeans")
    for ours, theirs in zip(portable.choose(features, 40, 50, 20, "kmeans"), expected, strict=True):
        assert torch.equal(ours, theirs)
    with pytest.raises(ValueError, match=r"num_landmarks must be at most 256 .*, got 300; use landmarks='uniform'"):
        portable.choose(features, 40, 50, 300, "kmeans")


def test_a_model_is_wanted() -> None:
    with pytest.raises(TypeError, match=r"module must be a Module, got .*; pass a layer such as"):
        Portable(lambda image: image)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.skipif(
    not (find_spec("onnxruntime") and find_spec("onnxscript")), reason="there is no ONNX, or no runtime"
)
@pytest.mark.filterwarnings("ignore:`isinstance.treespec, LeafSpec.` is deprecated:FutureWarning")
def test_onnx(tmp_path: Path) -> None:
    import onnxruntime

    layer, path = small(), str(tmp_path / "layer.onnx")
    torch.onnx.export(Portable(layer).eval(), (photograph(),), path, dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for picture in (photograph(), colour("coffee", 8, 9)):
        (found,) = session.run(None, {session.get_inputs()[0].name: picture.numpy()})
        torch.testing.assert_close(torch.from_numpy(found), layer(picture).detach(), atol=1e-4, rtol=0)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
@pytest.mark.filterwarnings("ignore:`isinstance.treespec, LeafSpec.` is deprecated:FutureWarning")
def test_compiled_ahead_of_time(tmp_path: Path) -> None:
    """It runs in a process that does not import this package."""
    layer, package, result = small("uniform").requires_grad_(False), tmp_path / "layer.pt2", tmp_path / "result.npy"
    program = torch.export.export(Portable(layer), (photograph(),))
    torch._inductor.aoti_compile_and_package(program, package_path=str(package))
    np.save(tmp_path / "picture.npy", colour("coffee", 8, 9).numpy())
    script = (
        "import sys, numpy, torch\n"
        "image = torch.from_numpy(numpy.load(sys.argv[2]))\n"
        "numpy.save(sys.argv[3], torch._inductor.aoti_load_package(sys.argv[1])(image).numpy())\n"
        "assert 'nlfilter_torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script, package, tmp_path / "picture.npy", result], check=True, cwd=tmp_path)
    expected = layer(colour("coffee", 8, 9))
    torch.testing.assert_close(torch.from_numpy(np.load(result)), expected, atol=1e-4, rtol=0)
