"""The comparison on pairs of real noise: which pairs are for what, and the table."""

from pathlib import Path

import pytest
import torch

from benchmarks.real_noise import listed, main, pairs_of, true_levels
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.problems import colour


def write_pair(folder: Path, name: str, seed: int) -> None:
    clean = colour("chelsea", 120, 130).clamp(0, 1)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
    for ending, pixels in (("real", clean + 8 / 255 * noise), ("mean", clean)):
        write_photograph(Photograph(pixels.clamp(0, 1), "uint8"), folder / f"{name}_{ending}.png")


def test_no_scene_is_in_both_sets() -> None:
    choosing, reporting = listed("choosing"), listed("reporting")
    assert (len(choosing), len(reporting)) == (35, 20)
    scenes = [{name.rsplit("_", 1)[0] for name in names} for names in (choosing, reporting)]
    assert not scenes[0] & scenes[1]
    assert {name.split("_")[0] for name in reporting} == {"Canon5D2", "Canon600D", "Canon80D"}


def test_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_pair(tmp_path, "first", 0)
    write_pair(tmp_path, "second", 1)
    main([str(tmp_path), "--quick"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["pair", "noisy", "ours"]
    assert [line.split()[0] for line in lines[1:4]] == ["first", "second", "mean"]
    noisy, ours = map(float, lines[3].split()[1:3])
    assert ours > noisy + 2
    assert lines[-2].startswith("estimated over true level of luminance, by scale, median (median error): 1: ")


def test_clean_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photograph(Photograph(colour("rocket", 100, 100).clamp(0, 1), "uint8"), tmp_path / "rocket.png")
    main(["--clean", str(tmp_path), "--quick"])
    assert "dB to itself" in capsys.readouterr().out


def test_true_levels_ignore_rare_errors(tmp_path: Path) -> None:
    write_pair(tmp_path, "pair", 0)
    (_, noisy, clean), *_ = pairs_of(tmp_path, None)
    levels = true_levels(noisy, clean)
    torch.testing.assert_close(levels[0], torch.tensor([8 / 255 / 3**0.5, 8 / 255]), rtol=0.1, atol=0)
    noisy[..., :2] += torch.tensor([0.5, -0.5])
    torch.testing.assert_close(true_levels(noisy, clean)[:3], levels[:3], rtol=0.15, atol=0)
