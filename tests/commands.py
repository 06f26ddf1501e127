"""The command line in tests: a small photograph, and the sentence of a refusal."""

from pathlib import Path

import pytest
import torch

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.picture.photographs import Photograph, write_photograph


def small_photo(folder: Path) -> Path:
    """Write an RGB file of 16x20 pixels."""
    pixels = torch.rand(1, 3, 16, 20, generator=torch.Generator().manual_seed(0))
    write_photograph(Photograph(pixels), folder / "in.png")
    return folder / "in.png"


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the sentence of a refusal."""
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert len(captured.err.splitlines()) == 1
    return captured.err


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the sentence of a refusal, without the name of the program."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert not captured.out
    lines = captured.err.splitlines()
    assert len(lines) == 1
    return lines[0].removeprefix("nlfilter-torch: ")
