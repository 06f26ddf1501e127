"""Options with values that make no sense: one sentence each."""

from pathlib import Path

import pytest

from tests.commands import refusal, refused

WRONG_OPTIONS = [
    (["--alpha", "3"], "--alpha must have at least two numbers, such as 3,3,4,1.05, got '3'"),
    (["--alpha", "3,x"], "--alpha must be numbers separated by commas, such as 3,3,4,1.05, got '3,x'"),
    (["--alpha", "3,nan"], "--alpha must be finite numbers, such as 3,3,4,1.05, got '3,nan'"),
    (["--bandwidth", "0"], "--bandwidth must be a positive number of grey levels, such as 20, or auto, got '0'"),
    (["--bandwidth", "wide"], "--bandwidth must be a positive number of grey levels"),
    (["--bandwidth", "inf"], "--bandwidth must be a positive number of grey levels"),
    (["--spatial-bandwidth", "-2"], "--spatial-bandwidth must be a positive number of pixels, such as 20, or none"),
    (["--patch-size", "4"], "--patch-size must be odd and at least 1, got 4; try 5"),
    (["--landmarks", "0"], "Invalid value for '--landmarks': "),
    (["--sampling", "best"], "Invalid value for '--sampling': 'best' is not one of"),
    (["--channels", "red"], "Invalid value for '--channels': 'red' is not one of"),
    (["--residual", "nan"], "--residual must be a finite number, such as 1, got nan"),
    (["--depth", "12"], "Invalid value for '--depth': '12' is not one of"),
    (["--sharpen"], "No such option: --sharpen"),
]


def test_wrong_options(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, sentence in WRONG_OPTIONS:
        assert refusal(capsys, "detail", photo, tmp_path / "out.png", *options).startswith(sentence)
        assert [file.name for file in tmp_path.iterdir()] == ["in.png"]


LONG = "9" * 400


WITHOUT_SENSE = [
    ("detail --bandwidth 1e-40", "--bandwidth must be from 0.01 to 1000000 grey levels, or auto, got '1e-40'"),
    ("recolor --tolerance 1e-40", "'--tolerance': "),
    ("tone --bandwidth 1e-40", "--bandwidth must be from 0.01 to 1000000 grey levels, or auto, got '1e-40'"),
    (
        "detail --spatial-bandwidth 1e-40",
        "--spatial-bandwidth must be from 0.01 to 1000000 pixels, or none, got '1e-40'",
    ),
    ("detail --spatial-bandwidth nan", "--spatial-bandwidth"),
    (f"detail --patch-size {LONG}", "'--patch-size': "),
    (f"detail --landmarks {LONG}", "'--landmarks': "),
    (f"detail --seed {LONG}", "'--seed': "),
    (f"detail --alpha {LONG},1", "--alpha must be finite numbers"),
    ("detail --alpha 1e30,1", "--alpha must be numbers from -1000000 to 1000000"),
    (f"detail --alpha {','.join('1' * 101)}", "--alpha must have at most 100 numbers, got 101"),
    ("detail --residual 1e300", "'--residual': "),
    ("detail --reach nan --region 1,1,3,3", "--reach"),
    ("detail --memory 1e300", "--memory must be a positive number of gigabytes"),
    ("sharpen --amount nan", "--amount"),
    ("sharpen --guide-blur nan", "--guide-blur"),
    ("tone --contrast inf", "--contrast"),
    ("denoise --noise-level nan", "--noise-level"),
    ("recolor --region 1,1,3,3:red --reach nan", "--reach"),
    ("colorize --region 1,1,3,3:red --strength nan", "--strength"),
    ("defocus --region 1,1,3,3 --radius nan", "--radius must be a finite number, such as 1, got nan"),
    ("abstract --power inf", "--power"),
    ("abstract --edge-width nan", "--edge-width"),
    (f"abstract --tones {LONG}", "--tones"),
]


def test_numbers_without_sense(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command, sentence in WITHOUT_SENSE:
        verb, *options = command.split(" ")
        assert sentence in refused(capsys, verb, photo, tmp_path / "out.png", *options)
        assert [path.name for path in tmp_path.iterdir()] == ["in.png"]


def step_file(edit: str, entries: str) -> str:
    """A file with a single step."""
    return f'{{"version": 1, "steps": [{{"edit": "{edit}", {entries}}}]}}'


WRONG_PRESETS = [
    ("[" * 100_000, "is not a preset: it is nested too deeply"),
    ('{"alpha": ' * 100_000, "is not a preset: it is nested too deeply"),
    (step_file("detail", '"alpha": ' + "[" * 900 + "]" * 900), "must be a list of 2 to 100 numbers"),
    (step_file("detail", f'"alpha": [1, {LONG}]'), "must be a list of 2 to 100 numbers"),
    (
        step_file("detail", f'"alpha": [1, 1], "bandwidth": {LONG}'),
        "must be a positive number of grey levels, from 0.01 to",
    ),
    (
        step_file("detail", '"alpha": [1, 1], "bandwidth": 1e-40'),
        "must be a positive number of grey levels, from 0.01 to",
    ),
    (
        step_file("detail", '"alpha": [1, 1], "spatial_bandwidth": 1e-40'),
        "must be a positive number of pixels, from 0.01 to",
    ),
    (
        step_file("detail", '"alpha": [1, 1], "patch_size": 1000001'),
        "must be an odd number from 1 to 99, got 1000001",
    ),
    (step_file("detail", f'"alpha": [1, 1], "landmarks": {LONG}'), "must be a whole number from 1 to 10000"),
    (
        step_file("defocus", f'"radius": {LONG}'),
        "must be a positive number of hundredths of the short side, from 0.1 to 20",
    ),
    (step_file("abstract", f'"tones": {LONG}'), "must be a whole number from 2 to 65536, or null"),
    (step_file("abstract", '"tones": 4.0'), "must be a whole number from 2 to 65536, or null"),
    (
        step_file("recolor", f'"strokes": [{{"points": [[{LONG}, 0]], "radius": 0.1, "paint": "out"}}]'),
        "must be pairs of numbers",
    ),
    (
        step_file("recolor", f'"strokes": [{{"points": [[0, 0]], "radius": {LONG}, "paint": "out"}}]'),
        "must be in (0, 1]",
    ),
]


def test_presets_without_sense(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for text, sentence in WRONG_PRESETS:
        preset = tmp_path / "look.json"
        preset.write_text(text)
        message = refused(capsys, "apply", photo, tmp_path / "out.png", "--preset", preset)
        assert sentence in message
        assert len(message) < 500
        if "defocus" not in text and "abstract" not in text and "recolor" not in text:
            assert sentence in refused(capsys, "detail", photo, tmp_path / "out.png", "--preset", preset)
        assert not (tmp_path / "out.png").exists()
