"""Files that commands read, edit and write: pixels, metadata, depth, and errors of one sentence."""

import os
from pathlib import Path

import numpy as np
import psutil
import pytest
import skimage.data
import tifffile
import torch
from PIL import ExifTags, Image, ImageCms

from nlfilter_torch import NonlocalFilter, nonlocal_operator, polynomial_filter
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.files.formats import Depth
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.commands import refusal, refused, small_photo

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
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
    stored, edited = read_photograph(tmp_path / f"in{suffix}"), read_photograph(tmp_path / f"out{suffix}")
    assert (edited.pixels - stored.pixels).abs().max() <= (1e-5 if depth == "float32" else 0)
    assert (edited.alpha is None) == (stored.alpha is None)
    assert edited.alpha is None or torch.equal(edited.alpha, stored.alpha)
    assert (edited.depth, edited.icc, edited.exif) == (depth, PROFILE, stored.exif)


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
    assert detail(photo, photo, "--force") == 0
    assert photo.read_bytes() != before
    assert list(photo.parent.iterdir()) == [photo]


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
        assert sentence in refusal(capsys, "detail", tmp_path / name, out)
        assert sentence in refusal(capsys, "inspect", tmp_path / name, tmp_path / "looks")
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
        assert sentence in refusal(capsys, "detail", tmp_path / source, tmp_path / target)
    assert "does not exist; make it first" in refusal(capsys, "inspect", photo, tmp_path / "no" / "where")
    assert "is a file, not a folder" in refusal(capsys, "inspect", photo, photo)
    assert "does not exist; make it first" in refusal(capsys, "demo", tmp_path / "no" / "where")
    assert set(tmp_path.iterdir()) == before


