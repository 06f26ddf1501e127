"""Films: one edit for all frames, and files that keep their sound, times, rotation and colour properties."""

import json
import sys
import weakref
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import skimage.data
import torch
from av.video.reformatter import Interpolation

from nlfilter_torch.photo.cli import main
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Stroke
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.io.films import display_matrix, open_film, write_film
from nlfilter_torch.photo.tiled.film import UNLIMITED_BANDWIDTH, FilmEdit
from nlfilter_torch.photo.tiled.tiles import Passes

PASSES = Passes("float32")
SCENE = skimage.data.astronaut().astype(np.float32) / 255
TAGS = ("color_range", "colorspace", "color_primaries", "color_trc")
FEW = {"landmarks": 40}
STEPS = [
    Step("detail", spatial_bandwidth="none", **FEW),
    Step("detail", spatial_bandwidth="none", residual=1.0, channels="all", **FEW),
    Step("detail", spatial_bandwidth=20.0, viewing_size=0.002, **FEW),
    Step("tone", contrast=1.3, clarity=2.0, spatial_bandwidth="none", **FEW),
    Step("sharpen", bandwidth="auto", **FEW),
    Step("denoise", spatial_bandwidth=UNLIMITED_BANDWIDTH, **FEW),
    Step("abstract", edges=0.5, tones=8, spatial_bandwidth=UNLIMITED_BANDWIDTH, **FEW),
    Step("look", alpha=(2.0, 1.5, 1.0), bands=(1.0, 1.2, 1.0, 1.0, 1.0, 1.0, 1.0), spatial_bandwidth="none", **FEW),
]


def crop(top: int, left: int, height: int = 60, width: int = 72) -> np.ndarray:
    return np.ascontiguousarray(SCENE[top : top + height, left : left + width])


def edited(step: Step, frame: np.ndarray) -> np.ndarray:
    """A frame under a step, as a photograph."""
    return apply_step(step, torch.from_numpy(frame).permute(2, 0, 1)[None])[0].permute(1, 2, 0).numpy()


# --- one edit for all frames


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.edit)
def test_fitted_to_one_frame_it_is_the_edit_of_that_frame(step: Step) -> None:
    frame = crop(90, 190)
    found, wanted = FilmEdit((step,), [frame], PASSES)(frame), edited(step, frame)
    assert np.abs(wanted - frame).mean() > 0.1 / 255
    np.testing.assert_allclose(found, wanted, atol=0.05 / 255)


def test_distance_does_not_count_unless_asked_for() -> None:
    frame = crop(90, 190)
    for edit, far in (("tone", "none"), ("denoise", UNLIMITED_BANDWIDTH)):
        values: dict[str, Any] = {"noise_level": 12.0} if edit == "denoise" else {}
        found = FilmEdit((Step(edit, **values, **FEW),), [frame], PASSES)(frame)
        np.testing.assert_allclose(found, edited(Step(edit, spatial_bandwidth=far, **values, **FEW), frame), atol=1e-4)


