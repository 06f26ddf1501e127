"""Edits that use tiles automatically, and progress of saving in the editor."""

from pathlib import Path

import pytest

from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.cli import editing, main
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.problems import LINE, cat, difference


def test_the_command_line_goes_to_tiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_photograph(Photograph(cat().repeat(1, 1, 2, 3)), tmp_path / "in.tif")
    options = ("--alpha", "2,1.5,1", "--landmarks", "20")
    arguments = ["detail", str(tmp_path / "in.tif"), str(tmp_path / "out.tif"), *options]
    used: list[bool] = []
    read = editing.read_if_it_fits

    def watched(*arguments: object) -> Photograph | None:
        photograph = read(*arguments)  # type: ignore[arg-type]
        used.append(photograph is None)
        return photograph

    monkeypatch.setattr(editing, "read_if_it_fits", watched)
    assert main(arguments) == 0
    whole = read_photograph(tmp_path / "out.tif").pixels
    monkeypatch.setattr(editing, "WHOLE_MEMORY", 38_000_000)
    assert main(arguments) == 0
    assert used == [False, True]
    assert difference(read_photograph(tmp_path / "out.tif").pixels, whole) <= 2


def test_saving_in_the_editor_reports_its_progress(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """In memory and, for a large photograph, in tiles."""
    session.set("detail", alpha=(2.0, 1.5, 1.0, 1.0))
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    saved = []
    for name, memory, in_tiles in (("small.png", 10**9, False), ("large.png", 0, True)):
        monkeypatch.setattr("nlfilter_torch.photo.app.session.WHOLE_MEMORY", memory)
        stages: list[str] = []
        saved.append(read_photograph(session.save(name, lambda stage, *_, told=stages: told.append(stage))).pixels)
        assert stages[-1] == "Writing"
        assert len(set(stages)) > 2 if in_tiles else set(stages) == {"Editing", "Writing"}
    assert float((saved[0] - saved[1]).square().mean().sqrt()) * 255 < 1
    assert sorted(path.name for path in session.folder.iterdir()) == ["cat.png", "large.png", "small.png"]
