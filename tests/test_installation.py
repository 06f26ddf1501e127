"""What installing does: the kernels in C are compiled where that is possible, and nothing fails where it is not."""

import platform
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from hatch_build import FOLDER, CompiledKernels
from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels import definitions_only, library

POSSIBLE = platform.machine() == "x86_64" and sys.platform == "linux" and shutil.which("cc") is not None


class Application:
    """What the builder shows to the one who installs."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def display_warning(self, text: str) -> None:
        self.shown.append(text)

    display_info = display_warning


def install(folder: Path) -> tuple[dict[str, Any], list[str]]:
    shutil.copytree(
        Path(library.__file__).parent, folder / FOLDER, ignore=shutil.ignore_patterns("*.so", "__pycache__")
    )
    application = Application()
    hook = CompiledKernels(str(folder), {}, None, None, str(folder), "wheel", application)
    build_data: dict[str, Any] = {"artifacts": [], "pure_python": True}
    hook.initialize("standard", build_data)
    return build_data, application.shown


@pytest.mark.skipif(not POSSIBLE, reason="there is no C compiler")
def test_installing_compiles(tmp_path: Path) -> None:
    build_data, shown = install(tmp_path)
    assert not shown
    assert (tmp_path / FOLDER / "kernels.so").stat().st_size > 10_000
    assert build_data["artifacts"] == ["nlfilter_torch/core/kernels/kernels.so"]
    assert build_data["tag"].startswith("py3-none-")
    assert not build_data["pure_python"]


@pytest.mark.skipif(not POSSIBLE, reason="there is no C compiler")
@pytest.mark.parametrize("compiler", ["no-such-compiler", "false"])
def test_installing_goes_on_without_a_compiler(compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", compiler)
    build_data, shown = install(tmp_path)
    assert len(shown) == 1
    assert "more slowly" in shown[0]
    assert build_data == {"artifacts": [], "pure_python": True}
    assert not list((tmp_path / FOLDER).glob("kernels.[!ch]*"))


def test_without_the_library_torch_does_the_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(instruction_sets, "__file__", str(tmp_path / "instruction_sets.py"))
    assert library._load() is None
    image = torch.rand(1, 1, 20, 20, generator=torch.Generator().manual_seed(0))
    with_kernels = nonlocal_operator(image, num_landmarks=20).matmul(image)
    with definitions_only():
        without = nonlocal_operator(image, num_landmarks=20).matmul(image)
    torch.testing.assert_close(with_kernels, without, atol=1e-4, rtol=0)