def test_equal_frames_count_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several equal references give the same result as one: balancing, means and noise are averages."""
    monkeypatch.setattr("nlfilter_torch.operator.build.choose_landmarks", lambda features, *_: features[:, :, :1900:48])
    frame = crop(90, 190)
    for step in STEPS:
        one, three = (FilmEdit((step,), [frame] * count, PASSES)(frame) for count in (1, 3))
        np.testing.assert_allclose(one, three, atol=0.1 / 255, err_msg=step.edit)


@pytest.mark.parametrize("step", [STEPS[0], STEPS[3]], ids=lambda step: step.edit)
def test_a_pan_does_not_flicker(step: Step) -> None:
    film = [crop(60 + 6 * i, 130 + 6 * i) for i in range(6)]

    def flicker(frames: list[np.ndarray]) -> float:
        return float(np.mean([np.abs(a[6:, 6:] - b[:-6, :-6]).mean() for a, b in pairwise(frames)]))

    assert flicker(film) == 0
    edit = FilmEdit((step,), [film[0], film[5]], PASSES)
    assert flicker([edit(frame) for frame in film]) <= flicker([edited(step, frame) for frame in film]) / 4


def test_steps_follow_each_other() -> None:
    frame, steps = crop(90, 190), (STEPS[3], STEPS[0])
    found = FilmEdit(steps, [frame], PASSES)(frame)
    apart = np.abs(found - edited(steps[1], edited(steps[0], frame).clip(0, 1)))
    assert apart.mean() < 0.02 / 255
    assert apart.max() < 2 / 255  # candidates for landmarks depend on rounding


def test_strokes_are_refused() -> None:
    stroke = Stroke(((0.5, 0.5),), 0.1, "in")
    for step in (Step("detail", (stroke,)), Step("recolor"), Step("defocus", (stroke,))):
        with pytest.raises(ValueError, match="edits of a film must not have strokes, got"):
            FilmEdit((step,), [crop(0, 0)], PASSES)


# --- files


def write(
    path: Path,
    count: int = 10,
    *,
    size: tuple[int, int] = (48, 64),
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    varying: bool = False,
    rotation: int = 0,
    sound: str | None = "aac",
    matrix: int = 1,
    options: dict[str, str] | None = None,
) -> Path:
    """A film of a camera that moves over the astronaut, with a tone."""
    rate = Fraction(30000, 1001)
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as file:
        file.metadata["title"] = "A short film"
        stream = file.add_stream(codec, rate=rate, options=options or {"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = size[1], size[0], pix_fmt
        stream.codec_context.time_base = Fraction(1, 30000)
        stream.sample_aspect_ratio = Fraction(4, 3)
        for name, value in zip(TAGS, (1, matrix, matrix, matrix), strict=True):
            setattr(stream.codec_context, name, value)
        if rotation:
            stream.set_display_rotation(rotation)
        tone = None
        if sound is not None:
            tone = file.add_stream(sound, rate=48000)
            tone.layout = "stereo"
            tone.metadata["language"] = "eng"
        time = 0
        for i in range(count):
            pixels = (crop(60 + 2 * i, 130 + 2 * i, *size) * 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(
                format=pix_fmt,
                dst_colorspace=matrix,
                src_color_range=2,
                dst_color_range=1,
                interpolation=Interpolation.BICUBIC,
            )
            frame.pts, frame.time_base, frame.duration = time, Fraction(1, 30000), 1001 * (1 + (varying and i % 3 == 0))
            time += frame.duration
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
        if tone is not None:
            for start in range(0, time * 48000 // 30000, 1024):
                wave = np.sin(np.arange(start, start + 1024) * 0.05).astype(np.float32)[None]
                form = tone.format.name
                wave = (
                    wave.repeat(2, 0)
                    if form.endswith("p")
                    else (wave.repeat(2, 0).T.reshape(1, -1) * 9999).astype("i2")
                )
                part = av.AudioFrame.from_ndarray(wave, format=form, layout="stereo")
                part.sample_rate, part.pts, part.time_base = 48000, start, Fraction(1, 48000)
                file.mux(tone.encode(part))
            file.mux(tone.encode(None))
    return path


def copy(source: Path, target: Path, edit: Any = lambda frame: frame) -> int:
    with open_film(source) as film:
        return write_film(film, target, edit, lambda number: None)


def facts(path: Path) -> dict[str, Any]:
    """Properties that an edited film must keep."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        context = stream.codec_context
        found: dict[str, Any] = {name: getattr(context, name) for name in (*TAGS, "pix_fmt", "width", "height")}
        found |= {"codec": context.name, "rate": stream.average_rate, "shape": context.sample_aspect_ratio}
        found |= {
            "title": file.metadata.get("title"),
            "languages": [s.metadata.get("language") for s in file.streams.audio],
        }
        frames = list(file.decode(video=0))
        found["matrix"] = display_matrix(frames[0])
        found["times"] = [f.pts * f.time_base for f in frames]
        found["length"] = stream.duration * stream.time_base
    with av.open(str(path)) as file:
        packets = (p for p in file.demux(*file.streams.audio) if p.dts is not None) if file.streams.audio else ()
        found["sound"] = [(p.pts * p.time_base, p.duration * p.time_base, bytes(p)) for p in packets]
    return found


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("h264.mp4", {}),
        ("turned.mov", {"varying": True, "rotation": 90}),
        ("silent.m4v", {"sound": None, "matrix": 6}),
        ("pcm.mov", {"sound": "pcm_s16le", "pix_fmt": "yuv444p", "size": (49, 63)}),
        (
            "deep.mov",
            {
                "codec": "libx265",
                "pix_fmt": "yuv420p10le",
                "matrix": 9,
                "rotation": 180,
                "options": {"crf": "10", "x265-params": "log-level=error"},
            },
        ),
    ],
)
def test_a_film_keeps_all_but_its_pixels(name: str, options: dict[str, Any], tmp_path: Path) -> None:
    source, target = write(tmp_path / name, **options), tmp_path / f"out{Path(name).suffix}"
    seen: list[np.ndarray] = []
    assert copy(source, target, lambda frame: seen.append(frame) or frame) == 10
    found, wanted = facts(target), facts(source)
    if options.get("varying"):  # the mean gap between frames in storage order, which is not their display order
        assert abs(found.pop("rate") / wanted.pop("rate") - 1) < 0.1
    for each in (found, wanted):
        each["length"] = round(float(each["length"]), 2)  # the file counts thousandths of a second
    assert found == wanted
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []
    with open_film(target) as film:
        for i, (frame, before) in enumerate(zip(film.frames(), seen, strict=True)):
            pixels = film.pixels(frame)
            assert np.abs(pixels - before).mean() < 3 / 255  # encoded once more
            assert (
                np.abs(pixels - crop(60 + 2 * i, 130 + 2 * i, *pixels.shape[:2])).mean() < 6 / 255
            )  # chroma is halved


