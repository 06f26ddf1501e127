"""Stored edits: beside the photograph or in the user's state folder, for every tab and after a restart."""

import shutil
from pathlib import Path

import pytest

from nlfilter_torch.photo.app.library import Library
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.problems import LINE, cat, difference


@pytest.fixture
def shots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a photograph, cat.png."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder = tmp_path / "shots"
    folder.mkdir()
    write_photograph(Photograph(cat()), folder / "cat.png")
    return folder


def edit(session: Session) -> Recipe:
    """Some sliders and a scribble."""
    session.set("tone", contrast=1.3)
    session.commit()
    session.add_stroke("recolor", LINE, 0.03, "#2040e0")
    session.add_stroke("detail", LINE, 0.03, "in")  # changes nothing yet
    return session.recipe


def test_an_edit_survives_the_program(shots: Path) -> None:
    session = Library(shots).open(shots / "cat.png")
    assert not session.unsaved
    recipe = edit(session)
    assert session.unsaved
    again = Library(shots).open(shots / "cat.png")
    assert again.recipe == recipe
    assert not again.unsaved
    assert not again.can_undo
    assert again.trouble is None
    again.set("tone", contrast=1.5)  # an unfinished drag is not stored
    assert Library(shots).open(shots / "cat.png").recipe == recipe


def test_the_file_is_one_for_apply(shots: Path) -> None:
    session = Library(shots).open(shots / "cat.png")
    edit(session)
    kept = shots / "cat.png.edit.json"
    assert main(["apply", str(shots / "cat.png"), str(shots / "out.png"), "--preset", str(kept)]) == 0
    assert difference(read_photograph(shots / "out.png").pixels, apply_recipe(session.recipe, cat())) <= 1
    while session.undo():
        pass
    assert not kept.exists()  # nothing to store
    session.redo()
    assert kept.exists()


def test_tabs_share_a_photograph(shots: Path) -> None:
    library = Library(shots)
    first, second = library.open(shots / "cat.png"), library.open(shots / "cat.png")
    assert first is second
    assert library.reopen("cat.png") is first


def test_what_the_browser_sends_is_the_file_if_it_is_the_same(shots: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copy(shots / "cat.png", copy)
    library = Library(shots)
    session = library.open_upload(copy, "cat.png")
    assert session is library.open(shots / "cat.png")
    assert session.address == "cat.png"
    write_photograph(Photograph(cat()[..., :50, :]), tmp_path / "other.png")
    other = library.open_upload(tmp_path / "other.png", "../cat.png")
    assert other is not session
    assert other.name == "cat.png"
    recipe = edit(other)
    assert session.recipe == Recipe()
    assert [path.name for path in shots.iterdir()] == ["cat.png"]  # nothing beside another photograph
    (kept,) = (tmp_path / "state" / "nlfilter-torch").iterdir()
    assert kept.name.endswith("-cat.png.edit.json")
    assert Library(tmp_path).open_upload(tmp_path / "other.png", "cat.png").recipe == recipe
    assert library.reopen(other.address) is other
    with pytest.raises(ValueError, match="open the photograph again"):
        Library(shots).reopen(other.address)


def test_a_folder_that_cannot_be_written_to(shots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlfilter_torch.photo.app.sidecar.os.access", lambda *_: False)
    recipe = edit(Library(shots).open(shots / "cat.png"))
    assert [path.name for path in shots.iterdir()] == ["cat.png"]
    assert Library(shots).open(shots / "cat.png").recipe == recipe


def test_a_full_disk_loses_nothing_that_was_kept(shots: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Library(shots).open(shots / "cat.png")
    recipe = edit(session)
    with monkeypatch.context() as patched:

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device")

        patched.setattr("nlfilter_torch.photo.app.sidecar.open_beside", full)
        session.set("tone", contrast=1.6)
        session.commit()
        assert session.trouble is not None
        assert "No space left on device" in session.trouble
        session.restore()  # a second tab
        assert session.recipe.current("tone")["contrast"] == 1.6
    assert Library(shots).open(shots / "cat.png").recipe == recipe
    session.set("tone", contrast=1.7)
    session.commit()
    assert session.trouble is None
    assert Library(shots).open(shots / "cat.png").recipe == session.recipe


def test_a_file_that_is_damaged_is_set_aside(shots: Path) -> None:
    (shots / "cat.png.edit.json").write_text("{")
    session = Library(shots).open(shots / "cat.png")
    assert session.recipe == Recipe()
    assert session.trouble is not None
    assert "renamed to cat.png.edit.json.unreadable" in session.trouble
    assert (shots / "cat.png.edit.json.unreadable").read_text() == "{"


def test_a_damaged_file_in_a_read_only_folder_stays(shots: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (shots / "cat.png.edit.json").write_text("{")

    def refuse(path: Path, target: Path) -> Path:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "replace", refuse)  # as root, a test cannot make a folder read-only
    session = Library(shots).open(shots / "cat.png")
    assert session.recipe == Recipe()
    assert session.trouble is not None
    assert session.trouble.endswith("the photograph is shown unedited")
    assert (shots / "cat.png.edit.json").read_text() == "{"


def test_a_file_that_someone_else_changed_counts(shots: Path) -> None:
    library = Library(shots)
    session = library.open(shots / "cat.png")
    recipe = edit(session)
    (shots / "cat.png.edit.json").unlink()
    assert library.open(shots / "cat.png") is session
    assert session.recipe == Recipe()
    session.undo()
    assert session.recipe == recipe


@pytest.mark.parametrize("address", ["other.png", "../cat.png", "/etc/passwd", "cat.png", ""])
def test_addresses_open_what_was_edited_here_and_nothing_else(shots: Path, address: str) -> None:
    write_photograph(Photograph(cat()), shots / "other.png")
    with pytest.raises(ValueError, match="open the photograph again"):
        Library(shots).reopen(address)


def test_an_address_after_a_new_start(shots: Path) -> None:
    recipe = edit(Library(shots).open(shots / "cat.png"))
    assert Library(shots).reopen("cat.png").recipe == recipe


def test_the_photograph_is_not_replaced_by_its_edited_version(shots: Path) -> None:
    """The edit that is kept for it would be applied to that again."""
    session = Library(shots).open(shots / "cat.png")
    edit(session)
    with pytest.raises(ValueError, match=r"the name must not be that of the photograph, got 'cat\.png': .*; choose"):
        session.save("cat.png")
    assert difference(read_photograph(shots / "cat.png").pixels, cat()) < 1
    session.save("other.png")


def test_an_image_is_opened_ahead(shots: Path) -> None:
    library = Library.opening(shots, [shots / "cat.png"])
    session = library.open(shots / "cat.png")  # waits for it
    assert library.reopen("cat.png") is session
    broken = shots / "notes.png"
    broken.write_text("dear diary")
    with pytest.raises(ValueError, match=r"notes\.png is not a PNG"):
        Library.opening(shots, [broken]).open(broken)


def test_what_the_browser_sent_is_opened_again(shots: Path, tmp_path: Path) -> None:
    """Files of the folder are recognised, and others are kept while the editor runs."""
    library, other = Library(shots), tmp_path / "sent"
    shutil.copy(shots / "cat.png", other)
    assert library.shot_of_upload(other, "cat.png").original == shots / "cat.png"
    shot = library.shot_of_upload(other, "elsewhere.png")
    other.unlink()
    assert library.session(shot).name == "elsewhere.png"
    assert library.shot_of(library.session(shot)) == shot
    library._latest = None
    assert library.reopen(shot.address).name == "elsewhere.png"
