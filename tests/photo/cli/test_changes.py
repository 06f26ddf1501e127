"""How much edits change a photograph, what the commands say of it, and maps of what an edit estimates."""

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.cli.changes import ChangeMeter, squared_difference, write_map
from nlfilter_torch.photo.picture.edit import Rows
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph


def write(path: Path, noise: float, *, alpha: bool = False) -> Path:
    ramp = torch.linspace(0.2, 0.8, 96).expand(1, 3, 64, 96)
    pixels = ramp + noise / 255 * torch.randn(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    write_photograph(
        Photograph(pixels.clamp(0, 1), "uint16", torch.full_like(pixels[:, :1], 0.5) if alpha else None), path
    )
    return path


def pixels(path: Path) -> np.ndarray:
    levels: np.ndarray = tifffile.imread(path).astype(float) / 257
    return levels


@pytest.mark.parametrize("alpha", [False, True])
def test_estimated_noise_and_the_change_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], tiled: bool, alpha: bool
) -> None:
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
    assert "estimated noise of 0.00 grey levels, less than 0.1; no pixel changed: " in capsys.readouterr().out
    np.testing.assert_array_equal(pixels(photo), pixels(out))


def test_a_chosen_level_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 2.0)
    arguments = ["denoise", str(photo), str(tmp_path / "out.tif"), "--landmarks", "40", "--noise-level"]
    assert main([*arguments, "3"]) == 0
    assert "given noise of 3.00 grey levels; pixels changed by" in capsys.readouterr().out
    assert main([*arguments, "0.2"]) == 0
    assert "which is barely visible\n" in capsys.readouterr().out


def test_little_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = write(tmp_path / "in.tif", 0.3)
    assert main(["denoise", str(photo), str(tmp_path / "out.png"), "--landmarks", "40"]) == 0
    assert "which is barely visible, as is the noise\n" in capsys.readouterr().out  # a clean one has none to remove
    with Image.open(tmp_path / "out.png") as opened:
        assert opened.size == (96, 64)


def test_denoise_recommends_only_more_strength(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = torch.randn(1, 3, 64, 96, generator=torch.Generator().manual_seed(0)) * 0.52 / 255
    rough = torch.linspace(0.1, 0.9, 96) + noise
    source = tmp_path / "in.tif"
    write_photograph(Photograph(rough, "float32"), source)
    for strength, recommended in ((1, True), (2, False), (0, False)):
        assert main(["denoise", str(source), str(tmp_path / "out.tif"), "--strength", str(strength)]) == 0
        printed = capsys.readouterr().out
        assert ("--strength 2 removes more" in printed) == recommended


@pytest.mark.parametrize(
    ("arguments", "note"),
    [
        (["--brightness", "0"], "in.png is grey: with brightness 0 all of its noise is left"),
        (["--colour", "0.5"], "in.png is grey: colour changes nothing"),
        (["--brightness", "0.5"], None),
    ],
)
def test_a_grey_photograph_has_no_coloured_noise(
    arguments: list[str], note: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "in.png"
    grey = torch.linspace(0.1, 0.9, 96) + torch.randn(1, 1, 64, 96, generator=torch.Generator().manual_seed(0)) / 50
    write_photograph(Photograph(grey.clamp(0, 1)), source)
    assert main(["denoise", str(source), str(tmp_path / "out.png"), *arguments]) == 0
    printed = capsys.readouterr()
    assert "removes more" not in printed.out
    assert printed.err == ("" if note is None else f"nlfilter-torch: note: {tmp_path}/{note}\n")


def test_the_change_is_a_root_mean_square_in_grey_levels() -> None:
    meter = ChangeMeter()
    assert meter.change == 0
    before = np.zeros((4, 5, 3), np.uint8)
    meter.add(squared_difference(before, before + np.uint8(3)))
    assert meter.change == pytest.approx(3)
    meter.add(squared_difference(before, before + np.uint8(4)))  # as many values
    assert meter.change == pytest.approx(12.5**0.5)
    meter.add(squared_difference(before[:0], before[:0]))
    assert meter.change == pytest.approx(12.5**0.5)


def test_differences_are_compared_in_the_depth_of_each_file() -> None:
    rows = np.random.default_rng(0).integers(0, 256, (6, 7, 3)).astype(np.uint8)
    for same in (rows.astype(np.uint16) * 257, rows / np.float32(255)):
        squares, count = squared_difference(rows, same)
        assert squares < 1e-10
        assert count == 6 * 7 * 3


def test_transparency_is_not_compared() -> None:
    before, after = np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5, 4), np.uint8)
    after[..., 3] = 255
    assert squared_difference(before, after) == (0, 0)
    before[1:, :, 3] = 1
    assert squared_difference(before, after) == (0, 45)
    assert squared_difference(before[..., 2:], after[..., 2:]) == (0, 15)  # grey


def neighbours(image: torch.Tensor) -> torch.Tensor:
    """A map that depends on two pixels around each."""
    return torch.nn.functional.avg_pool2d(image.mean(1, keepdim=True), 5, 1, 2, count_include_pad=False)


def test_a_map_has_no_seams(tmp_path: Path) -> None:
    image = torch.rand(1, 3, 600, 20, generator=torch.Generator().manual_seed(0))
    read: list[int] = []

    def rows(part: slice) -> torch.Tensor:
        read.append(part.stop - part.start)
        return image[..., part, :]

    write_map(neighbours, Rows("in.tif", (600, 20), 3, rows), tmp_path / "map.png")
    stored = read_photograph(tmp_path / "map.png")
    assert stored.depth == "uint16"
    assert (stored.pixels - neighbours(image)).abs().max() < 1e-5
    assert max(read) < 600 <= sum(read)
