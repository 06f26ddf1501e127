"""The README's code runs unchanged, its commands exist and the targets of its links exist."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.photo.cli import main
from tests.pages import README, ROOT


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, containing the photograph that the README uses."""
    Image.fromarray(skimage.data.coffee()[::4, ::4]).save(tmp_path / "photo.jpg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_python_blocks_run_in_order(folder: Path) -> None:
    assert [kind for kind, _ in README.blocks()].count("python") == 5
    names = README.run_python()
    with Image.open(folder / "strong.png") as strong:
        assert strong.size == (150, 100)
    assert names["layers"].shape == (1, 4, 3, 100, 150)  # type: ignore[attr-defined]
    assert names["mask"].shape == (1, 1, 100, 150)  # type: ignore[attr-defined]
    for edit in ("repainted", "crisper", "portrait", "painting"):
        assert names[edit].shape == (1, 3, 100, 150)  # type: ignore[attr-defined]


def test_commands_run(folder: Path) -> None:
    ours = README.commands("nlfilter-torch")
    assert len(ours) == 6
    for arguments in ours:
        assert main(arguments) == 0
    made = {path.name for path in folder.iterdir()}
    assert {"crisp.jpg", "sky.jpg", "soft.jpg", "looks", "look.json", "again.jpg"} <= made


def test_it_is_short_and_shows_pictures_installing_python_and_commands_in_this_order() -> None:
    assert README.text.count("\n") <= 150
    assert README.text.count("![") == 2
    assert "![" in README.text.split("\n## ")[0]
    assert [kind for kind, _ in README.blocks()] == ["sh", "python", "python", "python", "sh", "python", "python"]


def test_set_up_commands_exist() -> None:
    targets = re.findall(r"`make ([\w-]+)`", README.text)
    assert {"demo", "test", "docs", "wheels"} <= set(targets)
    for target in targets:
        assert subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, check=False).returncode == 0
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for words in README.commands("pip"):
        assert set(re.findall(r"\[(\w+)\]", " ".join(words))) <= extras.keys()
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_no_block_of_another_kind() -> None:
    assert {kind for kind, _ in README.blocks()} == {"python", "sh"}
    lines = [line for kind, block in README.blocks() if kind == "sh" for line in block.splitlines()]
    assert {line.split()[0] for line in lines} == {"nlfilter-torch", "pip"}


def test_links_and_pictures_are_there() -> None:
    assert len(README.targets()) > 5
    for target in README.targets():
        assert target.startswith("https://") or (ROOT / target).exists(), target


@pytest.mark.parametrize(("page", "section"), [("training", "Quality"), ("speed", "Speed")])
def test_figures_are_those_of_the_tables(page: str, section: str) -> None:
    sentence = README.text.split(f"**{section}:**")[1].split("([")[0]
    table = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    figures = re.findall(r"\d+\.\d+|\d+ ms", sentence)
    assert len(figures) == 2
    for figure in figures:
        assert f"| {figure} |" in table, figure
