"""What commands write: never over a file that they read, of the right type, and refused before any work."""

import json
import os
import stat
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from nlfilter_torch.__main__ import main
from nlfilter_torch.photo.picture.photographs import Photograph, check_output, read_photograph, write_photograph


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: a photograph, its edit, a mask and strokes, 24x32, and two presets."""
    monkeypatch.chdir(tmp_path)
    pixels = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    write_photograph(Photograph(pixels), "in.png")
    write_photograph(Photograph(pixels.sqrt()), "after.png")
    write_photograph(Photograph((pixels[:, :1] > 0.5).float()), "mask.png")
    write_photograph(Photograph(pixels, alpha=(pixels[:, :1] > 0.9).float()), "strokes.png")
    for name, steps in (("none.json", []), ("soft.json", [{"edit": "tone", "contrast": 0.9}])):
        (tmp_path / name).write_text(json.dumps({"version": 1, "steps": steps}))
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], command: str) -> str:
    """Return the sentence of a refusal, after which every file is as before."""
    before = {path: path.read_bytes() for path in Path().iterdir()}
    assert main(command.split()) == 2
    captured = capsys.readouterr()
    assert len(captured.err.splitlines()) == 1
    assert {path: path.read_bytes() for path in Path().iterdir()} == before
    return captured.err


REPLACED = [
    ("detail in.png mask.png --mask mask.png", "OUT must be another file than the mask, got mask.png"),
    ("detail in.png ./mask.png --mask mask.png", "OUT must be another file than the mask"),
    ("detail in.png out.png --mask mask.png --show mask.png", "--show must be another file than the mask"),
    ("recolor in.png strokes.png --strokes strokes.png", "OUT must be another file than the strokes"),
    ("apply in.png mask.png --preset soft.json --mask mask.png", "OUT must be another file than the mask"),
    ("mask in.png in.png --region 6,6,6,6", "OUT must be another file than the photograph"),
    ("mask in.png mask.png --mask mask.png", "OUT must be another file than the mask"),
    ("mask in.png out.png --mask mask.png --show mask.png", "--show must be another file than the mask"),
    ("fit in.png after.png look.json --preview in.png", "--preview must be another file than the photographs"),
    ("fit in.png after.png look.json --map after.png", "--map must be another file than the photographs"),
    ("fit in.png after.png look.json --preview a.png --map a.png", "--map must be another file than the preview"),
    ("fit in.png after.png after.png", "PRESET must end in .json, got after.png; rename it"),
    ("fit in.png after.png look.json --mask mask.png --preview mask.png", "--preview must be another file than"),
    ("fit in.png after.png look.json --preview seen.gif", "seen.gif must end in .png, .jpg"),
    ("denoise in.png out.png --map map.gif", "map.gif must end in .png, .jpg"),
    ("denoise in.png out.png --error-map errors.png", "errors.png cannot hold this picture: PNG has no"),
    ("recolor in.png out.png --region 6,6,4,4:rgb(300,0,0)", "--region must end in a colour"),
]


def test_files_that_are_read_are_not_replaced(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command, sentence in REPLACED:
        assert sentence in refused(capsys, command)


def test_a_mask_of_integers_of_32_bits_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tifffile.imwrite("deep.tif", np.ones((24, 32), np.int32))
    sentence = "deep.tif stores its channels as int32, which is not supported; convert it to 8 or 16 bits or floats"
    assert sentence in refused(capsys, "detail in.png out.png --mask deep.tif")
    assert sentence in refused(capsys, "detail in.png out.png --mask deep.tif --memory 0.001")


@pytest.mark.parametrize(
    ("text", "entry"),
    [
        ('{"version": 1, "steps": [{"edit": "tone", "contrast": 2}], "steps": [{"edit": "sharpen"}]}', '"steps"'),
        ('{"version": 1, "steps": [{"edit": "tone", "contrast": 1.5, "contrast": 1.0}]}', '"contrast"'),
    ],
)
def test_a_preset_that_names_an_entry_twice_is_refused(
    text: str, entry: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("twice.json").write_text(text)
    told = refused(capsys, "apply in.png out.png --preset twice.json")
    assert f"twice.json must have each entry once, got {entry} twice; remove one of them" in told


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_preset_may_be_encoded_as_windows_does(encoding: str, folder: Path) -> None:
    Path("windows.json").write_text(Path("soft.json").read_text(), encoding=encoding)
    for name in ("windows", "soft"):
        assert main(["apply", "in.png", f"{name}.png", "--preset", f"{name}.json"]) == 0
    assert Path("windows.png").read_bytes() == Path("soft.png").read_bytes()


def test_frames_of_a_folder_are_not_written_to_a_film(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shots = folder / "shots"
    shots.mkdir()
    (folder / "in.png").rename(shots / "in.png")
    assert main(["frames", "shots", "out.mp4", "--preset", "clear"]) == 2
    assert "OUT must be a folder, as FRAMES is one, got out.mp4" in capsys.readouterr().err
    assert not Path("out.mp4").exists()


@pytest.mark.parametrize(("name", "size"), [("wide.webp", (1, 16384)), ("high.jpg", (65501, 1))])
def test_pictures_too_long_for_their_type_are_refused_early(name: str, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{name} cannot hold this picture: .* has at most .* pixels per side, got"):
        check_output(name, Photograph(torch.zeros(1, 1, *size)))


def test_exif_data_too_long_for_jpeg_are_refused_early() -> None:
    photograph = Photograph(torch.zeros(1, 1, 4, 4), exif=b"Exif\0\0" + bytes(70_000))
    with pytest.raises(ValueError, match=r"a\.jpg cannot hold this picture: JPEG has at most 65533 bytes of EXIF data"):
        check_output("a.jpg", photograph)
    assert check_output("a.png", photograph) == "PNG"


def test_webp_keeps_colours_of_transparent_pixels(folder: Path) -> None:
    assert main(["apply", "strokes.png", "out.webp", "--preset", "none.json"]) == 0
    before, after = (np.asarray(Image.open(name)) for name in ("strokes.png", "out.webp"))
    assert (before[..., 3] == 0).any()
    np.testing.assert_array_equal(after, before)


def test_a_transparent_colour_of_a_black_and_white_png_is_kept(folder: Path) -> None:
    picture = Image.fromarray(np.tile([[False, True]], (4, 4)))
    picture.save("bits.png", transparency=1)
    alpha = read_photograph("bits.png").alpha
    assert alpha is not None
    assert alpha[0, 0, 0, :4].tolist() == [1, 0, 1, 0]


def test_floats_whose_white_is_0_are_read(folder: Path) -> None:
    rows = np.linspace(0, 1, 24 * 32, dtype=np.float32).reshape(24, 32)
    tifffile.imwrite("inverted.tif", rows, photometric="miniswhite")
    np.testing.assert_allclose(read_photograph("inverted.tif").pixels[0, 0], 1 - rows, atol=1e-6)


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_a_replaced_file_keeps_its_permissions(folder: Path) -> None:
    Path("in.png").chmod(0o600)
    assert main(["tone", "in.png", "in.png", "--contrast", "1.1", "--force"]) == 0
    assert stat.S_IMODE(Path("in.png").stat().st_mode) == 0o600


def test_photographs_without_a_counterpart_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("before", "after"):
        (folder / name).mkdir()
    for name in ("a", "b", "c"):
        write_photograph(read_photograph("in.png"), folder / "before" / f"{name}.png")
    write_photograph(read_photograph("after.png"), folder / "after" / "a.png")
    assert main(["fit", "before", "after", "look.json", "--landmarks", "20"]) == 0
    told = capsys.readouterr().err
    assert "b.png and 1 more in before left out, without a photograph of that name in the other folder" in told
    assert "in after left out" not in told


def test_the_editor_refuses_a_photograph_that_is_not_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "missing.jpg does not exist" in refused(capsys, "app missing.jpg --no-open")
    assert "is a folder" in refused(capsys, f"app {folder.parent} --no-open")