def test_colours_are_those_that_the_tags_say(tmp_path: Path) -> None:
    """A colour stored with each matrix is recovered; in films without a tag, the height determines the matrix."""
    colour = np.array([0.8, 0.3, 0.2])
    for tag, size, (red, blue) in (
        (1, 48, (0.2126, 0.0722)),
        (6, 48, (0.299, 0.114)),
        (2, 48, (0.299, 0.114)),
        (2, 720, (0.2126, 0.0722)),
    ):
        luma = red * colour[0] + (1 - red - blue) * colour[1] + blue * colour[2]
        levels = [
            16 + 219 * luma,
            128 + 224 * (colour[2] - luma) / (2 - 2 * blue),
            128 + 224 * (colour[0] - luma) / (2 - 2 * red),
        ]
        planes = np.concatenate([np.full(size * 16, levels[0]), *(np.full(size * 4, level) for level in levels[1:])])
        frame = av.VideoFrame.from_ndarray(np.rint(planes).astype(np.uint8).reshape(-1, 16), format="yuv420p")
        with av.open(str(tmp_path / "flat.mp4"), "w") as file:
            stream = file.add_stream("libx264", rate=25, options={"crf": "1"})
            stream.width, stream.height, stream.pix_fmt = 16, size, "yuv420p"
            stream.codec_context.colorspace = tag
            file.mux([*stream.encode(frame), *stream.encode(None)])
        with open_film(tmp_path / "flat.mp4") as film:
            found = film.pixels(next(film.frames())).mean((0, 1))
        np.testing.assert_allclose(found, colour, atol=2.5 / 255)


def test_samples_are_spread_over_the_film(tmp_path: Path) -> None:
    source = write(tmp_path / "film.mp4", 12, varying=True)
    with open_film(source) as film:
        frames = [film.pixels(frame) for frame in film.frames()]
        film.container.seek(0)
        samples = film.sample(3)
        places = [next(i for i, frame in enumerate(frames) if np.array_equal(frame, sample)) for sample in samples]
        assert places[0] < 4 < places[1] < 8 < places[2]
        assert 1 <= len(film.sample(100)) <= 12
        count = write_film(film, tmp_path / "out.mp4", lambda frame: frame, lambda number: None)  # again from the start
    assert count == 12


def test_frames_go_through_one_at_a_time(tmp_path: Path) -> None:
    source, kept = write(tmp_path / "film.mp4"), []

    def edit(frame: np.ndarray) -> np.ndarray:
        assert sum(reference() is not None for reference in kept) <= 1
        kept.append(weakref.ref(frame))
        return frame.copy()

    assert copy(source, tmp_path / "out.mp4", edit) == 10


def test_the_output_is_complete_or_not_there(tmp_path: Path) -> None:
    source, calls = write(tmp_path / "film.mp4"), []

    def fail(frame: np.ndarray) -> np.ndarray:
        calls.append(frame.shape)
        if len(calls) == 5:
            raise MemoryError("no room")
        return frame

    (tmp_path / "out.mp4").write_bytes(b"before")
    with pytest.raises(MemoryError, match="no room"):
        copy(source, tmp_path / "out.mp4", fail)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "out.mp4"]
    assert (tmp_path / "out.mp4").read_bytes() == b"before"


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


def test_transparency_is_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path / "film.mov", codec="prores_ks", pix_fmt="yuva444p10le", sound=None, options={"profile": "4444"}
    )
    with pytest.raises(ValueError, match="has transparency or a palette, which are not supported"), open_film(path):
        pass


def test_without_the_extra_it_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    film = write(tmp_path / "film.mp4")
    monkeypatch.setitem(sys.modules, "av", None)
    assert "films need the package av, which is not installed; install nlfilter-torch[films]" in refused(
        capsys, film, tmp_path / "out.mp4"
    )


# --- the command


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
            ["--edit", "denoise", "--noise-level", "9", "--landmarks", "30"],
            (Step("denoise", noise_level=9.0, landmarks=30),),
        ),
    ):
        assert main([*arguments, *more]) == 0
        assert capsys.readouterr().out == f"6 frames in {target}\n"
        edit = FilmEdit(steps, samples, PASSES)
        with open_film(target) as film:
            for frame, rows in zip(film.frames(), before, strict=True):
                wanted, found = edit(rows).clip(0, 1), film.pixels(frame)
                # Chroma has half the resolution in the file, so only brightness can agree.
                assert np.abs(_grey(found) - _grey(wanted)).mean() < 3 / 255
                assert np.abs(_grey(wanted) - _grey(rows)).mean() > np.abs(_grey(found) - _grey(wanted)).mean()
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
