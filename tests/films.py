"""Films for tests: scenes, files that hold them, and the properties of files."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import skimage.data
import torch
from av.video.reformatter import Interpolation

from nlfilter_torch.photo.files.films import display_matrix
from nlfilter_torch.photo.picture.tiles import Passes

PASSES = Passes("float32")
SCENE = skimage.data.astronaut().astype(np.float32) / 255
TAGS = ("color_range", "colorspace", "color_primaries", "color_trc")


def crop(top: int, left: int, height: int = 60, width: int = 72) -> np.ndarray:
    return np.ascontiguousarray(SCENE[top : top + height, left : left + width])


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


def facts(path: Path) -> dict[str, Any]:
    """Properties that an edited film must keep."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        context = stream.codec_context
        properties: dict[str, Any] = {name: getattr(context, name) for name in (*TAGS, "pix_fmt", "width", "height")}
        properties |= {"codec": context.name, "rate": stream.average_rate, "shape": context.sample_aspect_ratio}
        properties |= {
            "title": file.metadata.get("title"),
            "languages": [s.metadata.get("language") for s in file.streams.audio],
        }
        frames = list(file.decode(video=0))
        properties["matrix"] = display_matrix(frames[0])
        properties["times"] = [f.pts * f.time_base for f in frames]
        properties["length"] = stream.duration * stream.time_base
    with av.open(str(path)) as file:
        packets = (p for p in file.demux(*file.streams.audio) if p.dts is not None) if file.streams.audio else ()
        properties["sound"] = [(p.pts * p.time_base, p.duration * p.time_base, bytes(p)) for p in packets]
    return properties


def pan(count: int, step: int, height: int = 100, width: int = 120) -> list[torch.Tensor]:
    """Frames of a camera that moves over the astronaut by ``step`` pixels to the right and down."""
    scene = torch.from_numpy(skimage.data.astronaut()).permute(2, 0, 1)[None].float() / 255
    return [
        scene[..., 60 + step * i : 60 + step * i + height, 130 + step * i : 130 + step * i + width]
        for i in range(count)
    ]
