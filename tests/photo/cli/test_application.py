"""The assembled command line: help, version, imports, and errors of one sentence."""

import errno
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

import nlfilter_torch
import nlfilter_torch.photo
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph
from tests.commands import refusal, refused


@pytest.mark.parametrize(
    "arguments",
    [[], ["-h"], ["--help"], ["detail", "-h"], ["detail", "--help"], ["inspect", "--help"], ["demo", "--help"]],
)
def test_help(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert "Usage: nlfilter-torch" in captured.out
    assert not captured.err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out in [
        f"nlfilter-torch {nlfilter_torch.__version__}, kernels in C: {name}\n" for name in ("none", "AVX2", "AVX-512")
    ]


def test_wrong_calls(capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, "detail") == "Missing argument 'IN'; nlfilter-torch detail --help shows what it is"
    assert refusal(capsys, "embellish") == "No such command 'embellish'; nlfilter-torch --help lists all of them"


def test_a_warning_is_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photograph(
        Photograph(torch.rand(1, 1, 3, 4, generator=torch.Generator().manual_seed(0))), tmp_path / "in.png"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["sharpen", str(tmp_path / "in.png"), str(tmp_path / "out.png")]) == 0
    notes = capsys.readouterr().err.splitlines()
    assert len(notes) == 1
    assert notes[0].startswith("nlfilter-torch: note: num_landmarks")


def test_as_a_program(photo: Path, tmp_path: Path) -> None:
    """``python -m nlfilter_torch`` ends with the status of :func:`main`."""
    command = [sys.executable, "-m", "nlfilter_torch", "detail", str(photo), str(tmp_path / "out.gif")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 2
    assert finished.stderr.startswith("nlfilter-torch: ")
    assert not finished.stdout


def test_without_the_extra(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "nlfilter_torch.photo.cli.application")
    monkeypatch.setitem(sys.modules, "typer", None)
    assert main(["--version"]) == 2
    assert "needs typer, which is not installed; install it with: pip install 'nlfilter-torch[cli]'" in (
        capsys.readouterr().err
    )


HEAVY = ("torch", "kornia", "skimage", "numpy", "PIL")


COMMANDS = (
    "presets",
    "presets crisp",
    "--version",
    "--help",
    "detail --help",
    "batch --help",
    "demo --help",
    "detail in.png out.png --alpha 3",
    "recolor in.png",
)


def test_commands_that_need_no_filter_import_none() -> None:
    program = (
        "import sys\n"
        "from nlfilter_torch.__main__ import main\n"
        f"for command in {COMMANDS}:\n"
        "    main(command.split())\n"
        f"    print('imported by', command + ':', *sorted(set(sys.modules) & set({HEAVY})))\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    told = [line for line in finished.stdout.splitlines() if line.startswith("imported by")]
    assert told == [f"imported by {command}:" for command in COMMANDS]


def test_errors_of_the_system(photo: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for error, sentence in (
        (OSError(errno.ENOSPC, "Full", "out"), "out cannot be written: Full; free some space there"),
        (OSError(errno.EIO, "Damaged"), "reading or writing failed: Damaged; check the disk, and try again"),
        (OSError(errno.EACCES, "Closed", "out"), "out: Closed; check the name and the permissions"),
        (OSError("Said already"), "Said already"),
    ):

        def fail(*_: object, error: OSError = error, **__: object) -> None:
            raise error

        monkeypatch.setattr("nlfilter_torch.photo.cli.editing.FileEdit.run", fail)
        assert refused(capsys, "tone", photo, photo.with_name("out.png")) == f"nlfilter-torch: {sentence}\n"


def test_a_command_without_presets_says_where_they_are(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refusal(capsys, "look", photo, photo.with_name("out.png"), "--preset", "crisp")
    assert told == (
        "No such option: --preset; nlfilter-torch apply IN OUT NAME takes presets, looks and files of all edits"
    )
