"""Folders of photographs for tests."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.batch import Edit, Tally, edit_folder
from nlfilter_torch.photo.cli.folders import pictures, prepare
from nlfilter_torch.photo.cli.workers import Crew


def fill(folder: Path, count: int, broken: tuple[int, ...] = (), side: int = 48) -> None:
    """Crops of a photograph, some of them cut short."""
    folder.mkdir()
    cat, random = skimage.data.chelsea(), np.random.default_rng(0)
    for number in range(count):
        y, x = random.integers(0, 250), random.integers(0, 400)
        path = folder / f"{number:03}.png"
        Image.fromarray(cat[y : y + side, x : x + side]).save(path)
        if number in broken:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def finished(folder: Path) -> dict[str, tuple[int, int]]:
    """Return the names of the finished pictures, with the inode and time that writing them again would change."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.glob("[!.]*")}


def tally_of(paths: list[Path], target: Path, edit: Edit, workers: int = 1) -> tuple[Tally, list[str]]:
    tally, told = Tally(), list[str]()
    prepare(paths, target, {})
    edit_folder(paths, target, edit, Crew(workers), tell=told.append, begin=lambda name: None, tally=tally)
    return tally, told


def plain_files(folder: Path, count: int) -> list[Path]:
    folder.mkdir()
    for number in range(count):
        (folder / f"{number}.png").write_text("any")
    return pictures(folder)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["batch", *map(str, arguments)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    return lines[0]
