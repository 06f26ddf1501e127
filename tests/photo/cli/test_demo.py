"""The demo writes its pictures."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

from nlfilter_torch.photo.cli import main


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
