"""Colour tables that ``nlfilter-torch fit`` writes, and that other commands take."""

from pathlib import Path

import pytest

from nlfilter_torch.photo import apply_look
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import find_recipe
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.looks import BENT, CUP, SEPIA, VIVID


def test_tables_are_the_look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = str(tmp_path / "before.png"), str(tmp_path / "after.png")
    write_photograph(Photograph(CUP), before)
    write_photograph(Photograph(apply_look(CUP, red=BENT, matrix=SEPIA, saturation=VIVID)), after)
    preset, cube, hald = (str(tmp_path / name) for name in ("look.json", "look.cube", "hald.png"))
    assert main(["fit", before, after, preset, "--cube", cube, "--hald", hald, "--landmarks", "40"]) == 0
    told = capsys.readouterr().out
    assert f"table: {cube} carries 100.0 % of the change; 33^3 colours are off by 0.0" in told
    exact = apply_step(find_recipe(preset).steps[0], CUP).clamp(0, 1)
    for table in (cube, hald):
        shown = apply_step(find_recipe(table).steps[0], CUP).clamp(0, 1)
        assert float((shown - exact).abs().max()) < 1 / 255  # where dark colours are of every saturation
        assert float((shown - exact).abs().mean()) < 0.02 / 255
        out = str(tmp_path / "out.png")
        for command in (["apply", before, out, "--preset", table], ["detail", before, out, "--preset", table]):
            assert main(command) == 0
            assert float((read_photograph(out).pixels - exact).abs().max()) < 1.01 / 255
    folder = tmp_path / "folder"
    folder.mkdir()
    write_photograph(Photograph(CUP), folder / "cup.png")
    assert main(["batch", str(folder), str(tmp_path / "done"), "--preset", cube]) == 0
    assert float((read_photograph(tmp_path / "done" / "cup.png").pixels - exact).abs().max()) < 1.01 / 255


def test_files_of_other_kinds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = str(tmp_path / "before.png")
    write_photograph(Photograph(CUP), before)
    for option, path, message in (
        ("--cube", "look.txt", "--cube must end in .cube"),
        ("--hald", "before.png", "--hald must be another file than the photographs"),
    ):
        assert main(["fit", before, before, str(tmp_path / "a.json"), option, str(tmp_path / path)]) == 2
        assert message in capsys.readouterr().err
