"""Pictures and figures of ``nlfilter-torch inspect``, and the pictures of the demo."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


def test_inspect_writes_pictures_and_figures(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "looks"
    for _ in range(2):  # the folder may exist
        assert main(["inspect", str(photo), str(folder), "--landmarks", "40", "--bandwidth", "20"]) == 0
    names = {"eigenvectors.png", "eigenvalues.png", "response.png", "diagnostics.json"}
    assert {file.name for file in folder.iterdir()} == names
    for name in names - {"diagnostics.json"}:
        with Image.open(folder / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 5
    figures = json.loads((folder / "diagnostics.json").read_text())
    assert (figures["height"], figures["width"], figures["landmarks"]) == (60, 90, 40)
    assert figures["bandwidth"] == pytest.approx(20)
    assert figures["row_sum_residual"] < 1e-4
    assert 0.9 < figures["captured_energy"] <= 1.0001
    assert figures["eigenvalues"] == sorted(figures["eigenvalues"], reverse=True)
    table = capsys.readouterr().out
    for name in figures.keys() - {"eigenvalues"}:
        assert name.split("_")[0] in table


def test_inspect_shows_the_filter_at_the_viewing_size(photo: Path, tmp_path: Path) -> None:
    options = ("--landmarks", "20", "--viewing-size", "0.00135")
    assert main(["inspect", str(photo), str(tmp_path / "looks"), *options]) == 0
    figures = json.loads((tmp_path / "looks" / "diagnostics.json").read_text())
    assert (figures["height"], figures["width"]) == (30, 45)


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 40), (30, 20)])
def test_flat_and_tiny_pictures_are_looked_at(size: tuple[int, int], tmp_path: Path) -> None:
    source = tmp_path / "flat.png"
    write_photograph(Photograph(torch.full((1, 1, *size), 0.5), "uint8"), source)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about fewer pixels than landmarks
        assert main(["inspect", str(source), str(tmp_path / "looks")]) == 0
    names = ["diagnostics.json", "eigenvalues.png", "eigenvectors.png", "response.png"]
    assert sorted(path.name for path in (tmp_path / "looks").iterdir()) == names


@pytest.mark.slow
def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    assert main(["demo", str(folder)]) == 0
    names = ["1-before-after", "2-layers", "3-eigenvectors", "4-sliders", "5-selection"]
    assert sorted(file.name for file in folder.iterdir()) == [f"{name}.png" for name in names]
    printed = capsys.readouterr().out
    assert "captured energy" in printed
    for name in names:
        assert f"{name}.png" in printed.replace("\n", "")
        with Image.open(folder / f"{name}.png") as picture:
            assert min(picture.size) > 400
            assert np.asarray(picture.convert("L")).std() > 20
    # Before and after: the left panel is the photograph with a stroke, the middle one is blue where the suit is.
    with Image.open(folder / "1-before-after.png") as picture:
        panels = np.asarray(picture.convert("RGB"))
    before, after = panels[35:547, 15:527].astype(int), panels[35:547, 542:1054].astype(int)
    assert (np.abs(before - skimage.data.astronaut()).max(2) > 1).sum() == 400  # pixels of the stroke
    assert after[290:330, 50:90, 2].mean() > after[290:330, 50:90, 0].mean() + 30
    assert np.abs(after - before).mean() > 5
    # The selection covers the suit, on which the region lies, and nothing of the background.
    with Image.open(folder / "5-selection.png") as picture:
        mask = np.asarray(picture.convert("L"))[35:547, 542:1054] / 255
    assert mask[300:320, 60:80].mean() > 0.8
    assert mask[20:120, 320:370].mean() < 0.15
