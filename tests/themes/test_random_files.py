"""Random files with every kind of metadata, edited at alpha 1: nothing changes that no note names.

Each case is a file of a random type, depth, size, orientation and set of metadata, made by other libraries and by hand.
The command ``detail --alpha 1,1`` edits it, in memory or in tiles, and writes a file of a random type that holds its
depth. Pixels, EXIF fields (type, bytes, and the place of the maker note), profile, XMP, resolution and tags of both
files are compared. ``RANDOM_CASES=1000 pytest tests/themes/test_random_files.py`` draws as many other files.
"""

import contextlib
import io
import math
import os
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms, PngImagePlugin

from nlfilter_torch.photo.cli import main as command
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph
from tests.files import camera_block, fields_of

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
PLAIN_XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xmp:Rating="4"/></rdf:RDF></x:xmpmeta>'
CLAIMING_XMP = PLAIN_XMP.replace(b"xmp:Rating", b'hdrgm:Version="1.0" GCamera:MotionPhoto="1" xmp:Rating')
GROUND = [
    (33550, "d", 3, (0.5, 0.5, 0.0), True),
    (33922, "d", 6, (0.0, 0.0, 0.0, 44.0, 10.0, 0.0), True),
    (34735, "H", 4, (1, 1, 0, 0), True),
    (34736, "d", 1, (6378137.0,), True),
    (34737, "s", 0, "WGS 84|", True),
    (42112, "s", 0, "<GDALMetadata/>", True),
]
LOSSLESS = (".png", ".tif", ".webp")
HOLDS = {
    "uint8": (".png", ".tif", ".webp", ".jpg", ".avif"),
    "uint16": (".png", ".tif"),
    "float32": (".tif",),
}
TILED = "0.02"  # gigabytes, for which many pictures are edited in tiles


@dataclass(frozen=True)
class Case:
    """A file to make, and the type to write it to.

    Attributes:
        source: suffix of the file.
        target: suffix of the output.
        depth: of the file.
        channels: 1 to 4.
        size: (H, W).
        orientation: of EXIF.
        order: byte order of EXIF and TIFF.
        parts: names of the metadata that it has.
        tiled: whether it is edited in tiles.
    """

    source: str
    target: str
    depth: str
    channels: int
    size: tuple[int, int]
    orientation: int
    order: str
    parts: frozenset[str]
    tiled: bool


def random_case(draw: random.Random) -> Case:
    """A case that its type can hold."""
    source = draw.choice([".jpg", ".jpg", ".png", ".png", ".tif", ".tif", ".webp", ".avif"])
    depths = {".png": ("uint8", "uint16"), ".tif": ("uint8", "uint16", "float32")}.get(source, ("uint8",))
    depth = draw.choice(depths)
    channels = draw.choice({".jpg": (1, 3), ".webp": (3, 4), ".avif": (3, 4)}.get(source, (1, 2, 3, 4)))
    targets = [suffix for suffix in HOLDS[depth] if suffix != ".jpg" or channels in (1, 3)]
    names = ["exif", "thumbnail", "xmp", "claims", "icc", "dpi", "comment", "behind", "ground", "hidden"]
    return Case(
        source,
        draw.choice(targets),
        depth,
        channels,
        (draw.randrange(8, 90), draw.randrange(8, 90)),
        draw.randrange(1, 9),
        draw.choice("<>"),
        frozenset(name for name in names if draw.random() < 0.5),
        draw.random() < 0.3,
    )


