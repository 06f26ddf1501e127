"""What the page asks in dialogs."""

from pathlib import Path

import pytest
from nicegui import Client

from nlfilter_torch.photo.app.dialogs import NameDialog, SaveDialog


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    answers: list[str] = []
    monkeypatch.setattr("nicegui.ui.dialog.submit", lambda dialog, name: answers.append(name))
    return answers


def test_a_name(client: Client, answers: list[str], tmp_path: Path) -> None:
    """One that cannot be used, a file that is there already, and that of a new file."""
    (tmp_path / "old.png").touch()

    def check(name: str) -> Path:
        if not name.endswith(".png"):
            raise ValueError(f"{name} must end in .png")
        return tmp_path / name

    dialog = NameDialog("Save the photograph", "photo.gif", tmp_path, check)
    assert dialog._note.text == f"In {tmp_path}"
    dialog._confirm()
    assert dialog._note.text == "photo.gif must end in .png"
    dialog._name.set_value("old.png")
    assert (dialog._ok.text, dialog._note.text) == ("Save", "A file of that name is there already.")
    dialog._confirm()
    assert (dialog._ok.text, dialog._note.text) == ("Replace", "A file of that name is there already. Replace it?")
    assert answers == []
    dialog._name.set_value("new.png")
    assert dialog._ok.text == "Save"
    dialog._name.set_value("old.png")
    dialog._confirm()
    dialog._confirm()
    dialog._name.set_value("new.png")
    dialog._confirm()
    assert answers == ["old.png", "new.png"]


def test_options_of_a_file(client: Client, tmp_path: Path) -> None:
    dialog = SaveDialog("Save the photograph", "photo.png", tmp_path, lambda name: tmp_path / name, 150)
    assert not dialog._lossy.visible
    dialog._name.set_value("photo.JPG")
    assert dialog._lossy.visible
    assert dialog.options == (95, None)
    dialog._quality.set_value(80)
    dialog._side.set_value(75)
    assert dialog.options == (80, 75)
    for side in (None, 150):
        dialog._side.set_value(side)
        assert dialog.options[1] is None
        assert dialog._note.text == f"In {tmp_path}"


def test_a_size_out_of_range_is_refused(client: Client, answers: list[str], tmp_path: Path) -> None:
    dialog = SaveDialog("Save the photograph", "photo.png", tmp_path, lambda name: tmp_path / name, 150)
    for side in (3, 4000):
        dialog._side.set_value(side)
        said = f"the longest side must be from 16 to 150 pixels, got {side}; leave it empty to keep the size"
        assert dialog._note.text == said
        dialog._confirm()
        assert (answers, dialog._note.text) == ([], said)
    dialog._side.set_value(16)
    dialog._confirm()
    assert (answers, dialog.options[1]) == (["photo.png"], 16)
