"""Films and folders of frames, edited by ``nlfilter-torch frames``."""

import json
import sys
from pathlib import Path

import av
import imagecodecs
import numpy as np
import pytest
import torch

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.colour_tables import cube_of, hald_of
from nlfilter_torch.photo.declared.presets import PRESETS, Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.film import FilmEdit
from nlfilter_torch.photo.files.films import open_film
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.tiles import Passes
from tests.films import PASSES, facts, pan, write


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["frames", *map(str, arguments)]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def test_films_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film, out = write(tmp_path / "film.mp4"), tmp_path / "out.mp4"
    whole = film.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) * 2 // 3])
    (tmp_path / "head.mp4").write_bytes(whole[:100])
    (tmp_path / "text.mov").write_text("not a film")
    (tmp_path / "empty.mov").write_bytes(b"")
    with av.open(str(tmp_path / "sound.mp4"), "w") as file:
        tone = file.add_stream("aac", rate=48000)
        tone.layout = "stereo"
        silence = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
        silence.sample_rate = 48000
        file.mux([*tone.encode(silence), *tone.encode(None)])
    odd = write(tmp_path / "odd.mov", codec="mjpeg", pix_fmt="yuvj420p", size=(49, 63), options={"strict": "-1"})
    assert "is cut short: it has" in refused(capsys, tmp_path / "cut.mp4", out)
    for name in ("head.mp4", "text.mov"):
        assert "cannot be read as a film, or is cut short" in refused(capsys, tmp_path / name, out)
    assert "is empty; copy it again" in refused(capsys, tmp_path / "empty.mov", out)
    assert "does not exist; check the name" in refused(capsys, tmp_path / "none.mp4", out)
    assert "holds no video stream that can be decoded" in refused(capsys, tmp_path / "sound.mp4", out)
    assert "must have an even width and height to be stored as yuv420p, got 63x49" in refused(capsys, odd, out)
    assert "must end in .mp4, .m4v or .mov, got '.avi'" in refused(capsys, film, tmp_path / "out.avi")
    assert "must be a film (.mp4, .m4v or .mov) or a folder" in refused(capsys, Path(__file__), out)
    assert not out.exists()
    assert not list(tmp_path.glob(".*.part"))


def test_without_the_extra_it_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    film = write(tmp_path / "film.mp4")
    monkeypatch.setitem(sys.modules, "av", None)
    assert "films need the package av, which is not installed; install nlfilter-torch[films]" in refused(
        capsys, film, tmp_path / "out.mp4"
    )


def test_a_film_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = write(tmp_path / "film.mp4", 6), tmp_path / "out.mov"
    arguments = ["frames", str(source), str(target), "--references", "2"]
    recipe = [{"edit": "tone", "landmarks": 30}, {"edit": "detail", "alpha": [2.0, 1.0], "landmarks": 30}]
    (tmp_path / "look.json").write_text(json.dumps({"version": 1, "steps": recipe}))
    with open_film(source) as film:
        samples = film.sample(2)
        film.container.seek(0)
        before = [film.pixels(frame) for frame in film.frames()]
    for more, steps in (
        (
            ["--preset", str(tmp_path / "look.json")],
            (Step("tone", landmarks=30), Step("detail", alpha=(2.0, 1.0), landmarks=30)),
        ),
        (["--preset", "crisp", "--landmarks", "30"], (Step("detail", landmarks=30),)),
        (
            ["--edit", "denoise", "--noise-level", "20", "--landmarks", "30"],
            (Step("denoise", noise_level=20.0, landmarks=30),),
        ),
    ):
        assert main([*arguments, *more]) == 0
        assert capsys.readouterr().out == f"6 frames in {target}\n"
        edit = FilmEdit(steps, samples, PASSES)
        with open_film(target) as film:
            for frame, rows in zip(film.frames(), before, strict=True):
                wanted, decoded = edit(rows).clip(0, 1), film.pixels(frame)
                # Chroma has half the resolution in the file, so only brightness can agree.
                assert np.abs(_grey(decoded) - _grey(wanted)).mean() < 3 / 255
                assert np.abs(_grey(wanted) - _grey(rows)).mean() > np.abs(_grey(decoded) - _grey(wanted)).mean()
        assert facts(target)["sound"] == facts(source)["sound"]


