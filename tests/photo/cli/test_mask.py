"""The command ``mask``: its help and its errors."""

from pathlib import Path

import pytest

from nlfilter_torch.photo.cli import main

REGION = "30,30,12,8"


def test_help_of_the_mask_says_what_is_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mask", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "a grey picture of the photograph's size, white in the selected area" in shown
    assert ".tif (16 bits), .png, .jpg, .webp, .avif (8 bits) or .pfm (floats)" in shown


REFUSED = [
    ([], "give --region X,Y,W,H, --box X,Y,W,H or --mask FILE to mark the object"),
    (["--region", "80,50,20,20"], "--region must lie within the photograph"),
    (["--region", REGION, "--background", REGION], "background must hold a painted pixel outside the scribbles"),
    (["--region", REGION, "--depth", "float"], "cannot hold this picture: PNG has no floats per channel"),
    (["--region", REGION, "--background", "0,0,0,0"], "--background must be at least 1 pixel wide and high"),
]


def test_errors(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, message in REFUSED:
        assert main(["mask", str(photo), str(tmp_path / "out.png"), *options]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out.png").exists()
