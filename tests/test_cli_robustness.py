"""The command line with bad numbers, odd files, links and signals: one sentence, and no files left."""

import ast
import errno
import fcntl
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

import nlfilter_torch
from nlfilter_torch.cli import main
from nlfilter_torch.edits.declaration import shown
from nlfilter_torch.io import writing as files
from nlfilter_torch.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.io.writing import open_beside

LONG = "9" * 400
HEAVY = ("torch", "kornia", "skimage", "numpy", "PIL")


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    """A 16x20 RGB file."""
    pixels = torch.rand(1, 3, 16, 20, generator=torch.Generator().manual_seed(0))
    write_photograph(Photograph(pixels), tmp_path / "in.png")
    return tmp_path / "in.png"


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the sentence of a refusal."""
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert len(captured.err.splitlines()) == 1
    return captured.err


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("detail --bandwidth 1e-40", "--bandwidth must be from 0.01 to 1000000 grey levels, or auto, got '1e-40'"),
        ("recolor --tolerance 1e-40", "'--tolerance' / '--bandwidth': "),
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


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[" * 100_000, "is not a preset: it is nested too deeply"),
        ('{"alpha": ' * 100_000, "is not a preset: it is nested too deeply"),
        ('{"alpha": ' + "[" * 900 + "]" * 900 + "}", "must be a list of 2 to 100 numbers"),
        (f'{{"alpha": [1, {LONG}]}}', "must be a list of 2 to 100 numbers"),
        (f'{{"alpha": [1, 1], "bandwidth": {LONG}}}', "must be a positive number of grey levels, from 0.01 to"),
        ('{"alpha": [1, 1], "bandwidth": 1e-40}', "must be a positive number of grey levels, from 0.01 to"),
        ('{"alpha": [1, 1], "spatial_bandwidth": 1e-40}', "must be a positive number of pixels, from 0.01 to"),
        ('{"alpha": [1, 1], "patch_size": 1000001}', "must be an odd number from 1 to 99, got 1000001"),
        (f'{{"alpha": [1, 1], "landmarks": {LONG}}}', "must be a whole number from 1 to 10000"),
        (
            f'{{"defocus": {{"radius": {LONG}}}}}',
            "must be a positive number of hundredths of the short side, from 0.1 to 20",
        ),
        (f'{{"abstract": {{"tones": {LONG}}}}}', "must be a whole number from 2 to 65536, or null"),
        ('{"abstract": {"tones": 4.0}}', "must be a whole number from 2 to 65536, or null"),
        (
            f'{{"recolor": {{"strokes": [{{"points": [[{LONG}, 0]], "radius": 0.1, "paint": "keep"}}]}}}}',
            "must be pairs of numbers",
        ),
        (
            f'{{"recolor": {{"strokes": [{{"points": [[0, 0]], "radius": {LONG}, "paint": "keep"}}]}}}}',
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
    preset.write_text(json.dumps({"alpha": [2, 1], "patch_size": 99}))
    asked: list[int] = []

    def read(*_: object, bytes_per_pixel: int, **__: object) -> None:
        asked.append(bytes_per_pixel)
        raise ValueError("enough")

    monkeypatch.setattr("nlfilter_torch.cli.editing.read_photograph", read)
    refused(capsys, "apply", photo, tmp_path / "out.png", "--preset", preset)
    assert asked[0] > 4 * 2 * 99**2


def test_values_in_messages_are_short() -> None:
    nested: list[object] = []
    for _ in range(100_000):
        nested = [nested]
    assert len(shown(nested)) < 80
    assert len(shown(["x" * 1000] * 1000)) < 300


@pytest.mark.parametrize("option", [[], ["--mask"], ["--preset"]])
def test_a_pipe_is_no_file(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: list[str]) -> None:
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    inputs = [photo, tmp_path / "out.png", *option, pipe] if option else [pipe, tmp_path / "out.png"]
    assert "pipe.png" in refused(capsys, "detail", *inputs)
    assert "pipe.png is a pipe, a socket or a device, not a file" in refused(capsys, "detail", photo, pipe)
    assert pipe.is_fifo()


def test_an_unreadable_file_is_told(photo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(photo))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ValueError, match=r"in\.png cannot be read: Permission denied; check its permissions"):
        read_photograph(photo)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".zarr"])
def test_what_is_written_to_a_link_goes_where_it_points(photo: Path, tmp_path: Path, suffix: str) -> None:
    there, link = tmp_path / "there" / f"real{suffix}", tmp_path / f"link{suffix}"
    there.parent.mkdir()
    link.symlink_to(there)
    for _ in range(2):  # the target does not exist the first time
        assert main(["detail", str(photo), str(link), "--alpha", "1,1"]) == 0
        assert link.is_symlink()
        assert link.readlink() == there
        assert there.is_dir() if suffix == ".zarr" else there.is_file()
        assert [path.name for path in there.parent.iterdir()] == [there.name]


def test_links_that_lead_nowhere(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop.png").symlink_to("loop.png")
    (tmp_path / "far.png").symlink_to("gone/far.png")
    assert "is a symbolic link that leads back to itself" in refused(capsys, "detail", photo, tmp_path / "loop.png")
    assert "does not exist; make it first" in refused(capsys, "detail", photo, tmp_path / "far.png")
    assert (tmp_path / "loop.png").is_symlink()


def test_a_file_is_no_array_of_zarr(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out.zarr").write_text("mine")
    assert "is a file, not a zarr array" in refused(capsys, "detail", photo, tmp_path / "out.zarr")
    assert (tmp_path / "out.zarr").read_text() == "mine"


def test_damaged_tiff_is_one_sentence(photo: Path, tmp_path: Path) -> None:
    """In a separate process, since pytest handles log messages, which otherwise go to standard error."""
    whole = tmp_path / "whole.tif"
    tifffile.imwrite(whole, np.zeros((16, 20, 3), np.uint8))
    (tmp_path / "cut.tif").write_bytes(whole.read_bytes()[:100])
    command = [sys.executable, "-m", "nlfilter_torch", "detail", str(tmp_path / "cut.tif"), str(tmp_path / "out.png")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 2
    assert len(finished.stderr.splitlines()) == 1
    assert "cut.tif is damaged or cut short" in finished.stderr


@pytest.mark.parametrize("name", ["[red]x.png", "x[", "ü ☃.png"])
def test_odd_names(
    photo: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rich treats square brackets as markup, and `[/]` alone as an error."""
    monkeypatch.setenv("COLUMNS", "500")  # long paths are not wrapped
    folder = tmp_path / "[" / "b]"
    folder.mkdir(parents=True)
    source = folder / name
    source.write_bytes(photo.read_bytes())
    assert main(["inspect", str(source), str(tmp_path / "looks"), "--landmarks", "20"]) == 0
    assert name.removesuffix(".png") in capsys.readouterr().out.replace("\n", "")


