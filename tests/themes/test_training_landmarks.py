"""The benchmark of landmarks that are held keeps its limits on a small picture, and draws the curves of the page."""

from pathlib import Path

import pytest
from PIL import Image

from benchmarks.layers import landmarks
from benchmarks.layers.__main__ import main
from benchmarks.photographs import photograph
from docs.landmarks_training import draw


@pytest.mark.slow
def test_every_limit_holds_on_a_small_picture(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["landmarks", "--quick"]) == 0
    assert capsys.readouterr().out.count("holds") == 6


def test_slopes_and_recovery_with_landmarks_that_are_held() -> None:
    image = landmarks.crop(photograph("coins"), 24)
    for choice in landmarks.HELD:
        assert landmarks.slope_error(choice, image, 1e-3) < 0.01
        assert landmarks.answer_to_noise(choice, image) < 1e-4
    assert landmarks.recover(landmarks.ASSIGNED, image).error < 1e-6


@pytest.mark.slow
def test_curves_are_drawn(tmp_path: Path) -> None:
    draw(tmp_path / "curves.png", side=24)
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width == 900
