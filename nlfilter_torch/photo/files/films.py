"""Films read and written frame by frame: mp4 and mov, with sound, time stamps, rotation and colour properties.

Needs the ``cli`` and the ``films`` extra (PyAV). Frames are decoded to RGB floats, and encoded with the codec, chroma
subsampling and bit depth of the film; sound and subtitles are copied as they are.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from nlfilter_torch.core.warning import warn
from nlfilter_torch.photo.files.formats import first_bytes
from nlfilter_torch.photo.files.metadata import note_left_out
from nlfilter_torch.photo.files.writing import check_file, file_beside, link_target

if TYPE_CHECKING:
    from av.container import InputContainer, OutputContainer
    from av.packet import Packet
    from av.sidedata.sidedata import SideData
    from av.stream import Stream
    from av.video.format import VideoFormat
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

Floats = NDArray[np.float32]

FILMS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov"}  # muxer of each suffix
#: Encoder of each codec, with options for a quality at which the loss is barely visible; other codecs become H.264.
ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": ("libx264", {"crf": "16", "preset": "medium"}),
    "hevc": ("libx265", {"crf": "18", "preset": "medium", "x265-params": "log-level=error"}),
    "prores": ("prores_ks", {}),
}
OF_RGB = {"libx264": "libx264rgb"}  # encoders of the same codec for RGB
BT601, BT709 = 5, 1  # colour matrices, numbered as in swscale
MATRICES = {1: 1, 4: 4, 5: 5, 6: 5, 7: 7, 9: 9}  # from numbers of H.273 to those of swscale
LIMITED, FULL = 1, 2  # colour ranges
HD_ROWS = 720  # rows from which on players assume BT.709 for untagged films
CONTAINER_METADATA = ("major_brand", "minor_version", "compatible_brands", "encoder")  # metadata of the file itself
COPIED_STREAMS = ("audio", "subtitle")


def is_film(path: Path) -> bool:
    """Whether a path has the suffix of a film."""
    return path.suffix.lower() in FILMS


def check_film_output(path: Path) -> str:
    """Return the muxer for a path; raises ValueError if no film can be written there."""
    check_file(path)
    kind = FILMS.get(path.suffix.lower())
    if kind is None:
        raise ValueError(f"{path} must end in .mp4, .m4v or .mov, got {path.suffix!r}; choose one of these")
    return kind


def _is_cover(stream: "Stream") -> bool:
    """Whether a stream is a single picture beside the film."""
    return bool(stream.disposition & stream.disposition.attached_pic)


def _av() -> ModuleType:
    try:
        import av
    except ImportError as error:
        raise ValueError("films need the package av, which is not installed; install nlfilter-torch[films]") from error
    return av


@dataclass(eq=False)
class Film:
    """An open film.

    Attributes:
        path: its file.
        container: the container of PyAV.
        stream: the video stream.
    """

    path: Path
    container: "InputContainer"
    stream: "VideoStream"

    @property
    def count(self) -> int:
        """Approximate number of frames: some of them may be hidden."""
        return self.stream.frames or len(self.stream.index_entries)

    @property
    def matrix(self) -> int:
        """The colour matrix between RGB and the stored planes, numbered as in swscale."""
        untagged = BT709 if self.stream.codec_context.height >= HD_ROWS else BT601
        return MATRICES.get(self.stream.codec_context.colorspace, untagged)

    @property
    def range(self) -> int:
        """The colour range."""
        pix_fmt = self.stream.codec_context.pix_fmt or ""
        return FULL if self.stream.codec_context.color_range == FULL or pix_fmt.startswith("yuvj") else LIMITED

    def frames(self) -> Iterator["VideoFrame"]:
        """Decode all frames from the current position on; raises ValueError if a frame cannot be decoded."""
        number = 0
        for packet in self.container.demux(self.stream):
            for frame in self.decoded(packet, number):
                number += 1
                yield frame

    def decoded(self, packet: "Packet[VideoStream]", number: int) -> list["VideoFrame"]:
        """Decode the frames that a packet completes; ``number`` frames came before, for errors."""
        av = _av()
        try:
            frames: list[VideoFrame] = packet.decode()
        except av.error.FFmpegError as error:
            raise ValueError(
                f"{self.path} is damaged after frame {number}: {error.strerror}; copy it again from its source"
            ) from error
        for frame in frames:
            if frame.interlaced_frame:
                raise ValueError(f"{self.path} is interlaced, which is not supported; deinterlace it first")
            if (frame.width, frame.height) != (self.stream.codec_context.width, self.stream.codec_context.height):
                raise ValueError(
                    f"{self.path} changes its frame size after frame {number}; split it into films of one size"
                )
        return frames

    def pixels(self, frame: "VideoFrame") -> Floats:
        """Convert a frame to RGB (H, W, 3) in [0, 1]."""
        from av.video.reformatter import Interpolation

        planes = frame.reformat(
            format="gbrpf32le",
            src_colorspace=self.matrix,
            dst_colorspace=self.matrix,
            src_color_range=self.range,
            dst_color_range=FULL,
            interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INP,
        )
        return np.ascontiguousarray(planes.to_ndarray(), np.float32)

    def sample(self, count: int) -> list[Floats]:
        """Decode the middle frames of ``count`` equal parts of the film, or all frames of a shorter film."""
        entries = self.stream.index_entries
        start = self.stream.start_time or 0
        length = self.stream.duration or (entries[-1].timestamp - start + 1 if len(entries) else 1)
        frames: list[Floats] = []
        last: int | None = None
        for part in range(count):
            wanted = start + int(length * (part + 0.5) / count)
            self.container.seek(wanted, stream=self.stream)
            frame = None
            for frame in self.frames():
                if frame.pts is not None and frame.pts + (frame.duration or 0) > wanted:
                    break
            if frame is not None and frame.pts != last:
                frames.append(self.pixels(frame))
                last = frame.pts
        if not frames:
            raise ValueError(f"{self.path} holds no frame that can be decoded; copy it again from its source")
        return frames

    def write(self, path: Path, edit: Callable[[Floats], Floats], begin: Callable[[str], None]) -> int:
        """Write the film, which is read from its start, with every frame edited; it appears complete or not at all.

        Args:
            path: path of an mp4 or mov file.
            edit: function from a frame (H, W, 3) in [0, 1] to one of the same size; values may leave [0, 1].
            begin: called with the number of each frame, in words, before it is edited.

        Returns:
            The number of frames.

        Raises:
            ValueError: if the film cannot be decoded, or ``path`` cannot hold its codecs.
            OSError: if the file cannot be written.
        """
        kind = check_film_output(path)
        av = _av()
        path = link_target(path)
        with file_beside(path) as beside:
            options = {"movflags": "+faststart" + ("+use_metadata_tags" if kind == "mov" else "")}
            try:
                with av.open(str(beside), "w", format=kind, options=options) as output:
                    count = _Transcoder(self, output, path, _encoder(self, output, path)).run(edit, begin)
            except av.error.FFmpegError as error:
                if isinstance(error, OSError) and error.filename:
                    raise
                raise OSError(
                    f"{path} cannot be written: {error.strerror}; free some space there, or choose another file type"
                ) from error
        return count


@contextmanager
def open_film(path: Path) -> Iterator[Film]:
    """Open a film to read it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no film, has no video stream, is truncated, or has transparency or a palette.
    """
    first_bytes(path)
    av = _av()
    try:
        container = av.open(str(path))
    except av.error.FFmpegError as error:
        raise ValueError(f"{path} cannot be read as a film, or is cut short; copy it again or convert it") from error
    with container:
        if not container.streams:
            raise ValueError(f"{path} cannot be read as a film, or is cut short; copy it again or convert it")
        streams = [stream for stream in container.streams.video if not _is_cover(stream)]
        if not streams or streams[0].codec_context is None or not streams[0].codec_context.pix_fmt:
            raise ValueError(f"{path} holds no video stream that can be decoded; choose a file with video")
        stored = path.stat().st_size
        ends = [entry.pos + entry.size for stream in container.streams for entry in stream.index_entries]
        if max(ends, default=0) > stored:
            raise ValueError(
                f"{path} is cut short: it has {stored} of at least {max(ends)} bytes; copy it again from its source"
            )
        stream = streams[0]
        stream.thread_type = "AUTO"
        form = stream.codec_context.format
        if form.has_palette or any(component.is_alpha for component in form.components):
            raise ValueError(f"{path} has transparency or a palette, which are not supported; convert it to yuv420p")
        yield Film(path, container, stream)


@dataclass(frozen=True)
class _Transcoder:
    """Writes the edited frames and the other streams of a film to an open container.

    Attributes:
        film: the film, read from its start.
        output: the container.
        path: where the container is going to be, for errors.
        target: stream of the edited frames.
        copied: streams of the container, by the index of the stream of the film that each is a copy of.
        durations: of the frames in the encoder, which may lose them, by time stamp.
    """

    film: Film
    output: "OutputContainer"
    path: Path
    target: "VideoStream"
    copied: dict[int, "Stream"] = field(default_factory=dict)
    durations: dict[int | None, int] = field(default_factory=dict)

    def run(self, edit: Callable[[Floats], Floats], begin: Callable[[str], None]) -> int:
        """Write everything, see :meth:`Film.write`; return the number of frames."""
        source = self.film.container
        self._add_copies()
        entries = {key: text for key, text in source.metadata.items() if key not in CONTAINER_METADATA}
        self.output.metadata.update(entries)
        chapters = source.chapters()
        if chapters:
            self.output.set_chapters(chapters)
        source.seek(0)  # the header is written with the first packet, which may be a sound packet
        self.target.set_display_matrix(next(map(display_matrix, self.film.frames()), None))
        source.seek(0)
        count = 0
        for packet in source.demux(self.film.stream, *(s for s in source.streams if s.index in self.copied)):
            if packet.stream.index in self.copied:
                self._copy(packet)
                continue
            for frame in self.film.decoded(cast("Packet[VideoStream]", packet), count):
                count += 1
                begin(f"Frame {count} of {self.film.count}")
                self.durations[frame.pts] = frame.duration
                edited = _stored(self.film, frame, edit(self.film.pixels(frame)), self.target)
                self._write(self.target.encode(edited))
        if count == 0:
            raise ValueError(f"{self.film.path} holds no frame that can be decoded; copy it again from its source")
        self._write(self.target.encode(None))
        # A chapter's title is a packet of a stream of data.
        dropped = [
            "the cover picture, which a .mov file cannot hold"
            if _is_cover(stream)
            else f"the {stream.type} stream {stream.index}"
            for stream in source.streams
            if stream.index not in (self.film.stream.index, *self.copied)
            and not (stream.type == "data" and stream.frames == len(chapters) > 0)
        ]
        note_left_out(self.path, dropped)
        return count

    def _add_copies(self) -> None:
        """Add a stream for each of sound, subtitles and cover pictures."""
        for stream in self.film.container.streams:
            kept = stream.type in COPIED_STREAMS or (_is_cover(stream) and self.output.format.name == "mp4")
            if not kept or stream.codec_context is None:
                continue
            try:
                copy = self.output.add_stream_from_template(stream)
            except ValueError as error:
                raise ValueError(
                    f"{self.path} cannot store the {stream.codec_context.name} {stream.type} of {self.film.path}; "
                    "use the file type of that film, or convert it"
                ) from error
            copy.metadata.update(stream.metadata)
            copy.disposition = stream.disposition
            self.copied[stream.index] = copy

    def _copy(self, packet: "Packet[Stream]") -> None:
        """Write a packet of sound or subtitles, or a cover picture, as it is."""
        if packet.size and _is_cover(packet.stream):
            packet.pts = packet.dts = 0  # it has no time
        if packet.dts is not None:
            packet.stream = self.copied[packet.stream.index]
            self.output.mux(packet)

    def _write(self, packets: "Iterable[Packet[VideoStream]]") -> None:
        """Write encoded frames."""
        for packet in packets:
            packet.duration = self.durations.pop(packet.pts, 0) or packet.duration
            self.output.mux(packet)


def stored_format(wanted: "VideoFormat", name: str) -> tuple[str, "VideoFormat"]:
    """The format nearest to that of a film which an encoder offers, or its relative for RGB, and the encoder's name.

    RGB, or YCbCr, counts more than the resolution of chroma, and that more than the depth.
    """
    av = _av()
    names = [name, *([OF_RGB[name]] if name in OF_RGB and wanted.is_rgb else [])]
    offered = [(form, encoder) for encoder in names for form in av.codec.Codec(encoder, "w").video_formats or ()]
    plain = [(form, encoder) for form, encoder in offered if len(form.components) in (1, 3)]
    encoders = {form.name: encoder for form, encoder in plain if form.is_rgb == wanted.is_rgb} or {
        form.name: encoder for form, encoder in plain
    }
    best, _ = av.codec.codec.find_best_pix_fmt_of_list(list(encoders), wanted)
    return encoders[best.name], best


def chroma_block(form: "VideoFormat") -> tuple[int, int]:
    """Width and height in pixels of the block that shares a chroma sample."""
    return 64 // form.chroma_width(64), 64 // form.chroma_height(64)


def changes_between(wanted: "VideoFormat", stored: "VideoFormat") -> Iterator[str]:
    """What differs between the format of a film and that of the edited one, in words."""
    if chroma_block(wanted) != chroma_block(stored):
        blocks = ("x".join(map(str, chroma_block(form))) for form in (stored, wanted))
        yield " in place of ".join(blocks) + " pixels share a colour"
    if wanted.is_rgb and not stored.is_rgb:
        yield "YCbCr in place of RGB"
    bits = stored.components[0].bits, wanted.components[0].bits
    if bits[0] < bits[1]:
        yield f"{bits[0]} bits in place of {bits[1]}"


def _encoder(film: Film, output: "OutputContainer", path: Path) -> "VideoStream":
    """Add a stream for the edited frames, with the properties of the film."""
    av = _av()
    source = film.stream.codec_context
    name, options = ENCODERS.get(source.codec.canonical_name, ENCODERS["h264"])
    wanted = av.VideoFormat((source.pix_fmt or "yuv420p").replace("yuvj", "yuv"))
    name, stored = stored_format(wanted, name)
    if changes := ", ".join(changes_between(wanted, stored)):
        warn(f"{path} stores frames as {stored.name}, since {name} has no {wanted.name}: {changes}")
    rate = film.stream.average_rate or 25
    target = cast("VideoStream", output.add_stream(name, rate=rate, options=options))
    target.pix_fmt = stored.name
    target.width, target.height = source.width, source.height
    across, down = chroma_block(stored)
    if target.width % across or target.height % down:
        raise ValueError(
            f"{film.path} must have an even width and height to be stored as {target.pix_fmt}, got "
            f"{target.width}x{target.height}; crop or scale it"
        )
    context = target.codec_context
    context.time_base = film.stream.time_base or 1 / Fraction(rate)
    context.color_primaries, context.color_trc = source.color_primaries, source.color_trc
    context.colorspace = source.colorspace
    context.color_range = film.range
    if source.sample_aspect_ratio:
        context.sample_aspect_ratio = source.sample_aspect_ratio
    if name == "libx265":
        context.codec_tag = "hvc1"  # required by some players
    target.metadata.update(film.stream.metadata)
    return target


def display_matrix(frame: "VideoFrame") -> list[int] | None:
    """Return the display matrix (rotation) of a frame as nine integers; None if it is upright."""
    parts = cast("Iterable[SideData]", frame.side_data)  # the type stubs declare something else
    data = next((part for part in parts if part.type.name == "DISPLAYMATRIX"), None)
    return None if data is None else [int(number) for number in np.frombuffer(bytes(data), np.int32)]


def _stored(film: Film, frame: "VideoFrame", pixels: Floats, target: "VideoStream") -> "VideoFrame":
    """Convert edited pixels to a frame to encode, with the time stamps of the original frame."""
    from av.video.frame import VideoFrame
    from av.video.reformatter import Interpolation

    rows = np.ascontiguousarray(pixels.clip(0, 1).astype(np.float32))
    edited = VideoFrame.from_ndarray(rows, format="gbrpf32le").reformat(
        format=target.pix_fmt,
        src_colorspace=film.matrix,
        dst_colorspace=film.matrix,
        src_color_range=FULL,
        dst_color_range=film.range,
        interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT,
    )
    context = film.stream.codec_context
    edited.colorspace, edited.color_range = context.colorspace, film.range
    edited.color_primaries, edited.color_trc = context.color_primaries, context.color_trc
    edited.pts, edited.duration, edited.time_base = frame.pts, frame.duration, film.stream.time_base
    return edited