def test_too_large_for_memory(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    free = psutil.virtual_memory()._replace(available=1_000_000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    sentence = refusal(capsys, "tone", photo, tmp_path / "out.png")  # not even in tiles
    assert (
        "in.png needs at least 21 MB of memory, but only 1 MB may be used; allow more, or use fewer landmarks"
        in sentence
    )
    sentence = refusal(capsys, "inspect", photo, tmp_path)  # needs all pixels at once
    assert "has 90x60 pixels and needs about 34 MB of memory, but only 1 MB is free; use fewer landmarks" in sentence


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


def test_depth_and_transparency_are_kept(tmp_path: Path, cat: torch.Tensor) -> None:
    alpha = cat[:, :1].flip(-1)
    write_photograph(Photograph(cat, "uint16", alpha), tmp_path / "deep.png")
    assert main(["tone", str(tmp_path / "deep.png"), str(tmp_path / "out.png"), "--landmarks", "40"]) == 0
    stored, edited = read_photograph(tmp_path / "deep.png"), read_photograph(tmp_path / "out.png")
    assert edited.depth == "uint16"
    assert torch.equal(edited.alpha, stored.alpha)
    assert (
        main(["tone", str(tmp_path / "deep.png"), str(tmp_path / "out.tif"), "--depth", "float", "--landmarks", "40"])
        == 0
    )
    assert read_photograph(tmp_path / "out.tif").depth == "float32"


def test_damaged_files_are_refused(photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pixels, target = skimage.data.chelsea()[:64, :96], tmp_path / "out.png"
    data = bytearray(photo.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20] = bytes(20)
    photo.write_bytes(data)
    assert "in.png is damaged or cut short" in refused(capsys, "tone", photo, target)
    tif = tmp_path / "in.tif"
    tifffile.imwrite(tif, pixels, compression="jpeg", photometric="rgb")
    with tifffile.TiffFile(tif) as file:
        end = file.pages.first.dataoffsets[-1] + file.pages.first.databytecounts[-1]
    assert tif.stat().st_size == end  # the pixels come last
    tif.write_bytes(tif.read_bytes()[:-30])
    assert "in.tif is damaged or cut short (it ends too early)" in refused(capsys, "tone", tif, target)
    assert not target.exists()


@pytest.mark.usefixtures("tiled")
def test_transparency_must_be_finite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = np.ones((60, 90, 4))
    values[5, 7, 3] = np.nan
    source = tmp_path / "in.tif"
    tifffile.imwrite(source, values.astype(np.float32), photometric="rgb", extrasamples=["unassalpha"])
    assert main(["tone", str(source), str(tmp_path / "out.tif"), "--contrast", "1.2"]) == 2
    assert "NaN" in capsys.readouterr().err
    assert not (tmp_path / "out.tif").exists()


@pytest.mark.parametrize(
    ("verb", "option"),
    [
        (["recolor", "--region", "24,32:blue"], "--show"),
        (["mask", "--region", "24,32"], "--show"),
        (["denoise"], "--map"),
        (["denoise"], "--error-map"),
    ],
)
def test_the_photograph_is_not_replaced(
    verb: list[str], option: str, photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, out = photo.read_bytes(), tmp_path / "out.png"
    for path, what in ((photo, "photograph"), (out, "output")):
        assert main([*verb, str(photo), str(out), option, str(path)]) == 2
        assert f"{option} must be another file than the {what}, got" in capsys.readouterr().err
    assert photo.read_bytes() == before
    assert not out.exists()


def test_channels_of_unsupported_types_in_tiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    signed, plain, preset = tmp_path / "signed.tif", tmp_path / "plain.tif", tmp_path / "look.json"
    tifffile.imwrite(signed, np.full((64, 80), 9, np.int16))
    tifffile.imwrite(plain, np.full((64, 80), 9, np.uint16))
    preset.write_text('{"version": 1, "steps": [{"edit": "detail", "alpha": [2, 1]}]}')
    tiles = ("--memory", "0.001")
    for arguments in (
        ("mask", signed, tmp_path / "out.png", "--region", "30,30,12,8", *tiles),
        ("apply", plain, tmp_path / "out.png", "--preset", preset, "--mask", signed, *tiles),
        ("detail", plain, tmp_path / "out.png", "--mask", signed, *tiles),
    ):
        assert main([str(argument) for argument in arguments]) == 2
        told = capsys.readouterr().err
        assert f"{signed} stores its channels as int16, which is not supported; convert it" in told
        assert not (tmp_path / "out.png").exists()


def test_the_photograph_is_replaced_by_force_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo = small_photo(tmp_path)
    before = photo.read_bytes()
    (tmp_path / "link.png").symlink_to(photo)
    os.link(photo, tmp_path / "same.png")
    for command, *options in (["sharpen"], ["apply", "--preset", "crisp"]):
        for out in (photo, tmp_path / "link.png", tmp_path / "same.png"):
            assert refusal(capsys, command, photo, out, *options) == (
                f"OUT must be another file than the photograph, got {out}, which the edit would replace; choose "
                "another name, or insist by --force"
            )
    assert photo.read_bytes() == before
    assert main(["tone", str(photo), str(photo), "--force"]) == 0
    assert photo.read_bytes() != before


def test_values_that_destroy_a_picture_need_force(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo, out = small_photo(tmp_path), tmp_path / "out.png"
    assert refusal(capsys, "tone", photo, out, "--contrast", "+30") == (
        "--contrast must be from 0.2 to 3, as other factors destroy the picture (1 changes nothing, 1.3 adds 30 %), "
        "got 30; choose another, or insist by --force"
    )
    for arguments in (
        ["detail", photo, out, "--alpha", "3,3,40,1"],
        ["detail", photo, out, "--alpha", "3,3,-1,1"],
        ["detail", photo, out, "--region", "1,1,4,4:1,1,11,1"],
        ["sharpen", photo, out, "--amount", "50"],
        ["batch", tmp_path, tmp_path / "out", "--alpha", "3,3,40,1"],
        ["frames", tmp_path, tmp_path / "out", "--edit", "tone", "--contrast", "30"],
    ):
        assert "as other factors destroy the picture" in refusal(capsys, *arguments)
    assert not out.exists()
    assert main(["tone", str(photo), str(out), "--contrast", "30", "--force"]) == 0
    assert main(["detail", str(photo), str(out), "--alpha", "3,3,40,1", "--force"]) == 0


@pytest.mark.parametrize("memory", [[], ["--memory", "0.001"]])
def test_quality_of_jpeg(memory: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photo, sizes = small_photo(tmp_path), list[int]()
    for quality in ("20", "95", "100"):
        assert main(["sharpen", str(photo), str(tmp_path / "out.jpg"), "--quality", quality, *memory]) == 0
        sizes.append((tmp_path / "out.jpg").stat().st_size)
    assert main(["sharpen", str(photo), str(tmp_path / "usual.jpg"), *memory]) == 0
    assert sizes[0] < sizes[1] < sizes[2]
    assert (tmp_path / "usual.jpg").stat().st_size == sizes[1]
    assert refusal(capsys, "sharpen", photo, tmp_path / "out.png", "--quality", "80").startswith(
        "--quality must be used with a JPEG, WebP or AVIF file, got 80 for "
    )


def test_all_pages_of_a_stack_are_edited_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each page as it would be alone."""
    picture = skimage.data.chelsea()[:48, :64]
    pages = [picture, 255 - picture, picture[:40]]
    with tifffile.TiffWriter(tmp_path / "in.tif") as file:
        for page in pages:
            file.write(page, photometric="rgb", metadata=None)
    assert detail(tmp_path / "in.tif", tmp_path / "out.tif", "--pages", "--depth", 16) == 0
    for number, page in enumerate(pages):
        tifffile.imwrite(tmp_path / "alone.tif", page, photometric="rgb", metadata=None)
        assert detail(tmp_path / "alone.tif", tmp_path / "alone_out.tif", "--depth", 16) == 0
        wanted, found = read_photograph(tmp_path / "alone_out.tif"), read_photograph(tmp_path / "out.tif", page=number)
        assert torch.equal(found.pixels, wanted.pixels)
        assert found.depth == "uint16"
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert len(file.pages) == 3
    capsys.readouterr()
    assert detail(tmp_path / "in.tif", tmp_path / "out.png", "--pages") == 2
    assert "--pages must be used with a TIFF file as OUT and without --show" in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()
