"""The files of the editor's page: the functions of its script, and that a wheel holds them."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest

from nlfilter_torch.photo.app.page import SCRIPTS, STATIC, STATIC_ADDRESS
from tests.pages import ROOT

NODE = shutil.which("node")


@pytest.mark.skipif(NODE is None, reason="no node here; install it, in version 20 or later")
def test_functions_of_the_script() -> None:
    files = sorted((Path(__file__).parent / "js").glob("*.test.js"))
    done = subprocess.run([str(NODE), "--test", *files], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "# fail 0" in done.stdout
    assert len(files) == 2


def test_scripts_of_the_page_are_files() -> None:
    assert SCRIPTS.count("<script") == 2
    for name in ("page.js", "closeup.js"):
        assert f'src="{STATIC_ADDRESS}/{name}"' in SCRIPTS
        assert (STATIC / name).is_file()


def test_a_wheel_holds_the_files_of_the_page(tmp_path: Path) -> None:
    builder = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    builder.get_build_hooks = lambda _: {}  # that of hatch_build.py would compile the kernels
    (wheel,) = builder.build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    files = {path.relative_to(ROOT).as_posix() for path in STATIC.iterdir()}
    assert {Path(name).suffix for name in files} == {".js", ".css"}
    assert files <= names
    assert not any(name.endswith("package.json") for name in names)
