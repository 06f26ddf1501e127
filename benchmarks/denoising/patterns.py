"""What the filter gains where patterns repeat: drawn patterns and photographs that were kept aside from training.

The drawn ones are the kinds of :data:`benchmarks.denoiser_training.patterns.APART` (herringbone, scales, hexagons,
meshes, plaids, digits), several of each, whose n-th has the seed :data:`SEED` + n. With ``--pictures FOLDER``, the
folder of prepared photographs of :mod:`benchmarks.denoiser_training.free_photographs`, the middles of those of its
reporting set that show repeated patterns (facades, solar cells) are added. Noise is white and of known level, as for
public sets.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.denoiser_training.free_photographs import photographs
from benchmarks.denoiser_training.patterns import APART, pattern
from benchmarks.denoising.cases import Case, with_noise
from benchmarks.denoising.measuring import judge
from benchmarks.denoising.methods import Method
from benchmarks.denoising.sets import TITLES, Clipped, Results, mean, read, rounded
from benchmarks.report import table
from nlfilter_torch.operator.features import reduce_channels

SIDE, DRAWN, SEED = 192, 3, 5000  # pixels of a picture; drawn pictures of each kind, and seed of the first
PHOTOGRAPH_SIDE = 256
PHOTOGRAPHED = "photographs"
LEVEL = 25.0  # grey levels of noise
COMPARED = ("noisy", "ours", "BM3D", "scikit-image NLM")


def pictures(kind: str, folder: Path | None, *, quick: bool = False) -> Iterator[tuple[str, Tensor]]:
    """Names (what is drawn, and a number) and pictures (1, 1 or 3, H, W) in ``"grey"`` or ``"colour"``."""
    for number, drawn in enumerate(name for name in APART for _ in range(1 if quick else DRAWN)):
        generator = torch.Generator().manual_seed(SEED + number)
        yield f"{drawn} {number}", _in(kind, pattern(48 if quick else SIDE, generator, kind=drawn)[None])
    if folder is not None:
        for path in photographed(folder):
            yield f"{PHOTOGRAPHED} {path.stem}", _in(kind, _middle(read(path, "colour"), PHOTOGRAPH_SIDE))


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
            "prepare them by python -m benchmarks.denoiser_training.free_photographs --out FOLDER"
        )
    return [path for path in paths if path.exists()]


def _in(kind: str, picture: Tensor) -> Tensor:
    return picture if kind == "colour" else reduce_channels(picture, "luminance")


def _middle(picture: Tensor, side: int) -> Tensor:
    top, left = (max(0, (length - side) // 2) for length in picture.shape[-2:])
    return picture[..., top : top + side, left : left + side]


def compare(
    methods: Mapping[str, Method], kinds: Sequence[str], levels: Sequence[float], folder: Path | None, *, quick: bool
) -> Results:
    """Measurements by kind and level, method and picture."""
    results: Results = {}
    for kind in kinds:
        for number, (name, clean) in enumerate(pictures(kind, folder, quick=quick)):
            for level in levels:
                case = Case(name, clean, with_noise(clean, level / 255, number), level / 255)
                rows = results.setdefault(f"{kind}, {level:g}", {})
                for method, run in methods.items():
                    rows.setdefault(method, {})[name] = rounded(judge(run if method == "noisy" else Clipped(run), case))
    return results


def pattern_table(content: Mapping[str, Any], key: str) -> str:
    """A table of a kind and level, such as ``"grey, 25"``: PSNR of each method, and how far "ours" is ahead of it.

    Args:
        content: with the ``"results"`` of :func:`compare`.
        key: kind and level.
    """
    rows = content["results"][key]
    groups: dict[str, list[str]] = {}
    for name in next(iter(rows.values())):
        groups.setdefault(name.split()[0], []).append(name)
    lines = []
    for method, row in rows.items():
        means = [mean({name: row[name] for name in names}, "psnr") for names in groups.values()]
        line = [
            TITLES.get((method, key.split(", ")[0]), method),
            *(f"{value:.2f}" for value in means),
            f"{mean(row, 'psnr'):.2f}",
        ]
        lead = mean(rows["ours"], "psnr") - mean(row, "psnr") if "ours" in rows and method != "ours" else None
        lines.append([*line, "" if lead is None else f"{lead:+.2f}"])
    header = [f"patterns, {key}", *(f"{group} ({len(names)})" for group, names in groups.items())]
    return table([*header, "mean", "ours ahead by"], lines)
