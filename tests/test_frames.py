"""A filter fitted to one image and applied to others: exact on its own image, equal for equal patches, no flicker."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch

from nlfilter_torch import detail_layers, filter_frames, fit_filter, nonlocal_operator, polynomial_filter
from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.io.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.colour import edit_luminance
from nlfilter_torch.photo.tiled.film import FilmEdit
from nlfilter_torch.photo.tiled.tiles import Passes
from tests.problems import build, noise, picture

ALPHA = torch.tensor([3.0, 3.0, 4.0, 1.05], dtype=torch.float64)
PLAIN: dict = {"limits": "none", "threshold": 0.0}  # the filter as it is


@pytest.mark.parametrize("completion", ["diagonal", "none"])
@pytest.mark.parametrize("spatial_bandwidth", [None, 10.0])
def test_on_its_own_image_it_is_the_filter(completion: str, spatial_bandwidth: float | None) -> None:
    guide, image = picture("coffee", 24, 26), noise(1, 2, 24, 26)
    operator = build(
        guide,
        num_landmarks=60,
        photometric_bandwidth=0.2 if completion == "diagonal" else 0.6,
        spatial_bandwidth=spatial_bandwidth,
        completion=completion,
    )
    fitted = fit_filter(operator, image, order=4)
    torch.testing.assert_close(fitted.layers(image, guide), detail_layers(operator, image, order=4), atol=1e-7, rtol=0)
    alpha = torch.tensor([2.0, 0.5, 3.0, 1.0, 1.1], dtype=torch.float64)
    for residual in (None, 0.0, 1.0):
        found, expected = (
            fitted(image, alpha, guide, residual=residual),
            polynomial_filter(operator, image, alpha, residual=residual),
        )
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_a_tile_is_a_part_of_the_whole() -> None:
    """The tile has a margin of half a patch, whose border is padded."""
    image = picture("astronaut", 40, 44)
    operator = build(image, num_landmarks=60, photometric_bandwidth=0.2, spatial_bandwidth=15.0)
    fitted, whole = fit_filter(operator, image), detail_layers(operator, image)
    tile = fitted.layers(image[..., 10:30, 8:40], origin=(10, 8))
    torch.testing.assert_close(tile[..., 2:-2, 2:-2], whole[..., 12:28, 10:38], atol=1e-7, rtol=0)


def test_equal_patches_are_edited_equally_whatever_is_around() -> None:
    image = picture("astronaut", 40, 44)
    fitted = fit_filter(build(image, num_landmarks=60, photometric_bandwidth=0.2), image)
    other = noise(1, 1, 30, 30)
    other[..., 5:25, 5:25] = image[..., 10:30, 12:32]
    found = fitted(other, ALPHA)[..., 7:23, 7:23]
    torch.testing.assert_close(found, fitted(image, ALPHA)[..., 12:28, 14:30], atol=1e-9, rtol=0)


def test_what_the_references_do_not_show_stays() -> None:
    dark = 0.1 + 0.05 * noise(1, 1, 20, 20)
    fitted = fit_filter(build(dark, num_landmarks=40, photometric_bandwidth=0.02), dark)
    bright = 0.8 + 0.1 * noise(1, 1, 20, 20, seed=1)
    torch.testing.assert_close(fitted(bright, ALPHA.new_tensor([3.0, 1.0, 1.0, 1.0])), bright, atol=1e-6, rtol=0)


def test_layers_of_frames_sum_to_them_in_their_dtype() -> None:
    image = picture("coffee", 24, 26)
    fitted = fit_filter(build(image, num_landmarks=40), image)
    for dtype in (torch.float16, torch.float32, torch.float64):
        frames = noise(3, 1, 20, 30, dtype=dtype)
        layers = fitted.layers(frames)
        assert layers.dtype == dtype
        tolerance = 5e-3 if dtype == torch.float16 else 1e-5
        torch.testing.assert_close(layers.sum(1), frames, atol=tolerance, rtol=0)


def test_gradients_reach_frame_and_reference() -> None:
    reference, frame = noise(1, 1, 6, 7).requires_grad_(), noise(2, 1, 5, 6, seed=1).requires_grad_()

    def way(reference: torch.Tensor, frame: torch.Tensor, alpha: torch.Tensor) -> torch.Tensor:
        operator = nonlocal_operator(reference, photometric_bandwidth=0.5, num_landmarks=8, landmarks="uniform")
        return fit_filter(operator, reference)(frame, alpha, residual=0.5)

    assert torch.autograd.gradcheck(way, (reference, frame, ALPHA.clone().requires_grad_()), fast_mode=True)


def pan(count: int, step: int, height: int = 100, width: int = 120) -> list[torch.Tensor]:
    """Frames of a camera that moves over the astronaut by ``step`` pixels to the right and down."""
    scene = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1)[None].float() / 255
    return [
        scene[..., 60 + step * i : 60 + step * i + height, 130 + step * i : 130 + step * i + width]
        for i in range(count)
    ]


def flicker(edited: list[torch.Tensor], step: int) -> float:
    """Return the mean difference of successive frames after alignment."""
    pairs = pairwise(edited)
    return float(torch.stack([(a[..., step:, step:] - b[..., :-step, :-step]).abs().mean() for a, b in pairs]).mean())


@pytest.mark.slow
def test_ten_frames_of_a_pan_do_not_flicker() -> None:
    film, step = pan(10, 7), 7
    assert flicker(film, step) == 0
    alpha = ALPHA.float()
    together = list(filter_frames(film, alpha, references=[film[0], film[5], film[9]]))
    each = [next(filter_frames([frame], alpha, references=[frame])) for frame in film]
    assert flicker(together, step) <= flicker(each, step) / 5
    # The edit is the same: frames differ from frames edited alone by less than the edit changes them.
    change = torch.stack([(a - b).abs().mean() for a, b in zip(each, film, strict=True)]).mean()
    apart = torch.stack([(a - b).abs().mean() for a, b in zip(each, together, strict=True)]).mean()
    assert apart < change / 3


def test_equal_areas_of_frames_are_edited_equally_whatever_else_they_show() -> None:
    first = picture("coffee", 40, 60).float().expand(-1, 3, -1, -1)
    second = first.clone()
    second[..., 40:] = 1  # brighter, which must not change the brightness of the rest
    found = list(filter_frames([first, second], ALPHA.float(), references=[first], num_landmarks=40))
    torch.testing.assert_close(found[0][..., :30], found[1][..., :30], atol=1e-6, rtol=0)
    assert (found[0] - first)[..., :30].abs().max() > 0.01


def test_each_frame_has_a_gradient_of_its_own() -> None:
    film = [noise(1, 3, 12, 14, dtype=torch.float32, seed=seed) for seed in range(2)]
    alpha = ALPHA.float().requires_grad_()
    options: dict = {"references": film[:1], "num_landmarks": 20}
    both = (filter_frames(film, sliders, **options) for sliders in (alpha, ALPHA.float()))
    for frame, plain in zip(*both, strict=True):
        torch.testing.assert_close(frame.detach(), plain)
        assert torch.autograd.grad(frame.sum(), alpha)[0].isfinite().all()


def test_one_reference_is_the_usual_filter_on_luminance() -> None:
    frame = pan(1, 1, 40, 50)[0]
    grey = reduce_channels(frame, "luminance")
    operator = nonlocal_operator(grey)
    expected = edit_luminance(frame, lambda planes: polynomial_filter(operator, planes, ALPHA.float()))
    found = next(filter_frames([frame], ALPHA.float(), references=[frame], **PLAIN))
    torch.testing.assert_close(found, expected, atol=2e-4, rtol=0)


def test_all_channels_on_request() -> None:
    frame = pan(1, 1, 40, 50)[0]
    operator = nonlocal_operator(reduce_channels(frame, "luminance"), num_landmarks=60)
    wanted = polynomial_filter(operator, frame, ALPHA.float())
    options = {"channels": "all", "num_landmarks": 60} | PLAIN
    found = next(filter_frames([frame], ALPHA.float(), references=[frame], **options))
    torch.testing.assert_close(found, wanted, atol=2e-4, rtol=0)
    with pytest.raises(ValueError, match="channels must be one of"):
        filter_frames([frame], ALPHA.float(), references=[frame], channels="red")


def test_frames_are_read_one_at_a_time() -> None:
    film, seen = pan(3, 5, 30, 30), []

    def read() -> object:
        for i, frame in enumerate(film):
            seen.append(i)
            yield frame

    edited = filter_frames(read(), ALPHA.float(), references=film[:1], num_landmarks=30)
    assert seen == []
    next(edited)
    assert seen == [0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"references": []}, "references must hold at least one frame, got none"),
        ({"references": pan(2, 1, 20, 20), "spatial_bandwidth": 5.0}, "references must hold a single frame if"),
        (
            {"references": [*pan(1, 1, 20, 20), *pan(1, 1, 20, 21)]},
            "references must have the height and width of the first",
        ),
        ({"references": [torch.rand(2, 1, 9, 9)]}, "references must have batch size 1, got 2"),
    ],
)
def test_bad_references(arguments: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        filter_frames([], ALPHA, **arguments)


def test_bad_fits_and_frames() -> None:
    image = noise(1, 1, 12, 13)
    operator = build(image, num_landmarks=20)
    with pytest.raises(ValueError, match=r"image and operator must have batch size 1, got 2 and 1"):
        fit_filter(operator, image.expand(2, -1, -1, -1))
    with pytest.raises(ValueError, match="order must be at least 1, got 0"):
        fit_filter(operator, image, order=0)
    fitted = fit_filter(operator, image)
    with pytest.raises(ValueError, match=r"image must have 1 channel\(s\), got 3"):
        fitted.layers(noise(1, 3, 9, 9))
    with pytest.raises(ValueError, match="guide must have the height and width of the image, 9x9, got 8x9"):
        fitted.layers(noise(1, 1, 9, 9), noise(1, 1, 8, 9))
    with pytest.raises(ValueError, match="alpha must have one entry per layer, 4, got 3"):
        fitted(image, ALPHA[:3])


# --- the command


def rows_of(pixels: torch.Tensor) -> np.ndarray:
    """(1, C, H, W) as (H, W, C)."""
    return pixels[0].permute(1, 2, 0).contiguous().numpy()


def test_frames_as_a_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = pan(4, 6, 40, 50)
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "notes.txt").write_text("not a frame")
    for i, frame in enumerate(film):
        name = f"{i}.tif" if i == 2 else f"{i}.png"
        write_photograph(Photograph(frame, "uint16" if i == 2 else "uint8"), tmp_path / "film" / name)
    arguments = ["frames", str(tmp_path / "film"), str(tmp_path / "out"), "--landmarks", "40", "--alpha", "3,3,1"]
    for _ in range(2):  # the folder may be there
        assert main([*arguments, "--references", "2"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == f"4 frames in {tmp_path / 'out'}"
    edited = sorted((tmp_path / "out").glob("[0-9]*"))
    assert [path.name for path in edited] == ["0.png", "1.png", "2.tif", "3.png"]
    assert [path.name for path in (tmp_path / "out").iterdir() if path not in edited] == [".nlfilter-frames.json"]
    stored = [read_photograph(path).pixels for path in sorted((tmp_path / "film").glob("[0-9]*"))]
    recipe = Recipe((Step("detail", alpha=(3.0, 3.0, 1.0), landmarks=40),))
    edit = FilmEdit(recipe.steps, [rows_of(stored[0]), rows_of(stored[3])], Passes("float32"))
    for path, frame in zip(edited, stored, strict=True):
        found = read_photograph(path)
        assert np.abs(rows_of(found.pixels) - edit(rows_of(frame)).clip(0, 1)).max() < 0.6 / 255
        assert found.depth == ("uint16" if path.suffix == ".tif" else "uint8")


@pytest.mark.parametrize("name", list(PRESETS))
def test_frames_by_every_preset(name: str, tmp_path: Path) -> None:
    film, preset = pan(2, 6, 30, 40), PRESETS[name]
    (tmp_path / "film").mkdir()
    for i, frame in enumerate(film):
        write_photograph(Photograph(frame, "uint8"), tmp_path / "film" / f"{i}.png")
    arguments = ["frames", str(tmp_path / "film"), str(tmp_path / "out"), "--landmarks", "40", "--references", "1"]
    assert main([*arguments, "--preset", name]) == 0
    stored = [read_photograph(path).pixels for path in sorted((tmp_path / "film").iterdir())]
    paths = sorted((tmp_path / "out").glob("[0-9]*"))
    step = preset.steps[0].changed(landmarks=40, spatial_bandwidth="none")
    wanted = apply_step(step, stored[0])  # the frame that the filter was fitted to
    assert (read_photograph(paths[0]).pixels - wanted.clamp(0, 1)).abs().max() < 0.6 / 255
    for path, before in zip(paths, stored, strict=True):
        assert (read_photograph(path).pixels - before).abs().max() > 1 / 255


def test_folders_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*arguments: object) -> str:
        assert main(["frames", *map(str, arguments)]) == 2
        return capsys.readouterr().err

    (tmp_path / "empty").mkdir()
    (tmp_path / "film").mkdir()
    write_photograph(Photograph(pan(1, 1, 20, 20)[0]), tmp_path / "film" / "a.png")
    write_photograph(Photograph(pan(1, 1, 20, 22)[0]), tmp_path / "film" / "b.png")
    assert "is not a folder; give the one that contains the frames" in refused(tmp_path / "none", tmp_path / "out")
    assert "holds no PNG, JPEG, TIFF, WebP or AVIF file" in refused(tmp_path / "empty", tmp_path / "out")
    assert "must not be the folder of the frames" in refused(tmp_path / "film", tmp_path / "film")
    assert "does not exist; make it first" in refused(tmp_path / "film", tmp_path / "no" / "where")
    assert "is a file, not a folder" in refused(tmp_path / "film", tmp_path / "film" / "a.png")
    assert "must have the size and channels of the first frame" in refused(tmp_path / "film", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def shots(tmp_path: Path) -> Path:
    """A folder of two frames, a.png and b.png."""
    (tmp_path / "shots").mkdir()
    for name, frame in zip("ab", pan(2, 3, 20, 24), strict=True):
        write_photograph(Photograph(frame), tmp_path / "shots" / f"{name}.png")
    return tmp_path / "shots"


def edit_frames(source: Path, target: Path) -> int:
    return main(["frames", str(source), str(target), "--landmarks", "20", "--references", "1"])


def test_files_of_others_are_not_replaced(shots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = shots.with_name("out")
    out.mkdir()
    (out / "b.png").write_bytes(b"of another program")
    assert edit_frames(shots, out) == 2
    assert f"{out} already contains b.png, which this command did not write; name a" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["b.png"]
    assert (out / "b.png").read_bytes() == b"of another program"
    (out / "b.png").unlink()
    assert edit_frames(shots, out) == 0
    shots.joinpath("b.png").rename(shots / "c.png")
    (out / "c.png").touch()
    assert edit_frames(shots, out) == 2
    assert "already contains c.png" in capsys.readouterr().err
    (out / "c.png").unlink()
    for _ in range(2):
        assert edit_frames(shots, out) == 0
    (out / ".nlfilter-frames.json").write_text("5")
    assert edit_frames(shots, out) == 2


def test_links_to_frames_are_not_followed(shots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, before = shots.with_name("out"), shots.joinpath("b.png").read_bytes()
    assert edit_frames(shots, out) == 0
    (out / "b.png").unlink()
    (out / "b.png").symlink_to(shots / "b.png")
    assert edit_frames(shots, out) == 2
    assert f"b.png is a link to {shots.resolve() / 'b.png'}, which is one of the frames" in capsys.readouterr().err
    assert (shots / "b.png").read_bytes() == before


def test_what_is_beside_the_output_does_not_matter(shots: Path) -> None:
    (shots.parent / "a.png").mkdir()
    (shots / "._a.png").write_bytes(b"of macOS")
    assert edit_frames(shots, shots.with_name("out")) == 0
    assert sorted(path.name for path in shots.with_name("out").glob("*.png")) == ["a.png", "b.png"]


def test_a_first_frame_that_cannot_be_written_leaves_no_folder(shots: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in list(shots.iterdir()):
        write_photograph(Photograph(read_photograph(path).pixels, "uint16"), path)
        path.rename(path.with_suffix(".jpg"))
    assert edit_frames(shots, shots.with_name("out")) == 2
    assert "JPEG has no 16 bits per channel" in capsys.readouterr().err
    assert not shots.with_name("out").exists()