def _grey(rows: np.ndarray) -> np.ndarray:
    return rows @ np.array([0.2126, 0.7152, 0.0722], np.float32)


def test_options_of_other_edits_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film, out = tmp_path / "film.mp4", tmp_path / "out.mp4"
    (tmp_path / "tone.json").write_text('{"version": 1, "steps": [{"edit": "tone"}]}')
    assert "--contrast must be used with --edit tone, got --edit detail" in refused(capsys, film, out, "--contrast", 2)
    assert "--alpha must be used with --edit detail or look, got --edit tone" in refused(
        capsys, film, out, "--edit", "tone", "--alpha", "2,1"
    )
    assert "--edit must be one of denoise, detail, tone, sharpen, abstract, look, got 'recolor'" in refused(
        capsys, film, out, "--edit", "recolor"
    )
    assert "--edit must not be given together with --preset, got tone and crisp" in refused(
        capsys, film, out, "--edit", "tone", "--preset", "crisp"
    )
    assert "--landmarks must not be given with a --preset of edits other than detail" in refused(
        capsys, film, out, "--preset", tmp_path / "tone.json", "--landmarks", 9
    )
    painted = Recipe((Step("defocus", (Stroke(((0.5, 0.5),), 0.1, "in"),)),))
    (tmp_path / "paint.json").write_text(painted.to_json())
    assert "edits of a film must not have strokes, got defocus" in refused(
        capsys, film, out, "--preset", tmp_path / "paint.json"
    )
    assert "--bandwidth must be a positive number of grey levels, such as 20, got 'auto'" in refused(
        capsys, film, out, "--edit", "denoise", "--bandwidth", "auto"
    )


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
        photograph = read_photograph(path)
        assert np.abs(rows_of(photograph.pixels) - edit(rows_of(frame)).clip(0, 1)).max() < 0.6 / 255
        assert photograph.depth == ("uint16" if path.suffix == ".tif" else "uint8")


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


def test_colour_tables_of_films_and_folders(tmp_path: Path) -> None:
    colours = np.stack(np.meshgrid(*[np.arange(9) / 8] * 3, indexing="ij"))
    table = np.stack([colours[0] ** 1.4, colours[1], 0.7 * colours[2]])
    (tmp_path / "look.cube").write_text(cube_of(table, "look"))
    (tmp_path / "hald.png").write_bytes(imagecodecs.png_encode(hald_of(table)))
    (tmp_path / "shots").mkdir()
    shot = pan(1, 6, 30, 40)[0]
    write_photograph(Photograph(shot), tmp_path / "shots" / "0.png")
    film, preset = write(tmp_path / "film.mp4", 2), str(tmp_path / "look.cube")
    assert main(["frames", str(film), str(tmp_path / "out.mp4"), "--references", "1", "--preset", preset]) == 0
    with open_film(film) as before, open_film(tmp_path / "out.mp4") as after:
        for first, second in zip(before.frames(), after.frames(), strict=True):
            pixels = torch.from_numpy(before.pixels(first)).permute(2, 0, 1)[None]
            wanted = rows_of(apply_step(find_recipe(preset).steps[0], pixels).clamp(0, 1))
            assert np.abs(_grey(after.pixels(second)) - _grey(wanted)).mean() < 3 / 255
            assert np.abs(_grey(after.pixels(second)) - _grey(before.pixels(first))).mean() > 6 / 255
    for name in ("look.cube", "hald.png"):
        preset = str(tmp_path / name)
        assert main(["frames", str(tmp_path / "shots"), str(tmp_path / "done"), "--preset", preset]) == 0
        wanted = apply_step(find_recipe(preset).steps[0], read_photograph(tmp_path / "shots" / "0.png").pixels)
        assert (read_photograph(tmp_path / "done" / "0.png").pixels - wanted.clamp(0, 1)).abs().max() < 0.6 / 255


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
