"""How many image files and colour tables of a folder are read as other readers do, and come out with all of their tags.

Each file is read, compared with Pillow, tifffile and libvips (those that are installed), written again as a file of its
type, and its tags and chunks are compared. A file that is refused has a reason, which is explained if it matches an
entry of the known refusals: a JSON object of regular expressions and of why they are right. ``--generate`` first fills
the folder with files of many kinds. Ends with status 1 if a file is unexplained, differs, or loses something without a
note.

    python -m benchmarks.files FOLDER --known benchmarks/refusals.json
"""

import io
import json
import re
import struct
import sys
import tempfile
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms, ImageOps

from benchmarks.harness import options
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.files import tiff
from nlfilter_torch.photo.files.exif import upright
from nlfilter_torch.photo.files.formats import SUFFIXES, first_bytes, read_channels
from nlfilter_torch.photo.files.metadata import STORAGE_TAGS, Tag
from nlfilter_torch.photo.files.png import STORAGE_CHUNKS, chunks, write_chunk
from nlfilter_torch.photo.files.tables import POINTERS, RESOLUTION, TiffTables
from nlfilter_torch.photo.picture.photographs import read_photograph, write_photograph

Pixels = NDArray[np.generic]

KNOWN = Path(__file__).with_name("refusals.json")
LEVELS = 1  # by which a channel of 8 bits may differ: readers round premultiplied colours and 16 bits differently
SHARE = 0.001  # of the values that may differ by more, such as chroma that is enlarged in another way
OF_THE_PIXELS = {254, 270, 274, *RESOLUTION, *POINTERS, *STORAGE_TAGS}  # tags that the output may have otherwise
IMAGES = {*SUFFIXES, ".heic", ".heif", ".hif", ".dng", ".pfm", ".gif", ".bmp", ".jp2", ".stk", ".lsm", ".svs", ".btf"}
TYPES = {"PNG": ".png", "JPEG": ".jpg", "WebP": ".webp", "AVIF": ".avif", "TIFF": ".tif"}


def by_pillow(path: Path) -> Pixels | None:
    """Channels (H, W, S) in 8 bits, or in 16 of a grey picture; None if Pillow reads something else."""
    with Image.open(path) as opened:
        palette = "RGBA" if "transparency" in opened.info else "RGB"
        modes = {"1": "L", "P": palette, "L": "L", "LA": "LA", "RGB": "RGB", "RGBA": "RGBA", "RGBa": "RGBA"}
        if opened.mode.startswith("I;16"):
            return np.asarray(ImageOps.exif_transpose(opened), np.uint16)[..., None]
        if opened.mode not in modes:
            return None
        picture = np.asarray(ImageOps.exif_transpose(opened.convert(modes[opened.mode])))
    return picture.reshape(*picture.shape[:2], -1)


def by_tifffile(path: Path) -> Pixels | None:
    """Channels (H, W, S) of the largest page, as stored; None of palettes and inverted or packed pixels."""
    if not tiff.is_tiff(first_bytes(path)):
        return None
    with tifffile.TiffFile(path) as file:
        pages = [page for page in (file.pages.first, *list(file.pages)[1:50]) if isinstance(page, tifffile.TiffPage)]
        pages += [page for page in file.pages.first.pages or () if isinstance(page, tifffile.TiffPage)]
        page = max(pages, key=lambda page: page.imagelength * page.imagewidth)
        plain = page.photometric in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB)
        if not plain or page.dtype is None or page.dtype.kind == "b" or 1 in page.extrasamples:
            return None
        pixels = np.asarray(page.asarray())
        turned = page.tags.get(274) or file.pages.first.tags.get(274)
        pixels = np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels
        pixels = pixels.reshape(page.imagelength, page.imagewidth, -1)
    return upright(pixels, turned.value if turned is not None and turned.value in range(1, 9) else 1)


def by_libvips(path: Path) -> Pixels | None:
    """Channels (H, W, S)."""
    import pyvips  # type: ignore[import-not-found]

    pixels: Pixels = pyvips.Image.new_from_file(str(path)).autorot().numpy()
    return pixels.reshape(*pixels.shape[:2], -1)


READERS: dict[str, Callable[[Path], Pixels | None]] = {"Pillow": by_pillow, "tifffile": by_tifffile}
if find_spec("pyvips"):
    READERS["libvips"] = by_libvips


