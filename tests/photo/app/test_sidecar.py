"""Names of the files in which the editor keeps edits."""

import os
from pathlib import Path

import pytest

from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.app.sidecar import Sidecar
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step


@pytest.mark.parametrize("stem", ["x" * 233, "x" * 246, "写" * 81])
def test_long_names(stem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    photograph = tmp_path / f"{stem}.jpg"
    photograph.touch()
    recipe = Recipe((Step("tone", contrast=1.3),))
    for path in (photograph, None):
        sidecar = Sidecar.of(path, photograph.name, "0" * 64)
        assert len(os.fsencode(sidecar.path.name)) <= 255
        sidecar.write(recipe)
        assert sidecar.trouble is None
        assert sidecar.read((9, 9)) == recipe


def test_a_crop_outside_the_photograph_is_trouble(session: Session, tmp_path: Path) -> None:
    sidecar = Sidecar(tmp_path / "cat.png.edit.json")
    sidecar.path.write_text('{"version": 1, "develop": {"straighten": 30, "crop": [0, 0, 0.02, 0.02]}, "steps": []}')
    session.keep_in(sidecar)
    assert session.recipe == Recipe()
    assert session.trouble is not None
    assert session.trouble.startswith(f"{sidecar.path}: crop must have its middle within the photograph")
    assert session.trouble.endswith("and the file was renamed to cat.png.edit.json.unreadable")
    assert session.render().shape[-2:] == session.size
