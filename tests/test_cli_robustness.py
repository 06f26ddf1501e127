"""The command line with bad numbers, presets and errors of the system: one sentence each; and what it imports."""

import ast
import errno
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import nlfilter_torch
import nlfilter_torch.photo
from nlfilter_torch.photo.declared.declaration import shown
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from tests.commands import refused, small_photo

LONG = "9" * 400
HEAVY = ("torch", "kornia", "skimage", "numpy", "PIL")


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    return small_photo(tmp_path)


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
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
    ],
)
def test_numbers_without_sense(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, sentence: str
) -> None:
    verb, *options = command.split(" ")
    assert sentence in refused(capsys, verb, photo, tmp_path / "out.png", *options)
    assert [path.name for path in tmp_path.iterdir()] == ["in.png"]


def step_file(edit: str, entries: str) -> str:
    """A file with a single step."""
    return f'{{"version": 1, "steps": [{{"edit": "{edit}", {entries}}}]}}'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
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
            step_file("recolor", f'"strokes": [{{"points": [[{LONG}, 0]], "radius": 0.1, "paint": "keep"}}]'),
            "must be pairs of numbers",
        ),
        (
            step_file("recolor", f'"strokes": [{{"points": [[0, 0]], "radius": {LONG}, "paint": "keep"}}]'),
            "must be in (0, 1]",
        ),
    ],
)
def test_presets_without_sense(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, sentence: str
) -> None:
    preset = tmp_path / "look.json"
    preset.write_text(text)
    message = refused(capsys, "apply", photo, tmp_path / "out.png", "--preset", preset)
    assert sentence in message
    assert len(message) < 500
    if "defocus" not in text and "abstract" not in text and "recolor" not in text:
        assert sentence in refused(capsys, "detail", photo, tmp_path / "out.png", "--preset", preset)
    assert not (tmp_path / "out.png").exists()


def test_memory_of_large_patches_is_asked_for(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    preset = tmp_path / "look.json"
    preset.write_text(Recipe((Step("detail", alpha=(2.0, 1.0), patch_size=99),)).to_json())
    asked: list[int] = []

    def read(*_: object, bytes_per_pixel: int, **__: object) -> None:
        asked.append(bytes_per_pixel)
        raise ValueError("enough")

    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_photograph", read)
    refused(capsys, "apply", photo, tmp_path / "out.png", "--preset", preset)
    assert asked[0] > 4 * 2 * 99**2


def test_values_in_messages_are_short() -> None:
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    assert len(shown(nested)) < 80
    assert len(shown(["x" * 1000] * 1000)) < 300


@pytest.mark.parametrize(
    "arguments",
    [
        ["presets"],
        ["presets", "crisp"],
        ["--version"],
        ["--help"],
        ["detail", "--help"],
        ["batch", "--help"],
        ["demo", "--help"],
        ["detail", "in.png", "out.png", "--alpha", "3"],
        ["recolor", "in.png"],
    ],
)
def test_commands_that_need_no_filter_import_none(arguments: list[str]) -> None:
    program = (
        "import sys\n"
        "from nlfilter_torch.__main__ import main\n"
        "main(sys.argv[1:])\n"
        f"print('imported:', *sorted(set(sys.modules) & set({HEAVY})))\n"
    )
    finished = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1].split() == ["imported:"]


@pytest.mark.parametrize("package", [nlfilter_torch, nlfilter_torch.photo], ids=lambda package: package.__name__)
def test_public_names_are_those_of_the_stub(package: ModuleType) -> None:
    stub = ast.parse(Path(package.__file__ or "").with_suffix(".pyi").read_text())
    names = {
        alias.name for statement in stub.body if isinstance(statement, ast.ImportFrom) for alias in statement.names
    }
    assert set(package.__all__) == names <= set(dir(package))
    for name in names:
        assert name == "PRESETS" or getattr(package, name).__name__ == name
    with pytest.raises(AttributeError, match="sharpenn"):
        _ = package.sharpenn


def test_errors_of_the_system(photo: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for error, sentence in (
        (OSError(errno.ENOSPC, "Full", "out"), "out cannot be written: Full; free some space there"),
        (OSError(errno.EIO, "Damaged"), "reading or writing failed: Damaged; check the disk, and try again"),
        (OSError(errno.EACCES, "Closed", "out"), "out: Closed; check the name and the permissions"),
        (OSError("Said already"), "Said already"),
    ):

        def fail(*_: object, error: OSError = error, **__: object) -> None:
            raise error

        monkeypatch.setattr("nlfilter_torch.photo.cli.editing.edit_file", fail)
        assert refused(capsys, "tone", photo, photo.with_name("out.png")) == f"nlfilter-torch: {sentence}\n"


def test_a_command_without_presets_says_where_they_are(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(capsys, "look", photo, photo.with_name("out.png"), "--preset", "crisp")
    assert told == "nlfilter-torch: No such option: --preset; use nlfilter-torch detail or apply, which have it\n"
