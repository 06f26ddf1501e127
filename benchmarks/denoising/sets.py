"""The public sets by which denoisers are compared, and tables of results on them beside published figures.

The protocol is that of the literature. Pictures keep their size and their 8 bits. White noise of 15, 25 and 50 grey
levels is added in floating point and not clipped, and every method is told the level. Results are clipped to [0, 1];
the PSNR is that of each picture over all of its channels, and its mean over the pictures is reported. A colour picture
becomes a grey one by its luminance (0.299, 0.587, 0.114), rounded to 8 bits. The noise of the n-th picture by name,
counted from 0, has the seed 1000 + n in :func:`benchmarks.denoising.cases.with_noise`; the literature states none, and
another seed changes a mean over 24 pictures by about 0.01 dB.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.denoising.cases import Case, Figures, with_noise
from benchmarks.denoising.measuring import judge
from benchmarks.denoising.methods import METHODS, Method
from benchmarks.denoising.published import LEVELS, SOURCES, published
from benchmarks.report import table

FILES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm", ".ppm")
COUNTS = {12: "Set12", 18: "McMaster", 24: "Kodak24", 68: "BSD68", 100: "Urban100"}  # pictures
KINDS = {"Set12": ("grey",), "BSD68": ("grey",), "CBSD68": ("colour",)}  # of the others, grey and colour
NAMES = (*COUNTS.values(), "CBSD68")
COMPARED = ("noisy", "ours", "ours, 4 turns", "BM3D", *(name for name in METHODS if " " in name and "ours" not in name))
TITLES = {("BM3D", "colour"): "CBM3D"}
#: Results of a set: by kind and level, method, and picture.
Results = dict[str, dict[str, dict[str, dict[str, float]]]]


@dataclass(frozen=True)
class PublicSet:
    """A folder of pictures that is one of the public sets.

    Attributes:
        name: one of :data:`NAMES`.
        paths: of the pictures, in order of their names.
        kinds: ``"grey"``, ``"colour"`` or both.
    """

    name: str
    paths: tuple[Path, ...]
    kinds: tuple[str, ...]

    def pictures(self, kind: str) -> Iterator[tuple[str, Tensor]]:
        """Names and pictures (1, 1 or 3, H, W), read one by one."""
        for path in self.paths:
            yield path.stem, read(path, kind)


def read(path: Path, kind: str) -> Tensor:
    """A picture (1, 1 or 3, H, W) in [0, 1] of 8 bits, in grey or in colour."""
    with Image.open(path) as file:
        pixels = np.array(file.convert("L" if kind == "grey" else "RGB"))
    return torch.from_numpy(pixels).float().div(255).view(1, *pixels.shape[:2], -1).permute(0, 3, 1, 2).contiguous()


def recognise(folder: Path, name: str | None = None, kinds: Sequence[str] | None = None) -> PublicSet:
    """The set in a folder, by its ``name``, by the folder's name, or by the number of pictures in it.

    Raises:
        SystemExit: if it cannot be recognised, or has grey pictures and is asked for colour.
    """
    if not folder.is_dir():
        raise SystemExit(f"--set must be a folder of pictures, and {folder} is none; name another")
    paths = tuple(sorted(path for path in folder.iterdir() if path.suffix.lower() in FILES))
    if not paths:
        raise SystemExit(f"--set must be a folder of pictures ({', '.join(FILES)}), but {folder} has none")
    in_colour = _is_coloured(paths[0])
    by_folder = next((known for known in sorted(NAMES, key=len, reverse=True) if known.lower() in _plain(folder)), None)
    name = name or by_folder or COUNTS.get(len(paths))
    if name is None:
        raise SystemExit(
            f"--set {folder} must be one of {', '.join(NAMES)}, but holds {len(paths)} pictures, as none of them; "
            "name it by --name"
        )
    if name == "BSD68" and in_colour and (kinds is None or "colour" in kinds):
        name = "CBSD68"
    possible = KINDS.get(name, ("grey", "colour")) if kinds is None else tuple(kinds)
    if not in_colour and "colour" in possible:
        if kinds is not None:
            raise SystemExit(f"--kinds must be grey for {folder}, got colour, but its pictures are grey")
        possible = ("grey",)
    return PublicSet(name, paths, possible)


def _plain(folder: Path) -> str:
    return "".join(letter for letter in folder.resolve().name.lower() if letter.isalnum())


def _is_coloured(path: Path) -> bool:
    pixels = read(path, "colour")
    return bool((pixels != pixels[:, :1]).any())


@dataclass(frozen=True)
class Clipped:
    """A method whose result is clipped to [0, 1]."""

    method: Method

    def __call__(self, case: Case) -> Tensor:
        """Run it."""
        return self.method(case).clamp(0, 1)


def measure(
    pictures: PublicSet, methods: Mapping[str, Method], levels: Sequence[float], results: Results
) -> Iterator[None]:
    """Add the measurements of methods on a set to ``results``; pause after each picture, so that they can be saved."""
    for kind in pictures.kinds:
        for level in levels:
            rows = results.setdefault(f"{kind}, {level:g}", {})
            for number, (name, clean) in enumerate(pictures.pictures(kind)):
                case = Case(name, clean, with_noise(clean, level / 255, number), level / 255)
                for method, run in methods.items():
                    rows.setdefault(method, {})[name] = rounded(judge(run if method == "noisy" else Clipped(run), case))
                yield
            line = ", ".join(f"{method} {mean(row, 'psnr'):.2f}" for method, row in rows.items())
            print(f"{pictures.name} in {kind}, noise {level:g}: {line}", flush=True)


def rounded(figures: Figures) -> dict[str, float]:
    """Measurements for a file."""
    return {"psnr": round(figures.psnr, 4), "ssim": round(figures.ssim, 5), "seconds": round(figures.seconds, 3)}


def mean(row: Mapping[str, Mapping[str, float]], figure: str) -> float:
    """Mean of a measurement over pictures."""
    return statistics.mean(measurements[figure] for measurements in row.values())


def set_table(content: Mapping[str, Any], kind: str, *, quoted: bool) -> str:
    """A table of a set: measured rows, and published ones if they are to be ``quoted``, with their sources below.

    Args:
        content: of the file of a set: its name as ``"set"``, the number of ``"weights"`` of the network of the
            package, and ``"results"``.
        kind: ``"grey"`` or ``"colour"``.
        quoted: whether there are published figures in it.
    """
    name, results = content["set"], content["results"]
    levels = [int(key.split(", ")[1]) for key in results if key.startswith(f"{kind}, ")]
    measured = dict.fromkeys(method for level in levels for method in results[f"{kind}, {level}"])
    order = [*(name for name in METHODS if name in measured), *(name for name in measured if name not in METHODS)]
    rows = [_measured_row(content, kind, method, levels) for method in order]
    entries = published(name, kind) if quoted else ()
    for entry in entries:
        values = dict(zip(LEVELS, entry.psnr, strict=True))
        decibels = [_decibels(values.get(level)) for level in levels]
        rows.append(
            [entry.method, *decibels, "", "", "" if entry.weights is None else f"{entry.weights:,}", entry.source]
        )
    header = [f"{name}, {kind}, noise of", *map(str, levels), "SSIM at 25", "CPU s", "weights, thousands", "figures of"]
    pictures = next(iter(results[f"{kind}, {levels[0]}"].values()))
    sources = dict.fromkeys(entry.source for entry in entries)
    notes = [f"Means over {len(pictures)} pictures.", *(f"{source}: {SOURCES[source]}." for source in sources)]
    return f"{table(header, rows)}\n\n{fill(' '.join(notes), 120, break_on_hyphens=False)}"


def _measured_row(content: Mapping[str, Any], kind: str, method: str, levels: Sequence[int]) -> list[str]:
    known = {level: content["results"][f"{kind}, {level}"].get(method) for level in levels}
    values = [None if row is None else mean(row, "psnr") for row in known.values()]
    middle = known.get(25)
    seconds = statistics.mean(mean(row, "seconds") for row in known.values() if row is not None)
    ssim = "" if middle is None else f"{mean(middle, 'ssim'):.3f}"
    weights = f"{content['weights'] / 1000:,.0f}" if method.startswith("ours") else ""
    return [TITLES.get((method, kind), method), *map(_decibels, values), ssim, f"{seconds:.1f}", weights, "this run"]


def _decibels(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
