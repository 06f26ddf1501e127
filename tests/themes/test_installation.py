"""Installation: the kernels in C are compiled where possible, and nothing fails where they are not."""

import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from hatch_build import FLAGS, FOLDER, CompiledKernels
from nlfilter_torch import nonlocal_operator
from nlfilter_torch.core import instruction_sets
from nlfilter_torch.core.kernels import definitions_only, library

CHECK = Path(__file__).parents[1] / "core" / "kernels" / "kernels_check.c"
CROSS = "aarch64-linux-gnu-gcc"
POSSIBLE = platform.machine() == "x86_64" and sys.platform == "linux" and shutil.which("cc") is not None


class Application:
    """The messages that the builder shows to the user."""

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
def test_installing_compiles_kernels_that_agree_with_loops_in_float64(tmp_path: Path) -> None:
    build_data, shown = install(tmp_path)
    assert not shown
    check(["cc"], [], [tmp_path / FOLDER / "kernels.so"], tmp_path)
    assert build_data["artifacts"] == ["nlfilter_torch/core/kernels/kernels.so"]
    assert build_data["tag"].startswith("py3-none-")
    assert not build_data["pure_python"]


@pytest.mark.skipif(not POSSIBLE or shutil.which(CROSS) is None, reason=f"there is no {CROSS}")
def test_a_cross_compiler_makes_a_wheel_for_its_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", CROSS)
    build_data, shown = install(tmp_path)
    assert not shown
    assert build_data["tag"] == "py3-none-linux_aarch64"
    assert (tmp_path / FOLDER / "kernels.so").read_bytes()[18] == 183  # of ELF: AArch64


def check(compiler: list[str], emulator: list[str], kernels: list[Path], folder: Path) -> None:
    """Compile ``kernels_check.c`` with kernels, as sources or as a library, and run it."""
    sources = [CHECK, *kernels]
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC")]
    subprocess.run([*compiler, *flags, "-o", folder / "check", *sources, "-lm"], check=True)
    done = subprocess.run([*emulator, folder / "check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("compiler", "emulator"),
    [(["clang"], []), ([CROSS], ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"])],
    ids=["clang", "aarch64"],
)
def test_kernels_agree_with_loops_in_float64(compiler: list[str], emulator: list[str], tmp_path: Path) -> None:
    missing = [name for name in (compiler[0], *emulator[:1]) if shutil.which(name) is None]
    if missing or not POSSIBLE:
        pytest.skip(f"there is no {' and no '.join(missing)}")
    check(compiler, emulator, list(Path(library.__file__).parent.glob("*.c")), tmp_path)


@pytest.mark.skipif(not POSSIBLE or shutil.which("qemu-x86_64") is None, reason="there is no cc or no qemu-x86_64")
def test_a_processor_without_avx2_uses_no_kernel(tmp_path: Path) -> None:
    """Torch does the work then, as without the library."""
    sources = [CHECK, *Path(library.__file__).parent.glob("*.c")]
    flags = [flag for flag in FLAGS if flag not in ("-shared", "-fPIC", "-O3")]
    subprocess.run(["cc", *flags, "-o", tmp_path / "check", *sources, "-lm"], check=True)
    command = ["qemu-x86_64", "-cpu", "Nehalem", tmp_path / "check"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "instruction sets: 0\n"


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
    assert instruction_sets.load_library() is None
    image = torch.rand(1, 1, 20, 20, generator=torch.Generator().manual_seed(0))
    with_kernels = nonlocal_operator(image, num_landmarks=20).matmul(image)
    with definitions_only():
        without = nonlocal_operator(image, num_landmarks=20).matmul(image)
    torch.testing.assert_close(with_kernels, without, atol=1e-4, rtol=0)
