"""The command line: its output, the metadata it keeps, and one sentence with exit status 2 for unusable input."""

import json
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import skimage.data
import torch
from PIL import ExifTags, Image, ImageCms

import nlfilter_torch
from nlfilter_torch import NonlocalFilter, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.io.photographs import Depth, Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.colour import edit_luminance

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


@pytest.fixture(scope="module")
def cat() -> torch.Tensor:
    """(1, 3, 60, 90) in [0, 1]."""
    return torch.from_numpy(skimage.data.chelsea()[60:120, 100:190].copy()).permute(2, 0, 1)[None].float() / 255


@pytest.fixture
def photo(tmp_path: Path, cat: torch.Tensor) -> Path:
    """An 8-bit RGB file."""
    write_photograph(Photograph(cat), tmp_path / "in.png")
    return tmp_path / "in.png"


PLAIN = ("--limits", "none", "--threshold", 0, "--spatial-bandwidth", "none")  # the filter as it is


def detail(*arguments: object) -> int:
    return main(["detail", *map(str, arguments), "--landmarks", "40"])


def test_detail_is_the_filter_on_luminance(photo: Path, tmp_path: Path, cat: torch.Tensor) -> None:
    out = tmp_path / "out.png"
    assert detail(photo, out, "--alpha", "3,3,4,1.05", "--bandwidth", 20, "--seed", 7, *PLAIN) == 0
    luminance = (cat * torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)).sum(1, keepdim=True)
    operator = nonlocal_operator(
        luminance, photometric_bandwidth=20 / 255, num_landmarks=40, generator=torch.Generator().manual_seed(7)
    )
    filtered = polynomial_filter(operator, luminance, torch.tensor([3, 3, 4, 1.05]))
    wanted = (cat + filtered - luminance).clamp(0, 1)
    assert (read_photograph(out).pixels - wanted).abs().max() < 0.6 / 255


def test_all_channels_are_edited_on_request(photo: Path, tmp_path: Path, cat: torch.Tensor) -> None:
    assert detail(photo, tmp_path / "out.png", "--alpha", "2,1", "--channels", "all", "--bandwidth", 20, *PLAIN) == 0
    layer = NonlocalFilter(alpha=(2, 1), photometric_bandwidth=20 / 255, num_landmarks=40)
    layer.affinity.generator = torch.Generator().manual_seed(0)
    wanted = layer(cat).detach().clamp(0, 1)
    assert (read_photograph(tmp_path / "out.png").pixels - wanted).abs().max() < 0.6 / 255


