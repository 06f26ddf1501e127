"""Presets of any edits, applied by ``nlfilter-torch apply``."""

from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from tests.problems import cat, difference
from tests.recipes import DETAIL, RECOLOR


def test_the_command_line_goes_by_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.tiled.sampling.PILOT", 4000)
    monkeypatch.setattr("nlfilter_torch.photo.tiled.pictures.STATISTICS_PIXELS", 6000)
    photo, preset = tmp_path / "in.tif", tmp_path / "edit.json"
    write_photograph(Photograph(cat().repeat(1, 1, 2, 2), "uint16"), photo)  # more than tiles need
    preset.write_text(Recipe((DETAIL, RECOLOR)).to_json())
    names = [tmp_path / "whole.tif", tmp_path / "rows.tif"]
    for name, options in zip(names, ([], ["--memory", "0.044", "--full"]), strict=True):
        assert main(["apply", str(photo), str(name), "--preset", str(preset), *options]) == 0
    whole, rows = (read_photograph(name).pixels for name in names)
    # Rounding in the first step may change the k-means of the second: noise of 1e-7 changes single pixels by 3 levels.
    assert 0 < difference(whole, rows) < 8
    assert 255 * (whole - rows).square().mean().sqrt() < 0.5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["edit.json", "in.tif", "rows.tif", "whole.tif"]
