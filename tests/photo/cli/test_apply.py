"""Presets of any edits, applied by ``nlfilter-torch apply``."""

from pathlib import Path

import pytest
import torch

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.problems import cat, difference
from tests.recipes import COLORIZE, DEFOCUS, DETAIL, RECOLOR


def test_the_command_line_goes_by_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.picture.sampling.PILOT", 4000)
    monkeypatch.setattr("nlfilter_torch.photo.picture.pictures.STATISTICS_PIXELS", 6000)
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


def test_apply(pixels: torch.Tensor, tmp_path: Path) -> None:
    photo, edit, out = tmp_path / "in.png", tmp_path / "edit.json", tmp_path / "out.png"
    write_photograph(Photograph(pixels), photo)
    recipe = Recipe((DETAIL, Step("tone"), DEFOCUS))
    edit.write_text(recipe.to_json())
    assert main(["apply", str(photo), str(out), "--preset", str(edit)]) == 0
    assert (read_photograph(out).pixels - apply_recipe(recipe, pixels).clamp(0, 1)).abs().max() < 0.6 / 255

    assert main(["apply", str(photo), str(out), "--preset", "crisp", "--depth", "16"]) == 0
    assert main(["detail", str(photo), str(tmp_path / "same.png"), "--preset", "crisp", "--depth", "16"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(tmp_path / "same.png").pixels)


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (Step.idle("tone"), "edit.json holds no step that changes anything: the photograph is written without an edit"),
        (COLORIZE, "in.png is in colour: colorize replaces its colours everywhere by those of the scribbles"),
    ],
    ids=["idle", "colorize"],
)
def test_apply_notes(
    pixels: torch.Tensor,
    tmp_path: Path,
    step: Step,
    sentence: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_photograph(Photograph(pixels), tmp_path / "in.png")
    (tmp_path / "edit.json").write_text(Recipe((step,)).to_json(drawn=True))
    files = [str(tmp_path / name) for name in ("in.png", "out.png", "edit.json")]
    assert main(["apply", *files[:2], "--preset", files[2]]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert sentence in note
    assert read_photograph(files[1]).size == (48, 64)


def test_apply_refuses_what_is_no_edit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["apply", "in.png", str(tmp_path / "out.png"), "--preset", "nothing"]) == 2
    assert "nothing is neither a file nor one of the presets" in capsys.readouterr().err