def agree(ours: Pixels, theirs: Pixels) -> bool:
    """Whether channels (H, W, S) are those of another reader, at 8 bits if it has 8, where they are opaque."""
    if ours.shape != theirs.shape:
        return False
    first, second = ours.astype(np.float64), theirs.astype(np.float64)
    if ours.dtype != theirs.dtype:
        first, second = (
            p / (np.iinfo(q.dtype.name).max if q.dtype.kind == "u" else 1) * 255
            for p, q in ((first, ours), (second, theirs))
        )
    if ours.shape[2] in (2, 4):
        visible = second[..., -1] > 0
        first, second = first[visible], second[visible]
    if ours.dtype.kind == "f":
        return bool(np.array_equal(first, second, equal_nan=True))
    return bool((np.abs(first - second) > LEVELS).mean() <= SHARE) if first.size else True


def tags_of(path: Path) -> dict[str, object]:
    """What a file says besides its pixels: tags of TIFF, chunks of PNG, EXIF and profile of others."""
    if tiff.is_tiff(first_bytes(path)):
        tables = TiffTables(path.read_bytes())
        fields = [field for field in tables.fields(tables.first) if field.code not in OF_THE_PIXELS]
        return {
            str(field.code): (
                field.kind,
                Tag(field.code, field.kind, tables.raw(field), tables.order).in_order("<").rstrip(b"\0"),
            )
            for field in fields
        }
    said = dict[str, object]()
    data = path.read_bytes()
    if data.startswith(b"\x89PNG"):
        texts = [c for c in chunks(data) if c.sound and c.name not in (*STORAGE_CHUNKS, b"iCCP", b"eXIf", b"pHYs")]
        said |= {f"{c.name.decode()} {data[c.start : c.start + 20]!r}": data[c.start : c.stop] for c in texts}
    with Image.open(path) as image:
        said["the profile"] = image.info.get("icc_profile")
        exif = image.getexif()
        parts = {
            "": dict(exif),
            **{part.name: exif.get_ifd(part) for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)},
        }
        changed = (*OF_THE_PIXELS, 40962, 40963, ExifTags.Base.SubjectArea, ExifTags.Base.SubjectLocation)
        said |= {
            f"EXIF {part} {code}": str(value)
            for part, fields in parts.items()
            for code, value in fields.items()
            if code not in changed
        }
    return {name: value for name, value in said.items() if value is not None}


@dataclass
class Counts:
    """What became of the files of a folder.

    Attributes:
        known: regular expressions of reasons that are explained.
        counted: numbers by what they count.
        refused: numbers by reason.
        told: lines on what is unexplained, differs or is lost.
    """

    known: dict[str, str]
    counted: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)

    def look_at(self, path: Path, folder: Path) -> None:
        """Read a file, and write it to a folder."""
        self.counted["files"] += 1
        try:
            with warnings.catch_warnings(record=True):
                warnings.simplefilter("always")
                if path.suffix.lower() == ".cube":
                    Recipe.from_file(path.read_bytes(), path.name)
                    self.counted["read"] += 1
                    return
                ours = read_channels(path, bytes_per_pixel=0, memory=None).channels
        except (ValueError, MemoryError) as error:
            self._refuse(path, str(error))
            return
        except Exception as error:
            self.told.append(f"{path}: {type(error).__name__}: {error}")
            return
        self.counted["read"] += 1
        self._compare(path, ours)
        self._write(path, folder)

    def _refuse(self, path: Path, message: str) -> None:
        reason = re.sub(r"\d+(?:x\d+)?", "N", message.replace(str(path), "").replace(path.name, "").strip())
        self.refused[reason] += 1
        if not any(re.search(pattern, message) for pattern in self.known):
            self.told.append(f"{path}: refused without a known reason: {message}")

    def _compare(self, path: Path, ours: Pixels) -> None:
        """Compare with the other readers; one that agrees is enough."""
        found = dict[str, bool]()
        for name, read in READERS.items():
            with suppress(Exception), warnings.catch_warnings():  # theirs
                warnings.simplefilter("ignore")
                if (theirs := read(path)) is not None:
                    found[name] = agree(ours, theirs)
        self.counted.update(f"compared with {name}" for name in found)
        self.counted.update(f"as {name} reads them" for name, same in found.items() if same)
        if found and not any(found.values()):
            self.told.append(f"{path}: pixels differ from those of {' and '.join(found)}")

    def _write(self, path: Path, folder: Path) -> None:
        """Compare the tags of a file with those of one of its type that is written from it."""
        kind = "TIFF" if tiff.is_tiff(first_bytes(path)) else SUFFIXES.get(path.suffix.lower())
        target = folder / f"out{TYPES.get(kind or '', '.png')}"
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            try:
                write_photograph(read_photograph(path), target)
            except ValueError as error:
                self._refuse(path, str(error))
                return
        told = " ".join(str(note.message) for note in notes)
        try:
            before, after = tags_of(path), tags_of(target)
        except Exception:  # Pillow does not read them
            return
        self.counted["tags"] += len(before)
        self.counted["tags that stay"] += sum(after.get(name) == value for name, value in before.items())
        gone = [name for name, value in before.items() if after.get(name) != value]
        if gone and not re.search("without some metadata|is damaged in|cICP|is read; save", told):
            self.told.append(f"{path}: lost without a note: {', '.join(gone)}")

    def report(self) -> int:
        """Print everything; return the status."""
        for line in self.told:
            print(line)
        for name, number in sorted(self.counted.items()):
            print(f"{number:8} {name}")
        print(f"{sum(self.refused.values()):8} refused, by reason:")
        for reason, number in self.refused.most_common():
            print(f"{number:8}   {reason[:110]}")
        print(f"{len(self.told):8} unexplained, different or lost")
        return int(bool(self.told))