def part_of(path: Path) -> Path:
    """Make the file that a process leaves when it is killed while writing ``path``."""
    part = files.name_beside(path)
    part.write_text("half")
    return part


def test_stale_parts_of_the_same_output_are_removed(photo: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    stale, other = part_of(out), part_of(tmp_path / "other.png")
    unlike = tmp_path / ".out.png.mine.part"  # of another file
    unlike.write_text("mine")
    assert main(["detail", str(photo), str(out), "--alpha", "1,1"]) == 0
    assert not stale.exists()
    assert other.exists()
    assert unlike.exists()


def test_parts_that_are_being_written_stay(tmp_path: Path) -> None:
    out, claimed = tmp_path / "out.txt", part_of(tmp_path / "out.txt")
    with claimed.open() as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)  # like another process that is writing it
        with open_beside(out) as first:
            first.write(b"first")
            with open_beside(out) as second:
                second.write(b"second")
            assert out.read_bytes() == b"second"
        assert out.read_bytes() == b"first"
        assert claimed.exists()
    with open_beside(out) as stream:
        stream.write(b"third")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.txt"]
    assert not files.unfinished


@pytest.mark.parametrize("letter", ["x", "é"])
def test_the_longest_names_can_be_written(letter: str, photo: Path, tmp_path: Path) -> None:
    out = tmp_path / f"{letter * (251 // len(letter.encode()))}.png"
    assert main(["detail", str(photo), str(out), "--alpha", "1,1"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([photo.name, out.name])


def test_names_too_long_are_told(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(capsys, "detail", photo, tmp_path / f"{'x' * 252}.png")
    assert told.endswith(": File name too long; check the name and the permissions\n")


@pytest.mark.parametrize(
    ("number", "status", "told"),
    [(signal.SIGINT, 130, "nlfilter-torch: interrupted; no file is half written\n"), (signal.SIGTERM, 143, "")],
)
def test_signals_while_modules_are_imported(
    photo: Path, tmp_path: Path, number: signal.Signals, status: int, told: str
) -> None:
    """Also if the imported module converts every exception into another one."""
    (tmp_path / "torch.py").write_text(
        f"import os, time\ntry:\n    os.kill(os.getpid(), {int(number)})\n    time.sleep(60)\n"
        "except BaseException as error:\n    raise ImportError('no torch') from error\n"
    )
    program = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # background jobs of a shell ignore it
        "from nlfilter_torch.cli import main\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", program, "detail", str(photo), str(tmp_path / "out.png")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=50)
    assert (finished.returncode, finished.stderr) == (status, told)


@pytest.mark.parametrize("importing", [False, True])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_while_a_file_is_written(
    photo: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
    status: int,
    importing: bool,
) -> None:
    """Also while a module is imported that catches every exception."""
    before = {name: signal.getsignal(name) for name in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    folder = tmp_path_factory.mktemp("modules")
    (folder / "catches_everything.py").write_text(
        f"import os\ntry:\n    os.kill(os.getpid(), {int(number)})\nexcept BaseException:\n    pass\n"
    )
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "catches_everything", raising=False)

    def interrupted(*_: object) -> None:
        assert len(list(tmp_path.glob(".*.part"))) == 1
        if importing:
            importlib.import_module("catches_everything")
            time.sleep(60)
            raise AssertionError("the signal was lost")
        os.kill(os.getpid(), number)

    monkeypatch.setattr("nlfilter_torch.io.photographs.encode", interrupted)
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        assert main(["detail", str(photo), str(tmp_path / "out.png"), "--alpha", "1,1"]) == status
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)
    assert [path.name for path in tmp_path.iterdir()] == ["in.png"]


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
        "from nlfilter_torch.cli import main\n"
        "main(sys.argv[1:])\n"
        f"print('imported:', *sorted(set(sys.modules) & set({HEAVY})))\n"
    )
    finished = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1].split() == ["imported:"]


