"""Clean photographs under free licences: ``python -m benchmarks.free_photographs --out FOLDER``.

``free_photographs.tsv`` beside this file names every photograph with its set (training, choosing or reporting), its
package of Debian, path and licence, and whether it shows repeated patterns. The command downloads and unpacks packages
(nothing is installed), reduces each photograph until compression has left no traces (:data:`BITS`), writes
``OUT/SET/NAME.png`` and prints what there is. Nothing may be trained on or chosen by photographs of the reporting set;
photographs of the same building are in the same set.

The training takes a folder, such as ``OUT/training``, beside scikit-image's photographs; it reduces pictures further.
"""

import csv
import io
import math
import struct
import subprocess
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from PIL import Image
from torch import Tensor

from benchmarks.harness import options, read_picture
from benchmarks.photographs import CHOOSING, REPORTING, photograph

LIST = Path(__file__).with_suffix(".tsv")
SHIPPED = "scikit-image"
SETS = "training", "choosing", "reporting"
BITS = 3.0  # of the file, per pixel that is left: JPEG and WebP look like the original there
LARGEST_SCALE, SMALLEST_SCALE = 0.8, 0.3  # demosaicing and sharpening leave traces at full size
RESOURCES = ".rcc"  # Qt's archives
FOLDER, COMPRESSED, OTHER = 2, 1, 4  # flags of their entries: zlib, and another compression that photographs never have
PIXELS = 2.0e6  # largest number of pixels of a prepared picture; larger ones are reduced further


@dataclass(frozen=True)
class Photograph:
    """A photograph of a package.

    Attributes:
        set: training, choosing or reporting.
        name: unique; of the prepared file.
        package: of Debian.
        path: of the file in the package.
        licence: short name, from the package's copyright file.
        repeated: whether it shows repeated patterns, such as facades.
    """

    set: str
    name: str
    package: str
    path: str
    licence: str
    repeated: bool

    @property
    def is_shipped(self) -> bool:
        """Whether it ships with scikit-image; others are files in a folder that this command prepares."""
        return self.package == SHIPPED

    def pixels(self, folder: Path | None) -> Tensor:
        """The photograph (1, 3, H, W), from a folder unless it ships with scikit-image."""
        if self.is_shipped:
            return photograph(self.name)[:, :3]
        return read_picture((folder or Path()) / self.set / f"{self.name}.png")[None]


def photographs(file: Path = LIST) -> list[Photograph]:
    """All photographs of the list."""
    with file.open(newline="") as lines:
        return [
            Photograph(**{**row, "repeated": row["repeated"] == "yes"}) for row in csv.DictReader(lines, delimiter="\t")
        ]


@cache
def edited_photographs() -> dict[str, Photograph]:
    """Photographs that edits are measured on, by name: those of the list, and scikit-image's."""
    sets = {"choosing": CHOOSING, "reporting": REPORTING}
    shipped = [Photograph(kind, name, SHIPPED, "", "", False) for kind, names in sets.items() for name in names]
    return {entry.name: entry for entry in photographs() + shipped}


def scale_of(size: tuple[int, int], length: int) -> float:
    """Factor by which a picture of a size, in a file of a number of bytes, is reduced."""
    pixels = size[0] * size[1]
    scale = math.sqrt(8 * length / pixels / BITS)
    return min(max(scale, SMALLEST_SCALE), LARGEST_SCALE, math.sqrt(PIXELS / pixels))


def prepared(data: bytes) -> Image.Image:
    """A photograph in RGB, reduced so that it is sharp and clean."""
    with Image.open(io.BytesIO(data)) as image:
        scale = scale_of(image.size, len(data))
        size = [round(scale * length) for length in image.size]
        return image.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def unpacked(package: str, cache_folder: Path) -> Path:
    """The folder of a package's files; downloaded and unpacked if it is not there, never installed."""
    folder = cache_folder / package
    if not folder.exists():
        cache_folder.mkdir(parents=True, exist_ok=True)
        subprocess.run(["apt-get", "download", package], cwd=cache_folder, check=True, stdout=subprocess.DEVNULL)
        file = next(cache_folder.glob(f"{package}_*.deb"))
        partial = folder.with_suffix(".partial")
        subprocess.run(["dpkg-deb", "-x", file, partial], check=True)
        partial.rename(folder)
        file.unlink()
    return folder


def contents(folder: Path, path: str) -> bytes:
    """A file of an unpacked package; in Qt's archives if part of the path is the name of one."""
    before, archive, within = path.partition(RESOURCES + "/")
    if not archive:
        return (folder / path).read_bytes()
    return _resources(folder / (before + RESOURCES))[within]


@cache
def _resources(path: Path) -> dict[str, bytes]:
    return resources(path.read_bytes())


def resources(data: bytes) -> dict[str, bytes]:
    """The files of one of Qt's archives (of ``rcc --binary``), by their paths, without those compressed by zstd."""
    if data[:4] != b"qres":
        raise ValueError("data must be one of Qt's archives, which begin with 'qres'; see rcc --binary")
    version, tree, bodies, names = struct.unpack(">4I", data[4:20])
    size = 14 if version < 2 else 22  # of an entry of the tree, with or without times

    def walk(number: int, folder: str) -> Iterator[tuple[str, bytes]]:
        entry = tree + number * size
        name, flags, first, second = struct.unpack(">IHII", data[entry : entry + 14])
        (length,) = struct.unpack(">H", data[names + name : names + name + 2])
        text = data[names + name + 6 : names + name + 6 + 2 * length].decode("utf-16-be")
        path = f"{folder}{text}" if number else ""
        if flags & FOLDER:
            for child in range(second, second + first):
                yield from walk(child, f"{path}/" if path else "")
        elif not flags & OTHER:
            (length,) = struct.unpack(">I", data[bodies + second : bodies + second + 4])
            body = data[bodies + second + 4 : bodies + second + 4 + length]
            yield path, zlib.decompress(body[4:]) if flags & COMPRESSED else body

    return dict(walk(0, ""))


def main(arguments: Sequence[str] | None = None) -> None:
    """Prepare the photographs and list them with their licences."""
    parser = options("free_photographs", main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for OUT/SET/NAME.png")
    parser.add_argument("--packages", type=Path, help="folder of unpacked packages; default OUT/packages")
    chosen = parser.parse_args(arguments)
    totals = dict.fromkeys(SETS, (0, 0.0))
    print(f"{'set':<10} {'name':<46} {'size':<10} {'licence':<22} package")
    for entry in photographs():
        folder = unpacked(entry.package, chosen.packages or chosen.out / "packages")
        try:
            picture = prepared(contents(folder, entry.path))
        except (FileNotFoundError, KeyError):
            print(f"{entry.path} is not in this version of {entry.package}, and is left out")
            continue
        target = chosen.out / entry.set / f"{entry.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        picture.save(target)
        count, pixels = totals[entry.set]
        totals[entry.set] = count + 1, pixels + picture.width * picture.height / 1e6
        size = f"{picture.width}x{picture.height}"
        print(f"{entry.set:<10} {entry.name:<46} {size:<10} {entry.licence:<22} {entry.package}")
    for name, (count, pixels) in totals.items():
        print(f"{name}: {count} photographs, {pixels:.1f} megapixels")


if __name__ == "__main__":
    main()