def generate(folder: Path) -> None:
    """Fill a folder with small files of many kinds."""
    draw = np.random.default_rng(0)
    rgb, alpha = draw.integers(0, 256, (24, 40, 3), np.uint8), draw.integers(0, 256, (24, 40, 4), np.uint8)
    palette = draw.integers(0, 256, (3, 256)).astype(np.uint16) * 257
    for name, arguments in _tiffs(rgb, alpha, palette):
        tifffile.imwrite(folder / f"{name}.tif", **arguments)
    grey = Image.fromarray(rgb[..., 0])
    for compression in ("raw", "group3", "group4", "packbits", "tiff_lzw", "tiff_adobe_deflate"):
        grey.point(lambda level: 255 * (level > 99)).convert("1").save(
            folder / f"bit-{compression}.tif", compression=compression
        )
    for mode in ("1", "L", "P", "LA", "RGB", "RGBA", "I;16"):
        source = grey if mode == "1" else Image.fromarray(rgb)
        picture = Image.fromarray(rgb[..., 0].astype(np.uint16) * 257) if mode == "I;16" else source.convert(mode)
        picture.save(folder / f"{mode.replace(';', '')}.png")
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Orientation] = "Maker", 6
    for suffix in (".jpg", ".webp", ".avif", ".png"):
        Image.fromarray(rgb).save(folder / f"turned{suffix}", exif=exif.tobytes())
    Image.fromarray(rgb).save(folder / "progressive.jpg", progressive=True)
    whole = (folder / "turned.jpg").read_bytes()
    (folder / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "zeros.jpg").write_bytes(whole[:-2] + bytes(4000))
    _generate_pngs(folder, (folder / "RGB.png").read_bytes())
    with tifffile.TiffWriter(folder / "reduced.tif") as file:
        file.write(rgb[::2, ::2], photometric="rgb", subfiletype=1, subifds=1)
        file.write(rgb, photometric="rgb")
    with tifffile.TiffWriter(folder / "pyramid.tif") as file:
        file.write(rgb, photometric="rgb", subifds=1)
        file.write(rgb[::2, ::2], photometric="rgb", subfiletype=1)
    if find_spec("pillow_heif"):
        import pillow_heif

        for depth, transfer in ((8, 13), (10, 16)):
            heif = pillow_heif.from_pillow(Image.fromarray(rgb))
            heif.save(folder / f"{depth}.heic", color_primaries=1, transfer_characteristics=transfer)
    rows = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 0 1\n1 0 1\n0 1 1\n1 1 1\n"
    for number, head in enumerate(("", "DOMAIN_MAX 2 2 2\n", "LUT_1D_INPUT_RANGE 0 1\n", "// x\n", "TITLE a\x0cb\n")):
        (folder / f"table{number}.cube").write_text(f"{head}LUT_3D_SIZE 2\n{rows}\x1a")


