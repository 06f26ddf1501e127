"""Files of films keep their sound, times, rotation and colour properties."""

import io
import weakref
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from nlfilter_torch.photo.files.films import changes_between, open_film, stored_format
from tests.films import crop, facts, write


def copy(source: Path, target: Path, edit: Any = lambda frame: frame) -> int:
    with open_film(source) as film:
        return film.write(target, edit, lambda number: None)


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
    written, wanted = facts(target), facts(source)
    if options.get("varying"):  # the mean gap between frames in storage order, which is not their display order
        assert abs(written.pop("rate") / wanted.pop("rate") - 1) < 0.1
    for properties in (written, wanted):
        properties["length"] = round(float(properties["length"]), 2)  # the file counts thousandths of a second
    assert written == wanted
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []
    with open_film(target) as film:
        for i, (frame, before) in enumerate(zip(film.frames(), seen, strict=True)):
            pixels = film.pixels(frame)
            assert np.abs(pixels - before).mean() < 3 / 255  # encoded once more
            assert (
                np.abs(pixels - crop(60 + 2 * i, 130 + 2 * i, *pixels.shape[:2])).mean() < 6 / 255
            )  # chroma is halved


@pytest.mark.parametrize(("codec", "pix_fmt"), [("libx264rgb", "rgb24"), ("png", "rgb24"), ("rawvideo", "bgr24")])
@pytest.mark.filterwarnings("error")
def test_films_of_rgb_stay_rgb(codec: str, pix_fmt: str, tmp_path: Path) -> None:
    """Alternating red and blue columns would become violet if colours were halved."""
    columns = np.zeros((32, 48, 3), np.uint8)
    columns[:, ::2, 0] = columns[:, 1::2, 2] = 200
    source, target = tmp_path / "film.mov", tmp_path / "out.mov"
    with av.open(str(source), "w") as file:
        stream = file.add_stream(codec, rate=10, options={"crf": "0"} if codec == "libx264rgb" else {})
        stream.width, stream.height, stream.pix_fmt = 48, 32, pix_fmt
        for _ in range(3):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(columns, format="rgb24").reformat(format=pix_fmt)))
        file.mux(stream.encode(None))
    assert copy(source, target) == 3
    with open_film(target) as film:
        assert film.stream.codec_context.format.is_rgb
        assert np.abs(film.sample(1)[0] - columns / 255).max() < 6 / 255


def test_what_an_encoder_lacks_is_named(tmp_path: Path) -> None:
    nearest = {
        ("yuv420p", "libx264"): "yuv420p",
        ("yuv411p", "libx264"): "yuv422p",
        ("yuv440p", "libx264"): "yuv444p",
        ("yuyv422", "libx264"): "yuv422p",
        ("p010le", "libx265"): "yuv420p10le",
        ("yuv444p12le", "libx264"): "yuv444p10le",
        ("gray", "libx264"): "gray",
        ("gbrp", "libx265"): "gbrp",
        ("rgb48le", "libx264"): "bgr24",
        ("yuv422p12le", "prores_ks"): "yuv422p10le",
        ("gbrp", "prores_ks"): "yuv444p10le",
    }
    for (wanted, encoder), stored in nearest.items():
        assert stored_format(av.VideoFormat(wanted), encoder)[1].name == stored
    differences = changes_between(av.VideoFormat("gbrp12le"), av.VideoFormat("yuv420p"))
    assert list(differences) == [
        "2x2 in place of 1x1 pixels share a colour",
        "YCbCr in place of RGB",
        "8 bits in place of 12",
    ]
    film = write(
        tmp_path / "film.mov", codec="prores_ks", pix_fmt="yuv444p10le", sound=None, options={"profile": "4444"}
    )
    message = "stores frames as yuv444p10le, since prores_ks has no yuv444p12le: 10 bits in place of 12"
    with pytest.warns(UserWarning, match=message):
        copy(film, tmp_path / "out.mov")


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
            pixels = film.pixels(next(film.frames())).mean((0, 1))
        np.testing.assert_allclose(pixels, colour, atol=2.5 / 255)


def test_samples_are_spread_over_the_film(tmp_path: Path) -> None:
    source = write(tmp_path / "film.mp4", 12, varying=True)
    with open_film(source) as film:
        frames = [film.pixels(frame) for frame in film.frames()]
        film.container.seek(0)
        samples = film.sample(3)
        places = [next(i for i, frame in enumerate(frames) if np.array_equal(frame, sample)) for sample in samples]
        assert places[0] < 4 < places[1] < 8 < places[2]
        assert 1 <= len(film.sample(100)) <= 12
        count = film.write(tmp_path / "out.mp4", lambda frame: frame, lambda number: None)  # again from the start
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


def test_transparency_is_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path / "film.mov", codec="prores_ks", pix_fmt="yuva444p10le", sound=None, options={"profile": "4444"}
    )
    with pytest.raises(ValueError, match="has transparency or a palette, which are not supported"), open_film(path):
        pass


def test_chapters_and_covers_are_kept_and_other_streams_named(tmp_path: Path) -> None:
    cover, source, target = io.BytesIO(), tmp_path / "film.mp4", tmp_path / "out.mp4"
    Image.new("RGB", (32, 32), (200, 10, 10)).save(cover, "JPEG")
    with av.open(str(write(tmp_path / "plain.mp4"))) as film, av.open(str(source), "w") as file:
        copies = {stream.index: file.add_stream_from_template(stream) for stream in film.streams}
        picture = file.add_stream("mjpeg", rate=1)
        picture.width, picture.height, picture.pix_fmt = 32, 32, "yuvj420p"
        picture.disposition = av.stream.Disposition.attached_pic
        second = file.add_stream_from_template(film.streams.video[0])
        times = ((0, 100, "one"), (100, 333, "two"))
        file.set_chapters(
            [
                {"id": i, "start": start, "end": end, "time_base": Fraction(1, 1000), "metadata": {"title": title}}
                for i, (start, end, title) in enumerate(times)
            ]
        )
        for packet in film.demux():
            if packet.dts is not None:
                packet.stream = copies[packet.stream.index]
                file.mux(packet)
        film.seek(0)
        for packet in film.demux(film.streams.video[0]):
            if packet.dts is not None:
                packet.stream = second
                file.mux(packet)
        packet = av.Packet(cover.getvalue())
        packet.stream, packet.pts, packet.dts, packet.time_base = picture, 0, 0, Fraction(1)
        file.mux(packet)
    with av.open(str(source)) as film:
        chapters = film.chapters()
        named = next(stream.index for stream in film.streams.video[1:] if not stream.disposition)
    assert [chapter["metadata"]["title"] for chapter in chapters] == ["one", "two"]
    with pytest.warns(UserWarning, match=f"out.mp4 is written without .*: the video stream {named}$"):
        copy(source, target)
    with av.open(str(target)) as film:
        assert film.chapters() == chapters
        (kept,) = [stream for stream in film.streams.video if stream.disposition & stream.disposition.attached_pic]
        assert bytes(next(film.demux(kept))) == cover.getvalue()
    with pytest.warns(
        UserWarning, match=f"the video stream {named}, the cover picture, which a .mov file cannot hold$"
    ):
        copy(source, tmp_path / "out.mov")


def test_a_film_keeps_the_permissions_of_the_one_that_it_replaces(tmp_path: Path) -> None:
    source, target = write(tmp_path / "film.mp4", 2, sound=None), tmp_path / "out.mp4"
    for mode in (0o600, 0o640):
        target.touch()
        target.chmod(mode)
        copy(source, target)
        assert target.stat().st_mode & 0o777 == mode
        assert target.stat().st_size > 100