@pytest.mark.parametrize(
    ("suffix", "depth", "channels"),
    [
        (".png", "uint8", 1),
        (".png", "uint8", 4),
        (".png", "uint16", 3),
        (".tif", "uint16", 4),
        (".tif", "float32", 3),
        (".webp", "uint8", 4),
    ],
)
def test_alpha_of_ones_gives_the_file_back(
    tmp_path: Path, cat: torch.Tensor, suffix: str, depth: Depth, channels: int
) -> None:
    """Depth, alpha, profile and EXIF are kept; integer pixels are exact, floats equal to rounding."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Maker"
    exif[ExifTags.Base.Orientation] = 1
    pixels = cat[:, : 1 if channels == 1 else 3]
    transparency = cat[:, :1].flip(-1) if channels in (2, 4) else None
    original = Photograph(pixels, depth, transparency, PROFILE, exif.tobytes())
    write_photograph(original, tmp_path / f"in{suffix}")
    assert detail(tmp_path / f"in{suffix}", tmp_path / f"out{suffix}", "--alpha", "1,1,1,1") == 0
    stored, found = read_photograph(tmp_path / f"in{suffix}"), read_photograph(tmp_path / f"out{suffix}")
    assert (found.pixels - stored.pixels).abs().max() <= (1e-5 if depth == "float32" else 0)
    assert (found.alpha is None) == (stored.alpha is None)
    assert found.alpha is None or torch.equal(found.alpha, stored.alpha)
    assert (found.depth, found.icc, found.exif) == (depth, PROFILE, stored.exif)


def test_options_change_the_picture(photo: Path, tmp_path: Path) -> None:
    def result(*arguments: object) -> bytes:
        assert detail(photo, tmp_path / "out.png", *arguments) == 0
        return (tmp_path / "out.png").read_bytes()

    usual = result()
    assert usual == result("--alpha", "2.2,2.2,2.2,1", "--patch-size", 5, "--sampling", "kmeans", "--seed", 0)
    variations = [
        ("--alpha", "2,1"),
        ("--patch-size", 3),
        ("--bandwidth", 40),
        ("--spatial-bandwidth", 8),
        ("--sampling", "uniform"),
        ("--sampling", "random"),
        ("--residual", 1),
        ("--seed", 1),
        ("--channels", "all"),
        ("--depth", "16"),
    ]
    assert len({usual, *(result(*variation) for variation in variations)}) == 1 + len(variations)


def test_depth_can_be_chosen(photo: Path, tmp_path: Path) -> None:
    for name, choice, depth in (("a.png", "16", "uint16"), ("b.tif", "float", "float32"), ("c.tif", "8", "uint8")):
        assert detail(photo, tmp_path / name, "--depth", choice) == 0
        assert read_photograph(tmp_path / name).depth == depth


def test_a_file_can_replace_itself(photo: Path) -> None:
    before = photo.read_bytes()
    assert detail(photo, photo) == 0
    assert photo.read_bytes() != before
    assert list(photo.parent.iterdir()) == [photo]


def test_inspect_writes_pictures_and_figures(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "looks"
    for _ in range(2):  # the folder may exist
        assert main(["inspect", str(photo), str(folder), "--landmarks", "40", "--bandwidth", "20"]) == 0
    names = {"eigenvectors.png", "eigenvalues.png", "response.png", "diagnostics.json"}
    assert {file.name for file in folder.iterdir()} == names
    for name in names - {"diagnostics.json"}:
        with Image.open(folder / name) as picture:
            assert np.asarray(picture.convert("L")).std() > 5
    figures = json.loads((folder / "diagnostics.json").read_text())
    assert (figures["height"], figures["width"], figures["landmarks"]) == (60, 90, 40)
    assert figures["bandwidth"] == pytest.approx(20)
    assert figures["row_sum_residual"] < 1e-4
    assert 0.9 < figures["captured_energy"] <= 1.0001
    assert figures["eigenvalues"] == sorted(figures["eigenvalues"], reverse=True)
    table = capsys.readouterr().out
    for name in figures.keys() - {"eigenvalues"}:
        assert name.split("_")[0] in table


def test_inspect_shows_the_filter_at_the_viewing_size(photo: Path, tmp_path: Path) -> None:
    options = ("--landmarks", "20", "--viewing-size", "0.00135")
    assert main(["inspect", str(photo), str(tmp_path / "looks"), *options]) == 0
    figures = json.loads((tmp_path / "looks" / "diagnostics.json").read_text())
    assert (figures["height"], figures["width"]) == (30, 45)


@pytest.mark.parametrize("arguments", [[], ["--help"], ["detail", "--help"], ["inspect", "--help"], ["demo", "--help"]])
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


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the sentence of a refusal, without the name of the program."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert not captured.out
    lines = captured.err.splitlines()
    assert len(lines) == 1
    return lines[0].removeprefix("nlfilter-torch: ")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
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
    ],
)
def test_wrong_options(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], sentence: str
) -> None:
    assert refused(capsys, "detail", photo, tmp_path / "out.png", *options).startswith(sentence)
    assert [file.name for file in tmp_path.iterdir()] == ["in.png"]


def test_wrong_calls(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, "detail") == "Missing argument 'IN'."
    assert refused(capsys, "embellish").startswith("No such command 'embellish'.")


def test_wrong_inputs(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.png"
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.jpg").write_text("this is no picture at all, whatever its name may say")
    (tmp_path / "half.png").write_bytes(photo.read_bytes()[:3000])
    sentences = {
        "none.png": "none.png does not exist; check the name and the folder",
        "empty.png": "empty.png is empty; copy it again from its source",
        "text.jpg": "text.jpg is not a PNG, JPEG, TIFF, WebP or AVIF image; convert it to one of these",
        "half.png": "half.png is damaged or cut short (",
    }
    for name, sentence in sentences.items():
        assert sentence in refused(capsys, "detail", tmp_path / name, out)
        assert sentence in refused(capsys, "inspect", tmp_path / name, tmp_path / "looks")
    assert not out.exists()
    assert not (tmp_path / "looks").exists()


def test_outputs_that_cannot_be(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_photograph(Photograph(torch.zeros(1, 3, 4, 4), alpha=torch.ones(1, 1, 4, 4)), tmp_path / "rgba.png")
    write_photograph(Photograph(torch.zeros(1, 3, 4, 4), "uint16"), tmp_path / "deep.png")
    write_photograph(Photograph(torch.zeros(1, 3, 4, 4), "float32"), tmp_path / "float.tif")
    before = set(tmp_path.iterdir())
    for source, target, sentence in (
        ("in.png", "nowhere/out.png", "does not exist; make it first"),
        ("in.png", "out.gif", "out.gif must end in .png, .jpg, .webp, .avif or .tif, got '.gif'"),
        ("rgba.png", "out.jpg", "JPEG has no alpha channel; write a PNG, TIFF, WebP or AVIF file"),
        (
            "deep.png",
            "out.jpg",
            "JPEG has no 16 bits per channel; write a PNG or TIFF file or choose a depth of 8 bits",
        ),
        ("float.tif", "out.png", "PNG has no floats per channel; write a TIFF file or choose a depth of 16 bits"),
    ):
        assert sentence in refused(capsys, "detail", tmp_path / source, tmp_path / target)
    assert "does not exist; make it first" in refused(capsys, "inspect", photo, tmp_path / "no" / "where")
    assert "is a file, not a folder" in refused(capsys, "inspect", photo, photo)
    assert "does not exist; make it first" in refused(capsys, "demo", tmp_path / "no" / "where")
    assert set(tmp_path.iterdir()) == before


def test_too_large_for_memory(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = psutil.virtual_memory()._replace(available=1_000_000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    sentence = refused(capsys, "tone", photo, tmp_path / "out.png")  # not even in tiles
    assert (
        "in.png needs at least 21 MB of memory, but only 1 MB may be used; allow more, or use fewer landmarks"
        in sentence
    )
    sentence = refused(capsys, "inspect", photo, tmp_path)  # needs all pixels at once
    assert "has 90x60 pixels and needs about 34 MB of memory, but only 1 MB is free; use fewer landmarks" in sentence


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


def test_edit_luminance_keeps_colour(cat: torch.Tensor) -> None:
    assert torch.equal(edit_luminance(cat, lambda y: y), cat)
    brighter = edit_luminance(cat, lambda y: y + 0.1)
    torch.testing.assert_close(brighter, cat + 0.1)
    grey = cat[:, :1]
    assert torch.equal(edit_luminance(grey, lambda y: 2 * y), 2 * grey)


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 40), (30, 20)])
def test_flat_and_tiny_pictures_are_looked_at(size: tuple[int, int], tmp_path: Path) -> None:
    source = tmp_path / "flat.png"
    write_photograph(Photograph(torch.full((1, 1, *size), 0.5), "uint8"), source)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about fewer pixels than landmarks
        assert main(["inspect", str(source), str(tmp_path / "looks")]) == 0
    names = ["diagnostics.json", "eigenvalues.png", "eigenvectors.png", "response.png"]
    assert sorted(path.name for path in (tmp_path / "looks").iterdir()) == names


def test_interrupted_work_says_so(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_photograph", interrupt)
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 130
    assert capsys.readouterr().err.strip() == "nlfilter-torch: interrupted; no file is half written"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C interrupts, as it does not in background jobs of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_that_python_loses_comes_again(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Busy:
        def __del__(self) -> None:
            raise KeyboardInterrupt  # as if Ctrl-C were pressed at this moment

    def work(*_: object, **__: object) -> None:
        Busy()
        for _ in range(1000):
            time.sleep(0.01)

    monkeypatch.setattr("nlfilter_torch.photo.cli.editing.read_photograph", work)
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 130
    assert capsys.readouterr().err.strip() == "nlfilter-torch: interrupted; no file is half written"


def test_other_errors_of_destructors_are_told_as_ever(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Faulty:
        def __del__(self) -> None:
            raise RuntimeError("of its own")

    told: list[BaseException | None] = []
    monkeypatch.setattr("sys.unraisablehook", lambda lost: told.append(lost.exc_value))
    monkeypatch.setattr(
        "nlfilter_torch.photo.cli.editing.read_photograph", lambda *_, **__: Faulty() and read_photograph(photo)
    )
    assert main(["tone", str(photo), str(tmp_path / "out.png")]) == 0
    assert [str(error) for error in told] == ["of its own"]