def test_public_names_are_one_table() -> None:
    """Names seen by type checkers are those that :func:`__getattr__` returns."""
    tree = ast.parse(Path(nlfilter_torch.__file__).read_text())
    typed = {
        alias.asname: statement.module
        for block in tree.body
        if isinstance(block, ast.If)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    table = {name: f"nlfilter_torch.{module}" for name, module in nlfilter_torch._DEFINED_IN.items()}
    assert typed == table
    assert set(nlfilter_torch.__all__) == set(table) <= set(dir(nlfilter_torch))
    for name in table:
        assert getattr(nlfilter_torch, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'sharpenn'"):
        _ = nlfilter_torch.sharpenn


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="is a device of Linux")
def test_output_that_cannot_be_written() -> None:
    with open("/dev/full", "w") as full:
        arguments = [sys.executable, "-m", "nlfilter_torch", "presets"]
        told = subprocess.run(arguments, stdout=full, stderr=subprocess.PIPE, text=True)
    sentence = "the output cannot be written: No space left on device; free some space there"
    assert (told.returncode, told.stderr) == (2, f"nlfilter-torch: {sentence}\n")


def test_errors_of_the_system(photo: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for error, sentence in (
        (OSError(errno.ENOSPC, "Full", "out"), "out cannot be written: Full; free some space there"),
        (OSError(errno.EIO, "Damaged"), "reading or writing failed: Damaged; check the disk, and try again"),
        (OSError(errno.EACCES, "Closed", "out"), "out: Closed; check the name and the permissions"),
        (OSError("Said already"), "Said already"),
    ):

        def fail(*_: object, error: OSError = error, **__: object) -> None:
            raise error

        monkeypatch.setattr("nlfilter_torch.cli.editing.edit_file", fail)
        assert refused(capsys, "tone", photo, photo.with_name("out.png")) == f"nlfilter-torch: {sentence}\n"


def test_a_command_without_presets_says_where_they_are(photo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(capsys, "look", photo, photo.with_name("out.png"), "--preset", "crisp")
    assert told == "nlfilter-torch: No such option: --preset; use nlfilter-torch detail or apply, which have it\n"
