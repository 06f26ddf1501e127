"""Names of the files in which the editor keeps edits."""

import os
from pathlib import Path

import pytest

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
        assert sidecar.read() == recipe
