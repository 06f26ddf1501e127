"""Messages of ``denoise`` about the measured noise and the change, in memory and in tiles."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.io.photographs import Photograph, write_photograph


def write(path: Path, noise: float, *, alpha: bool = False) -> Path:
    ramp = torch.linspace(0.2, 0.8, 96).expand(1, 3, 64, 96)
    pixels = ramp + noise / 255 * torch.randn(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    write_photograph(
        Photograph(pixels.clamp(0, 1), "uint16", torch.full_like(pixels[:, :1], 0.5) if alpha else None), path
    )
    return path


def pixels(path: Path) -> np.ndarray:
    import tifffile

    found: np.ndarray = tifffile.imread(path).astype(float) / 257
    return found


@pytest.mark.parametrize("alpha", [False, True])
def test_noise_that_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str], tiled: bool, alpha: bool) -> None:
    photo, out = write(tmp_path / "in.tif", 10.0, alpha=alpha), tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--landmarks", "40", *(["--full"] if tiled else [])]) == 0
    said = re.fullmatch(
        r"denoise: estimated noise of ([\d.]+) grey levels; pixels changed by ([\d.]+) grey levels \(RMS\)\n",
        capsys.readouterr().out,
    )
    assert said is not None
    assert float(said[1]) == pytest.approx(10, abs=0.6)
    before, after = pixels(photo)[..., :3], pixels(out)[..., :3]
    change = np.sqrt(np.square(after - before).mean())
    assert change > 2
    assert float(said[2]) == pytest.approx(change, abs=0.02)


def test_nothing_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str], tiled: bool) -> None:
    photo, out = write(tmp_path / "in.tif", 0.0), tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--landmarks", "40"]) == 0
    assert "less than 0.1; no pixel changed\n" in capsys.readouterr().out
    np.testing.assert_array_equal(pixels(photo), pixels(out))


def test_a_level_that_is_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 2.0)
    arguments = ["denoise", str(photo), str(tmp_path / "out.tif"), "--landmarks", "40", "--noise-level"]
    assert main([*arguments, "3"]) == 0
    assert "given noise of 3.00 grey levels; pixels changed by" in capsys.readouterr().out
    assert main([*arguments, "0.2"]) == 0
    assert "which is barely visible\n" in capsys.readouterr().out


def test_little_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 0.3)
    assert main(["denoise", str(photo), str(tmp_path / "out.png"), "--landmarks", "40"]) == 0
    assert "which is barely visible; --strength 2 removes more" in capsys.readouterr().out
    with Image.open(tmp_path / "out.png") as opened:
        assert opened.size == (96, 64)


def test_options_without_effect_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo, out = write(tmp_path / "in.tif", 10.0), tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--patch-size", "3"]) == 0
    assert capsys.readouterr().err == (
        "nlfilter-torch: note: --patch-size has no effect on the network; add --method rule to denoise by the filter "
        "alone\n"
    )
    assert main(["denoise", str(photo), str(out), "--patch-size", "3", "--landmarks", "40", "--method", "rule"]) == 0
    assert not capsys.readouterr().err
