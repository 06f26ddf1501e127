"""``nlfilter-torch app``: what it checks, and the library that it serves."""

from pathlib import Path
from typing import Any

import pytest

from nlfilter_torch.photo.app import server
from nlfilter_torch.photo.app.command import app
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.problems import cat


def test_a_folder_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not exist; create the folder first"):
        app(None, tmp_path / "gone")


def test_the_photographs_of_the_command_are_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[Any] = []
    monkeypatch.setattr(server, "serve", lambda build, picture, **options: served.append((build.__self__, options)))
    images = [tmp_path / "cat.png", tmp_path / "other.png"]
    for image in images:
        write_photograph(Photograph(cat()), image)
    app(images, None, port=0, open=False)
    ((pages, options),) = served
    assert pages.images == images
    assert pages.photographs.folder == tmp_path
    assert options == {"host": "127.0.0.1", "port": 0, "open_page": False}
    assert pages.photographs.open(images[0]).name == "cat.png"