def _generate_pngs(folder: Path, plain: bytes) -> None:
    """Files with descriptions of colours, wrong checksums, and bytes behind the end, from a plain one."""
    profile = b"a\0\0" + zlib.compress(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    sets: dict[str, list[tuple[bytes, bytes]]] = {
        "profile": [(b"iCCP", profile), (b"gAMA", struct.pack(">I", 100_000))],
        "numbers": [(b"cICP", bytes((12, 13, 0, 1))), (b"iCCP", profile)],
        "hdr": [(b"cICP", bytes((9, 16, 0, 1))), (b"iCCP", profile)],
        "text": [(b"tEXt", b"Title\0cat"), (b"tIME", bytes(7))],
    }
    for name, added in sets.items():
        stream = io.BytesIO()
        for chunk, content in added:
            write_chunk(stream, chunk, content)
        whole = plain[:33] + stream.getvalue() + plain[33:]  # behind the header
        (folder / f"{name}.png").write_bytes(whole)
        (folder / f"{name}-checksum.png").write_bytes(
            whole[: 32 + len(stream.getvalue())] + b"?" + whole[33 + len(stream.getvalue()) :]
        )
    (folder / "behind.png").write_bytes(plain + b"more")


def _tiffs(rgb: Pixels, alpha: Pixels, palette: Pixels) -> Iterator[tuple[str, dict[str, object]]]:
    """Names of TIFF files, and what they are written with."""
    grey = rgb[..., 0]
    for kind in ("uint8", "uint16", "uint32", "int8", "int16", "float16", "float32", "float64"):
        for order in "<>":
            yield (
                f"{kind}-{'le' if order == '<' else 'be'}",
                {"data": rgb.astype(kind), "photometric": "rgb", "byteorder": order, "bigtiff": order == ">"},
            )
    for compression in ("lzw", "zlib", "packbits", "lzma", "zstd", "webp", "jpeg", "jpegxl", "jpeg2000", "png", "lerc"):
        for tile in (None, (16, 16)):
            name = f"{compression}-{'tiles' if tile else 'strips'}"
            yield name, {"data": rgb, "photometric": "rgb", "compression": compression, "tile": tile}
    yield "planes", {"data": np.moveaxis(rgb, -1, 0), "photometric": "rgb", "planarconfig": "separate"}
    yield "inverted", {"data": grey, "photometric": "miniswhite"}
    yield "palette", {"data": grey, "photometric": "palette", "colormap": palette}
    yield "cmyk", {"data": alpha, "photometric": "separated"}
    yield "lab", {"data": rgb, "photometric": "cielab"}
    for extra in ("unassalpha", "assocalpha"):
        yield extra, {"data": alpha, "photometric": "rgb", "extrasamples": [extra]}
    stack = np.stack([grey, grey, grey])
    yield "imagej", {"data": stack, "imagej": True, "metadata": {"unit": "um"}}
    yield "ome", {"data": stack, "ome": True, "photometric": "minisblack"}
    yield "stack", {"data": stack, "photometric": "minisblack"}
    for code, (kind, value) in enumerate([(1, b"ab"), (2, b"abc\0"), (3, (1, 2)), (5, (1, 3, 2, 7)), (12, (0.5, 2.0))]):
        count = len(value) // (2 if kind == 5 else 1)
        tags = [(65000 + code, kind, count, value, True)]
        yield f"tag-{kind}", {"data": grey, "extratags": tags, "metadata": None}


def main(arguments: list[str] | None = None) -> int:
    """Look at all files of a folder."""
    parser = options("files", __doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--known", type=Path, default=KNOWN, metavar="FILE", help="known refusals, see above")
    parser.add_argument("--generate", action="store_true", help="fill the folder with files first")
    chosen = parser.parse_args(arguments)
    if chosen.generate:
        chosen.folder.mkdir(parents=True, exist_ok=True)
        generate(chosen.folder)
    counts = Counts(json.loads(chosen.known.read_text()))
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(chosen.folder.rglob("*")):
            if path.is_file() and path.suffix.lower() in {*IMAGES, ".cube"}:
                counts.look_at(path, Path(folder))
    return counts.report()


if __name__ == "__main__":
    sys.exit(main())
