"""Training of the estimate of noise: pairs of all kinds, parts that a later call continues, and the fit."""

from pathlib import Path

import pytest
import torch

from benchmarks.training import noise_profiles, profile_fit
from benchmarks.training.noise_profiles import KINDS, Pairs, main, part_of
from nlfilter_torch.nn.denoiser.estimate import SHAPES
from nlfilter_torch.nn.denoiser.network import read_weights
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pictures").mkdir()
    noise = torch.rand(1, 3, 90, 100, generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.interpolate(noise, (1440, 1600), mode="bicubic").clamp(0, 1)
    write_photograph(Photograph(picture, "uint8"), tmp_path / "pictures" / "one.png")
    return tmp_path


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(noise_profiles, "SIDES", (48, 64))
    monkeypatch.setattr(noise_profiles, "PART", 12)
    monkeypatch.setattr(noise_profiles, "HELD_PARTS", 1)


def test_pairs_of_all_kinds(folder: Path) -> None:
    pairs = [pair for pair, _ in zip(Pairs(folder, held_out=False).drawn(0), range(40), strict=False)]
    assert {pair.kind for pair in pairs} == set(KINDS)
    for pair in pairs:
        assert pair.noisy.shape == pair.clean.shape
        assert pair.noisy.shape[0] in (1, 3)
        assert torch.equal(pair.noisy, pair.clean) == (pair.kind == "clean")
    again = next(Pairs(folder, held_out=False).drawn(0))
    assert torch.equal(again.noisy, pairs[0].noisy)


def test_parts_are_continued_and_fitted(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, weights = folder / "parts", folder / "weights.safetensors"
    arguments = ["--pictures", str(folder), "--aside", str(folder), "--out", str(out), "--parts"]
    main([*arguments, "1"])
    assert capsys.readouterr().out.splitlines() == ["held 1 of 1", "train 1 of 1"]
    main([*arguments, "2"])
    assert capsys.readouterr().out.splitlines() == ["train 2 of 2"]
    monkeypatch.setattr(profile_fit, "STEPS", 1000)
    monkeypatch.setattr(profile_fit, "BATCH", 4)
    main(["--out", str(out), "--fit", str(weights)])
    assert capsys.readouterr().out.startswith("1000: loss ")
    assert read_weights(weights, SHAPES).keys() == SHAPES.keys()


def test_a_part_does_not_depend_on_those_before(folder: Path) -> None:
    pairs = Pairs(folder, held_out=True)
    first, again = part_of(pairs, 3), part_of(pairs, 3)
    for name, values in first.items():
        assert torch.equal(values, again[name])
