"""The example of deepinv in docs/clients.md, where deepinv is installed."""

from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch

from tests.pages import ROOT, Page

SIGNATURE = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


@pytest.fixture
def deepinv() -> Iterator[None]:
    """Skip the test unless deepinv is installed.

    It imports torchvision, whose compiled part does not load beside another build of torch than the one it was made
    for. Two operators of that part, which deepinv does not call, are then declared for the import to succeed.
    """
    if find_spec("deepinv") is None:
        pytest.skip("deepinv is not installed")
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(name + SIGNATURE)
        yield
    else:
        yield


@pytest.mark.client("deepinv", "`NonlocalDenoiser` is a denoiser of its algorithms")
@pytest.mark.usefixtures("deepinv")
@pytest.mark.filterwarnings("ignore")  # of deepinv
def test_the_denoiser_in_an_algorithm_of_deepinv() -> None:
    (example,) = [block for _, block in Page(ROOT / "docs" / "clients.md").blocks() if "import deepinv" in block]
    names: dict[str, object] = {}
    exec(compile(example, "clients.md", "exec"), names)
    assert names["found"].shape == names["sharp"].shape  # type: ignore[attr-defined]
