"""Sets of pictures by which denoisers are compared: the public ones, and repeated patterns kept aside from training.

The protocol is that of the literature. Pictures keep their size and their 8 bits. White noise of 15, 25 and 50 grey
levels is added in floating point and not clipped, and every method is told the level. Results are clipped to [0, 1];
the PSNR is that of each picture over all of its channels, and its mean over the pictures is reported. A colour picture
becomes a grey one by its luminance (0.299, 0.587, 0.114), rounded to 8 bits. The noise of the n-th picture by name,
counted from 0, has the seed 1000 + n in :func:`benchmarks.denoising.cases.with_noise`; the literature states none, and
another seed changes a mean over 24 pictures by about 0.01 dB.

Patterns are of the kinds :data:`benchmarks.training.patterns.APART` (herringbone, scales, hexagons, meshes, plaids,
digits), several of each, whose n-th has the seed :data:`SEED` + n. With the folder of prepared photographs of
:mod:`benchmarks.free_photographs`, the middles of those of its reporting set that show repeated patterns (facades,
solar cells) are added.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.denoising.cases import Case, Method, judge, with_noise
from benchmarks.denoising.methods import METHODS
from benchmarks.free_photographs import photographs
from benchmarks.photographs import luminance
from benchmarks.training.patterns import APART, pattern

LEVELS = (15, 25, 50)  # grey levels of noise in the tables of the literature
FILES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".pgm", ".ppm")
COUNTS = {12: "Set12", 18: "McMaster", 24: "Kodak24", 68: "BSD68", 100: "Urban100"}  # pictures
KINDS = {"Set12": ("grey",), "BSD68": ("grey",), "CBSD68": ("colour",)}  # of the others, grey and colour
NAMES = (*COUNTS.values(), "CBSD68")
COMPARED = ("noisy", "ours", "ours, 4 turns", "BM3D", *(name for name in METHODS if " " in name and "ours" not in name))
PATTERNS_COMPARED = ("noisy", "ours", "BM3D", "scikit-image NLM")
PATTERN_LEVEL = 25.0  # grey levels of noise
SIDE, DRAWN, SEED = 192, 3, 5000  # pixels of a pattern; patterns of each kind, and seed of the first
PHOTOGRAPH_SIDE = 256
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


def patterns(kind: str, folder: Path | None, *, quick: bool = False) -> Iterator[tuple[str, Tensor]]:
    """Names (what is shown, and a number) and pictures (1, 1 or 3, H, W) in ``"grey"`` or ``"colour"``."""
    convert = luminance if kind == "grey" else torch.Tensor.contiguous
    for number, drawn in enumerate(name for name in APART for _ in range(1 if quick else DRAWN)):
        generator = torch.Generator().manual_seed(SEED + number)
        yield f"{drawn} {number}", convert(pattern(48 if quick else SIDE, generator, kind=drawn)[None])
    for path in photographed(folder) if folder is not None else ():
        picture = read(path, "colour")
        top, left = (max(0, (length - PHOTOGRAPH_SIDE) // 2) for length in picture.shape[-2:])
        yield (
            f"photographs {path.stem}",
            convert(picture[..., top : top + PHOTOGRAPH_SIDE, left : left + PHOTOGRAPH_SIDE]),
        )


def photographed(folder: Path) -> list[Path]:
    """Files of the photographs of repeated patterns in a folder.

    Raises:
        SystemExit: if it has none of them.
    """
    wanted = [entry for entry in photographs() if entry.set == "reporting" and entry.repeated]
    paths = [folder / entry.set / f"{entry.name}.png" for entry in wanted]
    if not any(path.exists() for path in paths):
        raise SystemExit(
            f"--pictures must hold photographs such as reporting/{wanted[0].name}.png, but {folder} has none of them; "
            "prepare them by python -m benchmarks.free_photographs --out FOLDER"
        )
    return [path for path in paths if path.exists()]


def measure(
    pictures: Callable[[str], Iterable[tuple[str, Tensor]]],
    kinds: Sequence[str],
    levels: Sequence[float],
    methods: Mapping[str, Method],
    results: Results,
) -> Iterator[None]:
    """Add the measurements of methods to ``results``, and print means; pause after each picture, to save them."""
    for kind in kinds:
        for level in levels:
            rows = results.setdefault(f"{kind}, {level:g}", {})
            for number, (name, clean) in enumerate(pictures(kind)):
                case = Case(name, clean, with_noise(clean, level / 255, number), level / 255)
                for method, run in methods.items():
                    figures = asdict(judge(run if method == "noisy" else clipped(run), case))
                    rows.setdefault(method, {})[name] = {
                        figure: round(value, digits)
                        for (figure, value), digits in zip(figures.items(), (4, 5, 3), strict=True)
                    }
                yield
            means = {method: mean(figures["psnr"] for figures in row.values()) for method, row in rows.items()}
            ours = means.get("ours")
            told = (
                f"{method} {value:.2f}" + ("" if ours in (None, value) else f" (ours {ours - value:+.2f})")
                for method, value in means.items()
            )
            print(f"{kind}, noise {level:g}: PSNR of {', '.join(told)}", flush=True)


def clipped(method: Method) -> Method:
    """A method whose result is clipped to [0, 1]."""
    return lambda case: method(case).clamp(0, 1)
