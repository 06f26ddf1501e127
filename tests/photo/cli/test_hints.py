"""What is said of command lines with the names of other programs, and with slips."""

import re
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from nlfilter_torch.photo.app.command import app
from nlfilter_torch.photo.cli.application import OTHER_COMMANDS, OTHER_NAMES, SHORT, assembled, explained
from tests.commands import refusal

DETAIL = dict.fromkeys(["--alpha", "--bandwidth", "--region", "--force", "--quality"], "")


HINTS = [
    (
        ["denoise", "a.png", "b.png", "--sigma", "20"],
        "No such option: --sigma; here it is --noise-level or --bandwidth",
    ),
    (
        ["detail", "a.png", "b.png", "--sigma", "20"],
        "No such option: --sigma; here it is --bandwidth or --tolerance",
    ),
    (["denoise", "a.png", "b.png", "--luminance", "0"], "No such option: --luminance; here it is --brightness"),
    (["denoise", "a.png", "b.png", "--color", "0"], "No such option: --color; here it is --colour"),
    (["defocus", "a.png", "b.png", "--blur", "5"], "No such option: --blur; here it is --radius"),
    (
        ["recolor", "a.png", "b.png", "--color", "red"],
        "No such option: --color; here it is --region X,Y,W,H:COLOUR or --strokes",
    ),
    (
        ["detail", "a.png", "-o", "b.png"],
        "No such option: -o; the output is the second argument: nlfilter-torch COMMAND IN OUT",
    ),
    (["batch", "a", "b", "--jobs", "2"], "No such option: --jobs; here it is --workers"),
    (["presets", "--jobs", "2"], "No such option: --jobs; nlfilter-torch batch has --workers"),
    (["sharpen", "a.png", "b.png", "--overwrite"], "No such option: --overwrite; here it is --force"),
    (["sharpen", "a.png", "b.png", "--strength", "3"], "No such option: --strength; here it is --amount"),
    (
        ["detail", "a.png", "b.png", "--rotate", "2"],
        "No such option: --rotate; nlfilter-torch develop has --exposure, --highlights, --shadows, --temperature, "
        "--tint, --saturation, --rotate, --straighten, --crop and --aspect",
    ),
    (["develop", "a.png", "b.png", "--ratio", "1:1"], "No such option: --ratio; here it is --aspect"),
    (
        ["a.png", "b.png"],
        "No such command 'a.png'; the command comes first, such as nlfilter-torch detail a.png OUT --preset crisp, "
        "and nlfilter-torch --help lists all of them",
    ),
    (
        ["blur", "a.png", "b.png"],
        "No such command 'blur'; here it is nlfilter-torch defocus IN OUT --region X,Y,W,H, and nlfilter-torch "
        "--help lists all of them",
    ),
    (["fancy", "a.png", "b.png"], "No such command 'fancy'; nlfilter-torch --help lists all of them"),
    (
        ["detail", "a.png", "b.png", "--alpha", "2", "2", "2", "1"],
        "Got unexpected extra argument(s) (2 2 1); the numbers of --alpha are separated by commas: --alpha 2,2,2,1",
    ),
    (
        ["detail", "a.png", "b.png", "c.png", "folder"],
        "Got unexpected extra argument(s) (c.png folder); the command edits one photograph, and nlfilter-torch "
        "batch IN_DIR OUT_DIR all of a folder",
    ),
]


def test_refusals_say_what_was_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, wanted in HINTS:
        told = refusal(capsys, *arguments)
        assert re.sub(r" \([a-z].*\)$", "", told) == wanted  # without the help of the option


def test_other_messages_are_left_as_they_are() -> None:
    assert explained("No such option: --fancy", ["detail"], DETAIL) == "No such option: --fancy"
    assert explained("Got unexpected extra argument (x)", ["presets", "x"], {}) == "Got unexpected extra argument (x)"


def test_short_names_stand_for_long_ones() -> None:
    assert explained("No such option: -q", ["detail"], DETAIL) == "No such option: -q; here it is --quality"
    assert set(SHORT.values()) <= {*OTHER_NAMES, "--quality", "--mask", "--preset"}


def test_the_commands_that_are_named_exist() -> None:
    group = typer.main.get_command(assembled([app]))
    assert isinstance(group, TyperGroup)
    options = {name: {name for own in command.params for name in own.opts} for name, command in group.commands.items()}
    assert not OTHER_COMMANDS.keys() & options.keys()
    for ours in OTHER_COMMANDS.values():
        command, *words = ours.split()
        assert {word for word in words if word.startswith("--")} <= options[command], ours
