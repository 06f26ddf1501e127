"""Whatever is written is read again as it was: files of every type, depth and size, with metadata of any length."""

import struct
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from torch import Tensor

from nlfilter_torch.photo.files.formats import DEPTHS, SUFFIXES
from nlfilter_torch.photo.files.metadata import Extras
from nlfilter_torch.photo.files.rows import open_picture, write_picture
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from tests.files import PROFILE, fields_of, rows_of

LOSSY = ("JPEG", "AVIF")
FIELDS = (271, 37500)  # of the EXIF blocks below
WITHOUT_GREY = ("WebP", "AVIF")
PACKET = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xmp:Rating="4"/></rdf:RDF>%s</x:xmpmeta>'
NAMED = {"exif": "the maker note", "xmp": "XMP of", "dpi": "the print resolution"}  # by a note, if left out


def block(note: int) -> bytes:
    """An EXIF block with the name of a maker and a note of so many bytes."""
    note = max(note, 5)
    fields = struct.pack("<HHHII", 2, 271, 2, 6, 38) + struct.pack("<HHII", 34665, 4, 1, 44) + bytes(4)
    inner = struct.pack("<HHHII", 1, 37500, 7, note, 62) + bytes(4)
    return b"Exif\0\0II*\0\x08\0\0\0" + fields + b"Maker\0" + inner + np.random.default_rng(note).bytes(note)


@dataclass(frozen=True)
class Case:
    """A photograph to write.

    Attributes:
        suffix: of the file.
        depth: of a channel.
        size: (C, H, W).
        seed: of the pixels.
        profile: bytes after a colour profile; None for no profile.
        packet: spaces in an XMP packet; None for no packet.
        note: bytes of the maker note of EXIF; None for no EXIF.
        dpi: print resolution, or None.
    """

    suffix: str
    depth: str
    size: tuple[int, int, int]
    seed: int
    profile: int | None
    packet: int | None
    note: int | None
    dpi: tuple[float, float] | None

    @property
    def kind(self) -> str:
        """The type of the file."""
        return SUFFIXES[self.suffix]

    def photograph(self) -> Photograph:
        """The photograph."""
        planes, colours = pixels_of(self.size, self.depth, self.seed), 3 if self.size[0] > 2 else 1
        alpha = planes[:, colours:] if self.size[0] > colours else None
        profile = None if self.profile is None else PROFILE + bytes(self.profile)
        packet = None if self.packet is None else PACKET % (b" " * self.packet)
        exif = None if self.note is None else block(self.note)
        return Photograph(planes[:, :colours], self.depth, alpha, profile, exif, Extras(packet, self.dpi))


def pixels_of(size: tuple[int, int, int], depth: str, seed: int) -> Tensor:
    """Values (1, C, H, W) that the depth holds exactly."""
    draw = np.random.default_rng(seed)
    if depth.startswith("float"):
        values = draw.normal(0.5, 1, (1, *size)).astype(depth)
        return torch.from_numpy(values.astype(np.float64 if depth == "float64" else np.float32))
    white = np.iinfo(depth).max
    levels = draw.integers(0, white, (1, *size), endpoint=True).astype(np.float32)
    return torch.from_numpy(levels / np.float32(white))


LENGTHS = st.sampled_from([None, 0, 1, 100, 32_000, 65_400, 65_533, 65_600, 200_000])


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Photographs of any type, depth, size and metadata that the type holds."""
    suffix = draw(st.sampled_from(sorted(SUFFIXES)))
    kind = SUFFIXES[suffix]
    depth, channels = (
        draw(st.sampled_from(DEPTHS[kind])),
        draw(st.sampled_from([1, 3] if kind == "JPEG" else [1, 2, 3, 4])),
    )
    size, dpi = (channels, draw(st.integers(1, 40)), draw(st.integers(1, 40))), [None, (300.0, 300.0), (72.0, 144.0)]
    return Case(
        suffix,
        depth,
        size,
        draw(st.integers(0, 99)),
        draw(LENGTHS),
        draw(LENGTHS),
        draw(LENGTHS),
        draw(st.sampled_from(dpi)),
    )


def check_equal(kind: str, before: Photograph, after: Photograph, notes: str) -> None:
    """Check that a photograph was read as it was written, but for what notes name."""
    if kind in WITHOUT_GREY:
        before = replace(before, pixels=before.pixels.expand(-1, 3, -1, -1))
    assert after.depth == before.depth
    assert after.pixels.shape == before.pixels.shape
    assert (after.alpha is None) == (before.alpha is None)
    if kind not in LOSSY:
        opaque = None if before.alpha is None else before.alpha > 0  # colours count where it shows
        same = after.pixels == before.pixels
        assert bool(same.all() if opaque is None else same[opaque.expand_as(same)].all())
        assert before.alpha is None or torch.equal(after.alpha, before.alpha)  # type: ignore[arg-type]
    exif = [photograph.exif for photograph in (before, after)]
    if kind == "TIFF":  # its own tables hold those of EXIF: the place of a field is another, but not of the maker note
        exif = [
            None if block is None else [(k, v) for k, v in fields_of(block).items() if k[0] in FIELDS] for block in exif
        ]
    values = {"icc": (before.icc, after.icc), "exif": tuple(exif)}
    values["xmp"] = before.extras.xmp, after.extras.xmp
    for name, (wanted, value) in values.items():
        assert value == wanted or (name in NAMED and NAMED[name] in notes), name
    if NAMED["dpi"] not in notes and before.extras.dpi is not None:
        assert after.extras.dpi is not None
        assert np.allclose(after.extras.dpi, before.extras.dpi, rtol=1e-3)


@given(cases())
@settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],  # the sizes of a case say enough
    suppress_health_check=[HealthCheck.too_slow],
)
def test_what_is_written_is_read_again(case: Case) -> None:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        first, second, by_rows = (Path(folder) / f"{name}{case.suffix}" for name in ("first", "second", "rows"))
        photograph = case.photograph()
        write_photograph(photograph, first)
        notes = " ".join(str(warning.message) for warning in caught)
        once = read_photograph(first)
        check_equal(case.kind, photograph, once, notes)
        write_photograph(once, second)
        again = read_photograph(second)
        check_equal(case.kind, once, again, notes)
        with open_picture(first, 1 << 30) as picture:
            values = rows_of(first, 7)
            stored = [(slice(top, top + 7), values[top : top + 7]) for top in range(0, len(values), 7)]
            write_picture(by_rows, iter(stored), once.depth, picture)
        check_equal(case.kind, once, read_photograph(by_rows), notes)


def test_the_comparison_notices_a_difference() -> None:
    photograph = Photograph(torch.zeros(1, 1, 2, 2), exif=block(9))
    check_equal("PNG", photograph, photograph, "")
    for other in (replace(photograph, exif=block(10)), replace(photograph, pixels=torch.ones(1, 1, 2, 2))):
        try:
            check_equal("PNG", photograph, other, "")
        except AssertionError:
            continue
        raise AssertionError("a difference was not noticed")
