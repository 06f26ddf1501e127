"""The README's code runs as it stands, its commands exist and its links lead somewhere."""

import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.cli import main

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
COMMANDS = [line for language, block in BLOCKS if language == "sh" for line in block.splitlines()]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the photograph that the README speaks of, and in it the current one."""
    Image.fromarray(skimage.data.coffee()[::4, ::4]).save(tmp_path / "photo.jpg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_python_blocks_run_in_order(folder: Path) -> None:
    blocks = [block for language, block in BLOCKS if language == "python"]
    assert len(blocks) == 3
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    with Image.open(folder / "crisp.png") as crisp:
        assert crisp.size == (150, 100)
    assert names["layers"].shape == (1, 4, 3, 100, 150)  # type: ignore[attr-defined]
    assert names["mask"].shape == (1, 1, 100, 150)  # type: ignore[attr-defined]


def test_commands_run(folder: Path) -> None:
    ours = [shlex.split(command)[1:] for command in COMMANDS if command.startswith("nlfilter-torch ")]
    assert len(ours) == 6
    for arguments in ours:
        assert main(arguments) == 0
    assert {"crisp.jpg", "calm.png", "soft.jpg", "looks", "look.json", "again.jpg"} <= {
        path.name for path in folder.iterdir()
    }


def test_set_up_commands_exist() -> None:
    targets = [command.split()[1] for command in COMMANDS if command.startswith("make ")]
    assert targets == ["demo", "test"]
    for target in [*targets, *re.findall(r"`make ([\w-]+)`", README)]:
        assert subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, check=False).returncode == 0
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for command in COMMANDS:
        assert set(re.findall(r"\[(\w+)\]", command)) <= extras.keys()
    assert "make test" in (ROOT / ".ci" / "run").read_text()


def test_no_block_of_another_kind() -> None:
    assert {language for language, _ in BLOCKS} == {"python", "sh"}
    programs = {command.split()[0] for command in COMMANDS}
    assert programs == {"nlfilter-torch", "pip", "make"}


def test_links_and_pictures_are_there() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(targets) > 5
    for target in targets:
        assert target.startswith("https://") or (ROOT / target).exists(), target
    for picture in (ROOT / "docs").glob("*.png"):
        assert picture.stat().st_size < 600_000, picture


def test_every_claim_about_training_has_its_test() -> None:
    table = README.split("## In training")[1].split("| test |\n|---|---|---|\n")[1].split("\n\n")[0]
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py"))
    for row in table.splitlines():
        tests = re.findall(r"`(test_\w+)`", row.split("|")[3])
        assert tests, row
        for name in tests:
            assert f"\ndef {name}(" in sources, name


def test_public_names_are_named() -> None:
    """What the README's table promises is there."""
    import nlfilter_torch

    table = README.split("## What is in it")[1].split("\n\n")[1]
    names = re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in table.splitlines()))
    assert len(names) > 10
    for name in names:
        assert name in nlfilter_torch.__all__
