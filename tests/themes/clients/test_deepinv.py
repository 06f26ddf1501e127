"""The example of deepinv in docs/clients.md, where deepinv is installed."""

import pytest

from tests.pages import ROOT, Page


@pytest.mark.client("deepinv", "`NonlocalDenoiser` is a denoiser of its algorithms")
@pytest.mark.usefixtures("deepinv")
@pytest.mark.filterwarnings("ignore")  # of deepinv
def test_the_denoiser_in_an_algorithm_of_deepinv() -> None:
    (example,) = [block for _, block in Page(ROOT / "docs" / "clients.md").blocks() if "import deepinv" in block]
    names: dict[str, object] = {}
    exec(compile(example, "clients.md", "exec"), names)
    assert names["restored"].shape == names["sharp"].shape  # type: ignore[attr-defined]
