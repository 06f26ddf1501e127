"""Commands of edits: their options and help, and notes on options without an effect."""

import inspect
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

from nlfilter_torch.photo.cli import main, options
from nlfilter_torch.photo.cli.edits import command, option_value, plain_step, preset_step, scribble_options, step_of
from nlfilter_torch.photo.declared.declaration import Edit, Scribble
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.commands import refusal

TECHNICAL = ["--bandwidth", "--spatial-bandwidth", "--patch-size", "--landmarks", "--sampling"]
TECHNICAL += ["--tolerance", "--reach", "--viewing-size", "--residual"]


def test_photographic_options_come_first_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    """Settings of the filter, and those of files and memory, are in sections of their own."""
    for edit in [*EDITS.values(), MASK]:
        assert main([edit.name, "--help"]) == 0
        shown = capsys.readouterr().out
        is_filter = any(parameter.panel == "Filter" for parameter in edit)
        names = (None, "Filter", "Files and memory") if is_filter else (None, "Files and memory")
        starts = [shown.index(f"─ {name or 'Options'} ─") for name in names]
        assert starts == sorted(starts)
        sections = {name: shown[a:b] for name, a, b in zip(names, starts, [*starts[1:], len(shown)], strict=True)}
        for parameter in edit:
            option = f"--{parameter.name.replace('_', '-')}"
            assert (option in sections[parameter.panel]) == parameter.is_option
            assert (parameter.panel == "Filter") == (is_filter and option in TECHNICAL)
        assert ("--seed" in shown) == is_filter
        assert not is_filter or "--seed" in sections["Filter"]
        assert all(option in sections["Files and memory"] for option in ("--depth", "--memory", "--full"))


