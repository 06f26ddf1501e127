"""Training of standard errors: examples of all kinds, values that a later call continues, and the fit."""

from pathlib import Path

import pytest
import torch

from benchmarks.training import error_bars
from benchmarks.training.error_bars import Examples, main
from nlfilter_torch import NoiseProfile
from nlfilter_torch.nn.denoiser.error import ERROR_INPUTS, SHAPES
from nlfilter_torch.nn.denoiser.weights import read_weights
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, value in {"SIDE": 24, "CAMERA_SIDE": 32, "PER_PICTURE": 50, "CAMERAS": 0.6, "EVERY_APART": 3}.items():
        monkeypatch.setattr(error_bars, name, value)
    monkeypatch.setattr(error_bars, "TRAINING", dict.fromkeys(("known", "profile"), (3, 0.1, 0.1)))
    (tmp_path / "pictures").mkdir()
    noise = torch.rand(1, 3, 90, 100, generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.interpolate(noise, (1440, 1600), mode="bicubic").clamp(0, 1)
    write_photograph(Photograph(picture, "uint8"), tmp_path / "pictures" / "one.png")
    return tmp_path


def test_examples_are_of_both_kinds(folder: Path) -> None:
    examples = Examples(folder / "pictures")
    drawn = [examples.drawn(seed) for seed in range(8)]
    assert {isinstance(noise, NoiseProfile) for _, _, _, noise in drawn} == {True, False}
    assert all(noisy.shape == clean.shape for _, noisy, clean, _ in drawn)
    assert torch.equal(examples.drawn(3)[1], drawn[3][1])


def test_values_are_continued_and_fitted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, weights = folder / "values", folder / "weights.safetensors"
    arguments = ["--pictures", str(folder / "pictures"), "--out", str(out), "--count"]
    main([*arguments, "4"])
    first = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    main([*arguments, "12"])
    assert len(list(out.iterdir())) == 12
    assert all((out / name).stat().st_mtime_ns == time for name, time in first.items())
    assert torch.load(next(out.iterdir())).shape == (50, ERROR_INPUTS + 1)
    main(["--out", str(out), "--fit", str(weights)])
    assert [line.split(",")[0] for line in capsys.readouterr().out.splitlines()] == ["known", "profile"]
    assert read_weights(weights, SHAPES).keys() == SHAPES.keys()