def pixels(case: Case, number: int) -> np.ndarray:
    """Smooth random levels (H, W, S)."""
    draw = np.random.default_rng(number)
    low = draw.random((6, 6, case.channels))
    rows, columns = (np.linspace(0, 5, length).round().astype(int) for length in case.size)
    levels = low[rows][:, columns] * 0.9 + 0.1 * draw.random((*case.size, case.channels))
    if case.depth == "float32":
        stored = levels.astype(np.float32)
    else:
        stored = (levels * np.iinfo(case.depth).max).astype(case.depth)
    if "hidden" in case.parts and case.channels in (2, 4):
        stored[: case.size[0] // 3, :, -1] = 0
    elif has_nodata(case):
        stored[: case.size[0] // 3] = float(nodata_of(case))
    return stored


def has_nodata(case: Case) -> bool:
    """Whether pixels of a case have the value that its file says is none."""
    return "hidden" in case.parts and case.source == ".tif" and case.channels in (1, 3)


def nodata_of(case: Case) -> str:
    """That value."""
    return "0" if case.depth != "float32" else ("nan" if case.size[0] % 2 else "-9999")


def block_of(case: Case) -> bytes:
    """The EXIF block of a case, with its orientation."""
    block = bytearray(camera_block(case.order, "thumbnail" in case.parts))
    # The orientation is the value of the second field of the first table, which begins at 8.
    place = len(b"Exif\0\0") + 8 + 2 + 12 + 8
    block[place : place + 2] = case.orientation.to_bytes(2, "little" if case.order == "<" else "big")
    if case.source == ".avif":  # Pillow would write a block with an orientation anew
        block[place - 8 : place - 6] = (18246).to_bytes(2, "little" if case.order == "<" else "big")
    return bytes(block)


def make(case: Case, path: Path, values: np.ndarray) -> None:
    """Write the file of a case."""
    flat = values[..., 0] if case.channels == 1 else values
    packet = CLAIMING_XMP if "claims" in case.parts else PLAIN_XMP
    options: dict[str, object] = {}
    if "exif" in case.parts and case.source != ".avif":
        options["exif"] = block_of(case)
    if "xmp" in case.parts:
        options["xmp"] = packet
    if "icc" in case.parts:
        options["icc_profile"] = PROFILE
    if "dpi" in case.parts:
        options["dpi"] = (240, 300)
    if case.source == ".tif":
        write_tiff(case, path, flat, packet)
        return
    if case.source == ".png":
        write_png(case, path, flat, packet)
        return
    if case.source == ".jpg" and "comment" in case.parts:
        options["comment"] = b"a comment"
    if case.source == ".avif" and "exif" in case.parts:
        options["exif"] = block_of(case)
    formats = {".jpg": "JPEG", ".webp": "WEBP", ".avif": "AVIF"}
    lossless = {"lossless": True} if case.source == ".webp" else {}
    Image.fromarray(flat).save(path, formats[case.source], **options, **lossless)
    if case.source == ".jpg" and "behind" in case.parts:
        path.write_bytes(path.read_bytes() * 2)


def write_png(case: Case, path: Path, flat: np.ndarray, packet: bytes) -> None:
    """Write a PNG file: the pixels by imagecodecs, and the chunks before them."""
    encoded = bytes(imagecodecs.png_encode(flat))
    chunks = io.BytesIO()
    if "icc" in case.parts:
        PngImagePlugin.putchunk(chunks, b"iCCP", b"ICC Profile\0\0", imagecodecs.zlib_encode(PROFILE))
    if "exif" in case.parts:
        PngImagePlugin.putchunk(chunks, b"eXIf", block_of(case).removeprefix(b"Exif\0\0"))
    if "dpi" in case.parts:
        density = (round(value / 0.0254).to_bytes(4, "big") for value in (240, 300))
        PngImagePlugin.putchunk(chunks, b"pHYs", *density, b"\1")
    if "xmp" in case.parts:
        PngImagePlugin.putchunk(chunks, b"iTXt", b"XML:com.adobe.xmp" + bytes(5) + packet)
    if "comment" in case.parts:
        PngImagePlugin.putchunk(chunks, b"tEXt", b"Comment\0a comment")
    path.write_bytes(encoded[:33] + chunks.getvalue() + encoded[33:])


def write_tiff(case: Case, path: Path, flat: np.ndarray, packet: bytes) -> None:
    """Write a TIFF file with its tags."""
    tags: list[tuple[object, ...]] = [(274, "H", 1, case.orientation, True), (315, "s", 0, "artist", True)]
    tags += [(700, "B", len(packet), packet, True)] * ("xmp" in case.parts)
    tags += GROUND * ("ground" in case.parts)
    tags += [(42113, "s", 0, nodata_of(case), True)] * has_nodata(case)
    tifffile.imwrite(
        path,
        flat,
        photometric="rgb" if case.channels > 2 else "minisblack",
        planarconfig="contig" if case.channels > 1 else None,
        extrasamples=["unassalpha"] if case.channels in (2, 4) else None,
        byteorder=case.order,
        compression="zlib",
        iccprofile=PROFILE if "icc" in case.parts else None,
        extratags=tags,
        metadata=None,
        software=False,
        **({"resolution": ((9449, 100), (3, 1)), "resolutionunit": 3} if "dpi" in case.parts else {}),
    )


def named(notes: list[str], *words: str) -> bool:
    """Whether a note names one of these."""
    return any(word in note for note in notes for word in words)


def levels_of(photograph: Photograph) -> list[np.ndarray]:
    """The planes of a photograph."""
    return [plane.numpy() for plane in (photograph.pixels, photograph.alpha) if plane is not None]


def differences(case: Case, before: Path, after: Path, notes: list[str]) -> Iterator[str]:
    """What differs between the files of a case without being named."""
    first, second = read_photograph(before), read_photograph(after)
    step = {"uint8": 1 / 255, "uint16": 1 / 65535}.get(case.depth, 1e-6)
    allowed = step / 2 if case.target in LOSSLESS else 0.4 if "hidden" in case.parts else 0.2
    for plane, again in zip(levels_of(first), levels_of(second), strict=False):
        grey = again[:, :1] if again.shape[1] > plane.shape[1] else again  # WebP and AVIF store grey in colour
        visible = np.ones(plane.shape[2:], bool) if first.hidden is None else ~first.hidden.places
        if plane.shape != grey.shape or np.abs(plane - grey)[..., visible].max() > allowed:
            yield "pixels"
    yield from hidden_differences(case, first, second, notes)
    yield from exif_differences(case, first, second, notes)
    if first.icc != second.icc:
        yield "profile"
    if first.extras.xmp != second.extras.xmp:
        yield "XMP"
    if second.extras.xmp and any(word in second.extras.xmp for word in (b"hdrgm", b"MotionPhoto")):
        yield "XMP that claims what is gone"
    if "claims" in case.parts and "xmp" in case.parts and not named(notes, "a gain map"):
        yield "a gain map without a note"
    if case.source == ".jpg" and "behind" in case.parts and not named(notes, "further pictures"):
        yield "a picture without a note"
    if first.extras.dpi is not None and not named(notes, "the print resolution"):
        pair = second.extras.dpi or (math.nan, math.nan)
        if not all(abs(a - b) < 0.02 for a, b in zip(first.extras.dpi, pair, strict=True)) and case.target not in (
            ".webp",
            ".avif",
        ):
            yield f"resolution {first.extras.dpi} {pair}"
    tags = {tag.code: tag.in_order("<") for tag in first.extras.tags}
    kept = {tag.code: tag.in_order("<") for tag in second.extras.tags}
    for code, tag in tags.items():
        if kept.get(code) != tag and not named(notes, str(code)) and not (code in (282, 283, 296) and first.extras.dpi):
            yield f"tag {code}"
    parts = {part.name for part in first.extras.parts} - {part.name for part in second.extras.parts}
    yield from (name for name in parts if not named(notes, name))


def hidden_differences(case: Case, first: Photograph, second: Photograph, notes: list[str]) -> Iterator[str]:
    """What differs between the pixels that do not count, which come back bit for bit."""
    if first.hidden is None:
        if "hidden" in case.parts and (case.channels in (2, 4) or has_nodata(case)):
            yield "nothing hidden"
        return
    kept = second.hidden is not None or named(notes, "42113")
    if not kept:
        yield "hidden pixels"
    if second.hidden is None or case.target not in LOSSLESS:
        return
    if not np.array_equal(first.hidden.places, second.hidden.places):
        yield "places of hidden pixels"
    elif first.hidden.colours.dtype != second.hidden.colours.dtype:
        return
    elif second.hidden.colours.shape == first.hidden.colours.shape and not np.array_equal(
        first.hidden.colours.view(np.uint8), second.hidden.colours.view(np.uint8)
    ):
        yield "colours of hidden pixels"


def exif_differences(case: Case, first: Photograph, second: Photograph, notes: list[str]) -> Iterator[str]:
    """What differs between the EXIF fields without being named."""
    if first.exif is None:
        if second.exif is not None and case.source != ".tif":
            yield "EXIF from nowhere"
        return
    before, after = fields_of(first.exif), fields_of(second.exif)
    yield from (f"EXIF field {key}" for key in before if after.get(key) != before[key])
    if "exif" in case.parts and case.source != ".tif":
        stored = fields_of(block_of(case))
        exempt = {274, *((40962, 40963) if case.orientation >= 5 and case.source != ".avif" else ())}
        yield from (
            f"EXIF {key} of the input"
            for key, value in stored.items()
            if key[0] not in exempt and after.get(key) != value
        )
        if (
            "thumbnail" in case.parts
            and b"\xff\xd8\xff" not in (second.exif or b"")
            and not named(notes, "the thumbnail")
        ):
            yield "thumbnail"


@pytest.mark.slow
@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("part", range(4))
def test_every_difference_is_named_by_a_note(part: int, tmp_path: Path) -> None:
    many = int(os.environ.get("RANDOM_CASES", "0"))
    seed, count = (random.randrange(1 << 32), many // 4) if many else (0, 10)
    for number in range(part * count, part * count + count):
        case = random_case(random.Random(f"{seed}:{number}"))
        source, target = tmp_path / f"{number}{case.source}", tmp_path / f"{number}_out{case.target}"
        make(case, source, pixels(case, number))
        arguments = ["detail", str(source), str(target), "--alpha", "1,1", "--landmarks", "10"]
        with contextlib.redirect_stderr(io.StringIO()) as shown:
            status = command([*arguments, *(["--memory", TILED] if case.tiled else [])])
        assert status == 0, (number, seed, case)
        unnamed = list(differences(case, source, target, shown.getvalue().splitlines()))
        assert not unnamed, (number, seed, case)