@pytest.mark.parametrize("verb", ["recolor", "colorize", "defocus", "abstract", "denoise", "sharpen", "tone"])
def test_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    assert f"Usage: nlfilter-torch {verb}" in capsys.readouterr().out


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("arguments", [("look",), ("tone", "--contrast", 1), ("detail", "--alpha", "1,1")])
def test_an_edit_that_changes_nothing_says_so(
    photo: Path, tmp_path: Path, arguments: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *options = map(str, arguments)
    assert main([verb, str(photo), str(tmp_path / "out.png"), *options]) == 0
    note = (
        f"nlfilter-torch: note: {verb} changes nothing with these options: the photograph is written without an edit\n"
    )
    assert note in capsys.readouterr().err
    assert main(["detail", str(photo), str(tmp_path / "out.png"), "--alpha", "1,1", "--region", "2,2,5,5:2,1"]) == 0
    assert "changes nothing" not in capsys.readouterr().err


WITHOUT_NOTES = ["tone --contrast 1", "denoise --patch-size 3", "develop", "apply --preset idle.json"]


def test_what_is_wrong_is_said_without_notes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments in WITHOUT_NOTES:
        monkeypatch.chdir(tmp_path)
        Path("idle.json").write_text(Recipe().to_json())
        verb, *options = arguments.split()
        assert main([verb, "missing.png", "out.png", *options]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "missing.png does not exist" in line


@pytest.mark.usefixtures("tiled")
def test_a_mask_of_another_size_is_refused_without_notes(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit, mask = photo.with_name("idle.json"), photo.with_name("mask.png")
    edit.write_text(Recipe().to_json())
    write_photograph(Photograph(torch.ones(1, 1, 9, 20)), mask)
    sentence = refusal(capsys, "apply", photo, photo.with_name("out.png"), "--preset", edit, "--mask", mask)
    assert sentence.startswith(f"{mask} must have the size of {photo}, 90x60, got 20x9; resize it")


@pytest.mark.usefixtures("tiled")
def test_what_a_file_cannot_hold_is_refused_without_notes(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photograph(Photograph(torch.full((1, 1, 9, 20), 0.4)), photo)
    target = photo.with_name("out.jpg")
    assert "out.jpg" in refusal(capsys, "develop", photo, target, "--warmth", "0.5", "--depth", "16")


def test_options_without_effect_are_named(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.tif"
    assert main(["denoise", str(photo), str(out), "--patch-size", "3"]) == 0
    assert capsys.readouterr().err == (
        "nlfilter-torch: note: --patch-size has no effect on the network; add --method rule to denoise by the filter "
        "alone\n"
    )
    assert main(["denoise", str(photo), str(out), "--patch-size", "3", "--landmarks", "40", "--method", "rule"]) == 0
    assert not capsys.readouterr().err


WRONG_OPTIONS = [
    ("recolor", ["--region", "1,2,5,4:red", "--reach", "1"], "Invalid value for '--reach'"),
    ("defocus", ["--region", "1,2,5,4", "--radius", "0"], "Invalid value for '--radius': "),
    ("detail", ["--region", "1,2,5,4", "--reach", "1"], "Invalid value for '--reach': "),
    ("abstract", ["--tones", "1"], "Invalid value for '--tones'"),
    ("abstract", ["--edge-width", "0"], "Invalid value for '--edge-width': "),
    ("denoise", ["--noise-level", "-1"], "Invalid value for '--noise-level'"),
    ("tone", ["--bandwidth", "0"], "--bandwidth must be a positive number of grey levels"),
    ("denoise", ["--bandwidth", "0"], "Invalid value for '--bandwidth': "),
]


def test_wrong_options(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for verb, wrong, sentence in WRONG_OPTIONS:
        assert refusal(capsys, verb, photo, tmp_path / "out.png", *wrong).startswith(sentence)
        assert [file.name for file in tmp_path.iterdir()] == ["in.png"]


def test_options_of_an_edit_with_two_kinds_of_scribbles() -> None:
    """An edit that declares its scribbles has the options for them, which nothing else names."""
    keep = Scribble("keep", "Keep", role="background", option="--keep", option_help="Pixels to keep.")
    edit = Edit("desaturate", "", (), scribbles=(Scribble("scribbles", "Object", needed=True), keep))
    annotations = scribble_options(edit)
    assert list(annotations) == ["strokes", "region", "keep", "mask", "show"]
    region, keep_option = (get_args(annotations[name])[1] for name in ("region", "keep"))
    assert (region.metavar, region.help) == options.REGIONS["mask"]
    assert keep_option.help == "Pixels to keep."
    colours = Edit("tint", "", (), scribbles=(Scribble("mask", "Colour", "colours"), keep), map_help="A map.")
    marked = ["strokes", "region", "keep", "mask", "colour"]
    assert list(scribble_options(colours)) == [*marked, "source_colour", "show", "map"]
    assert list(scribble_options(replace(colours, coloured=True))) == [*marked, "show", "map"]
    assert not scribble_options(Edit("plain", "", ()))
    parameters = list(inspect.signature(command(edit)).parameters)
    assert parameters[:7] == ["source", "target", "strokes", "region", "keep", "mask", "show"]


def test_values_of_options_are_those_of_steps() -> None:
    for edit in EDITS.values():
        defaults = {p.name: option_value(p, p.default) for p in edit if p.is_option}
        assert step_of(edit, defaults) == Step(edit.name)
    assert step_of(EDITS["detail"], {"alpha": "2,1", "patch_size": 3}) == Step("detail", alpha=(2.0, 1.0), patch_size=3)
    with pytest.raises(ValueError, match="--patch-size must be odd and at least 1, got 4; try 5"):
        step_of(EDITS["detail"], {"patch_size": 4})


def test_steps_that_options_can_express() -> None:
    detail, look = Step("detail", alpha=(2.0, 1.0)), Step("look", saturation=0.5)
    assert plain_step(Recipe((detail,))) == detail
    assert plain_step(Recipe((detail, detail))) is None
    assert plain_step(Recipe((look,))) is None
    assert preset_step(Recipe((look,)), EDITS["detail"]) == look
    assert preset_step(Recipe((look, look)), EDITS["detail"]) is None
    assert preset_step(Recipe((Step("tone", contrast=2.0),)), EDITS["detail"]) is None
