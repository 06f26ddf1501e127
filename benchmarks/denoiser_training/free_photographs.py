"""Clean photographs under free licences: ``python -m benchmarks.denoiser_training.free_photographs --out FOLDER``.

``free_photographs.tsv`` beside this file names every photograph with its set (training, choosing or reporting), its
package of Debian, path and licence, and whether it shows repeated patterns. The command downloads and unpacks packages
(nothing is installed), reduces each photograph until compression has left no traces (:data:`BITS`), writes
``OUT/SET/NAME.png`` and prints what there is. Nothing may be trained on or chosen by photographs of the reporting set;
photographs of the same building are in the same set.

The training takes a folder, such as ``OUT/training``, beside scikit-image's photographs; it reduces pictures further.
"""

import argparse
import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from benchmarks.denoiser_training.packages import contents, unpacked

LIST = Path(__file__).with_suffix(".tsv")
SETS = "training", "choosing", "reporting"
BITS = 3.0  # of the file, per pixel that is left: JPEG and WebP look like the original there
LARGEST_SCALE, SMALLEST_SCALE = 0.8, 0.3  # demosaicing and sharpening leave traces at full size
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


def photographs(file: Path = LIST) -> list[Photograph]:
    """All photographs of the list."""
    with file.open(newline="") as lines:
        return [
            Photograph(**{**row, "repeated": row["repeated"] == "yes"}) for row in csv.DictReader(lines, delimiter="\t")
        ]


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Prepare the photographs and list them with their licences."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.denoiser_training.free_photographs", description=main.__doc__
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for OUT/SET/NAME.png")
    parser.add_argument("--packages", type=Path, help="folder of unpacked packages; default OUT/packages")
    options = parser.parse_args(arguments)
    totals = dict.fromkeys(SETS, (0, 0.0))
    print(f"{'set':<10} {'name':<46} {'size':<10} {'licence':<22} package")
    for photograph in photographs():
        folder = unpacked(photograph.package, options.packages or options.out / "packages")
        try:
            picture = prepared(contents(folder, photograph.path))
        except (FileNotFoundError, KeyError):
            print(f"{photograph.path} is not in this version of {photograph.package}, and is left out")
            continue
        target = options.out / photograph.set / f"{photograph.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        picture.save(target)
        count, pixels = totals[photograph.set]
        totals[photograph.set] = count + 1, pixels + picture.width * picture.height / 1e6
        size = f"{picture.width}x{picture.height}"
        print(f"{photograph.set:<10} {photograph.name:<46} {size:<10} {photograph.licence:<22} {photograph.package}")
    for name, (count, pixels) in totals.items():
        print(f"{name}: {count} photographs, {pixels:.1f} megapixels")


if __name__ == "__main__":
    main()
