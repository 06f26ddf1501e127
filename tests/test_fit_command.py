"""``nlfilter-torch fit`` and ``detail --preset``: an edit is saved to a file and applied to another photograph."""

import json
from pathlib import Path

import pytest
import skimage.data
import torch

from nlfilter_torch.cli import main
from nlfilter_torch.edits.presets import Preset
from nlfilter_torch.io.photographs import Photograph, read_photograph, write_photograph

ALPHA = (2.2, 1.6, 1.3, 1.02)


def photograph(rows: slice, columns: slice) -> torch.Tensor:
    return torch.from_numpy(skimage.data.chelsea()[rows, columns].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def before(tmp_path: Path) -> Path:
    write_photograph(Photograph(photograph(slice(60, 140), slice(100, 200))), tmp_path / "before.png")
    return tmp_path / "before.png"


def edit(before: Path, name: str = "after.png", *options: object) -> Path:
    after = before.with_name(name)
    sliders = ",".join(map(str, ALPHA))
    plain = ("--landmarks", "40", "--limits", "none", "--threshold", "0")  # a linear edit can be fitted exactly
    assert main(["detail", str(before), str(after), "--alpha", sliders, *plain, *map(str, options)]) == 0
    return after


def fit(*arguments: object) -> int:
    return main(["fit", *map(str, arguments), "--landmarks", "40"])


def test_fit_finds_the_sliders_and_how_much_they_explain(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    preset = before.with_name("look.json")
    assert fit(before, edit(before), preset) == 0
    printed = capsys.readouterr().out
    found = Preset.from_json(preset.read_text(), "look.json")
    assert found.alpha == pytest.approx(ALPHA, rel=0.02)
    assert "alpha: 2.2" in printed
    explained = float(printed.split("explained: ")[1].split(" %")[0])
    assert explained > 99.0
    assert str(preset) in printed


@pytest.mark.parametrize(("name", "options"), [("after.tif", ("--depth", "float")), ("after.png", ("--depth", 16))])
def test_fit_reads_every_depth(before: Path, name: str, options: tuple[object, ...]) -> None:
    preset = before.with_name("look.json")
    assert fit(before, edit(before, name, *options), preset) == 0
    assert json.loads(preset.read_text())["steps"][0]["alpha"] == pytest.approx(ALPHA, rel=0.02)


def test_an_edit_of_another_kind_is_explained_in_part(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    after = before.with_name("after.png")
    pixels = read_photograph(before).pixels
    brighter = pixels.clone()
    brighter[..., :40, :] = brighter[..., :40, :] + 0.1  # the filter does not depend on position
    write_photograph(Photograph(brighter), after)
    assert fit(before, after, before.with_name("look.json"), "--bandwidth", 10) == 0
    explained = float(capsys.readouterr().out.split("explained: ")[1].split(" %")[0])
    assert 0 < explained < 90


def test_a_preset_is_the_edit(before: Path) -> None:
    preset, after = before.with_name("look.json"), edit(before)
    assert fit(before, after, preset) == 0
    again, other = before.with_name("again.png"), before.with_name("other.png")
    assert main(["detail", str(before), str(again), "--preset", str(preset)]) == 0
    difference = read_photograph(again).pixels - read_photograph(after).pixels
    assert difference.abs().max() <= 1.01 / 255
    assert (difference != 0).float().mean() < 0.01

    write_photograph(Photograph(photograph(slice(150, 200), slice(200, 260))), other)
    by_preset = before.with_name("by-preset.png")
    assert main(["detail", str(other), str(by_preset), "--preset", str(preset)]) == 0
    by_options = edit(other, "by-options.png")
    assert (read_photograph(by_preset).pixels - read_photograph(by_options).pixels).abs().max() <= 1.01 / 255


def test_options_count_for_more_than_the_preset(before: Path) -> None:
    preset = before.with_name("look.json")
    preset.write_text(Preset(ALPHA, landmarks=40).to_json())
    out = before.with_name("out.png")
    assert main(["detail", str(before), str(out), "--preset", str(preset), "--alpha", "1,1"]) == 0
    assert torch.equal(read_photograph(out).pixels, read_photograph(before).pixels)


def test_preset_keeps_every_entry() -> None:
    preset = Preset((3.0, 0.25, 1.0), 12.5, 40.0, 7, 60, "uniform")
    assert Preset.from_json(preset.to_json(), "it") == preset
    assert Preset.from_json('{"alpha": [2, 1]}', "it") == Preset((2.0, 1.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("alpha = 1", "look.json is not a preset: it is not JSON"),
        ("[1, 2]", "look.json is not a preset: it must hold a list of steps"),
        ('{"bandwidth": 3}', "look.json is not a preset: it must hold a list of steps"),
        ('{"version": 1, "steps": [{"edit": "tone"}]}', "--preset must hold a look or a single detail step without"),
        ('{"alpha": [1]}', "alpha in look.json must be a list of 2 to 100 numbers from -1000000 to 1000000, got [1]"),
        ('{"alpha": [1, NaN]}', "alpha in look.json must be a list of 2 to 100 numbers"),
        ('{"alpha": [1, 1], "bandwidth": 0}', "bandwidth in look.json must be a positive number of grey levels"),
        ('{"alpha": [1, 1], "spatial_bandwidth": "far"}', "spatial_bandwidth in look.json must be a positive number"),
        ('{"alpha": [1, 1], "patch_size": 4}', "patch_size in look.json must be an odd number from 1 to 99, got 4"),
        ('{"alpha": [1, 1], "landmarks": true}', "landmarks in look.json must be a whole number from 1 to 10000"),
        ('{"alpha": [1, 1], "sampling": "best"}', 'sampling in look.json must be "kmeans", "uniform" or "random"'),
        ('{"alpha": [1, 1], "colour": 1}', "look.json must have no entries other than alpha, inside, residual"),
    ],
)
def test_a_preset_that_is_none_is_told(
    before: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    monkeypatch.chdir(before.parent)
    Path("look.json").write_text(text)
    assert main(["detail", str(before), "out.png", "--preset", "look.json"]) == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
    assert not Path("out.png").exists()


def test_a_preset_is_written_over(before: Path) -> None:
    preset = before.with_name("look.json")
    preset.write_text("an older one")
    assert fit(before, edit(before), preset) == 0
    assert Preset.from_json(preset.read_text(), "look.json").alpha == pytest.approx(ALPHA, rel=0.02)


def test_what_cannot_be_fitted_is_told(before: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small, clipped, preset = (before.with_name(name) for name in ("small.png", "clipped.png", "look.json"))
    pixels = read_photograph(before).pixels
    write_photograph(Photograph(pixels[..., :50, :60].flip(1, 2, 3)), small)
    write_photograph(Photograph((pixels > 0.5).float()), clipped)
    folder = before.with_name("nowhere") / "look.json"
    cases = {
        (before, small, preset): "small.png must have the size of",
        (before, before, preset): "must differ from",
        (before, clipped, preset): "must have pixels that are not clipped",
        (before, before.with_name("none.png"), preset): "none.png does not exist",
        (before, clipped, folder): "does not exist; make it first",
        (before, clipped, before.parent): "is a folder; add a file name to it",
    }
    for arguments, message in cases.items():
        assert fit(*arguments) == 2
        complaint = capsys.readouterr().err
        assert message in complaint
        assert complaint.count("\n") == 1
    assert main(["detail", str(before), str(small), "--preset", str(before.with_name("none.json"))]) == 2
    assert "none.json is neither a file nor one of the presets" in capsys.readouterr().err
    assert not preset.exists()
