"""Looks from edits as people make them: ``python -m benchmarks.looks_of_people --pictures FOLDER [--quick]``.

Twelve chains of white balance, curves, hue-wise shifts, split toning and vibrance by RawTherapee's command line (and
two by ImageMagick) on photographs of a folder. Every pair is fitted, and judged on itself; then its left half is
fitted, and judged on the right one; with ``--counts`` also one, three and five photographs at once, judged on others.
Figures are PSNR in dB, after clipping. Peers: tables of 9^3, 17^3 and 33^3 colours with a ridge towards the identity,
without and with smoothness, a curve for each channel, and histograms matched. Needs ``rawtherapee-cli`` of Debian's
package rawtherapee; without it, only ImageMagick's edits are made, and without both, none.
"""

import argparse
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from benchmarks.looks import (
    CHOSEN_ON,
    Bytes,
    Edit,
    Pairs,
    Predict,
    applied,
    curves_of,
    histograms_of,
    look_of,
    magick,
    magick_program,
    table_of,
)
from benchmarks.photographs import pictures

HUES = (0, 1 / 6, 1 / 3, 1 / 2, 2 / 3, 5 / 6)  # red, yellow, green, cyan, blue, magenta
EVEN = (0.5,) * 6
Six = tuple[float, float, float, float, float, float]


def by_hue(values: Six) -> str:
    """A curve of hue in RawTherapee's profiles; 0.5 changes nothing."""
    return "1;" + "".join(f"{hue};{value};0.35;0.35;" for hue, value in zip(HUES, values, strict=True))


def spline(*points: tuple[float, float]) -> str:
    """A tone curve through points."""
    return "1;" + "".join(f"{x};{y};" for x, y in points)


def section(name: str, **entries: object) -> str:
    """A section of a profile."""
    return f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in entries.items())


def exposure(stops: float, contrast: int, saturation: int, curve: str = "0;", mode: str = "FilmLike") -> str:
    """Exposure, contrast, saturation and a tone curve."""
    entries = {"Compensation": stops, "Contrast": contrast, "Saturation": saturation, "CurveMode": mode, "Curve": curve}
    return section("Exposure", Auto="false", HistogramMatching="false", ClampOOG="true", **entries)


def white(kelvin: int, green: float) -> str:
    """White balance."""
    return section("White Balance", Enabled="true", Setting="Custom", Temperature=kelvin, Green=green, Equal=1)


def hues(shift: Six = EVEN, saturation: Six = EVEN, value: Six = EVEN) -> str:
    """Shifts of hue, saturation and value by hue."""
    curves = dict(zip(("HCurve", "SCurve", "VCurve"), map(by_hue, (shift, saturation, value)), strict=True))
    return section("HSV Equalizer", Enabled="true", **curves)


def vibrance(pastels: int, saturated: int) -> str:
    """Vibrance."""
    pair = {"Pastels": pastels, "Saturated": saturated}
    return section("Vibrance", Enabled="true", ProtectSkins="false", AvoidColorShift="true", PastSatTog="false", **pair)


def toned(shadows: tuple[int, int, int], lights: tuple[int, int, int]) -> str:
    """Split toning."""
    low = dict(zip(("Redlow", "Greenlow", "Bluelow"), shadows, strict=True))
    high = dict(zip(("Redhigh", "Greenhigh", "Bluehigh"), lights, strict=True))
    opacity = "1;0;0.3;0.35;0;0.25;0.8;0.35;0.35;0.7;0.8;0.35;0.35;1;0.3;0;0;"
    kind = {"Method": "Splitco", "Lumamode": "true", "Twocolor": "Std", "OpacityCurve": opacity}
    return section("ColorToning", Enabled="true", Autosat="false", **kind, **low, **high)


def lab(hue: Six, chroma: Six, contrast: int, strength: int) -> str:
    """Hue and chroma by hue in Lab."""
    curves = {"hhCurve": by_hue(hue), "chCurve": by_hue(chroma)}
    return section("Luminance Curve", Enabled="true", Contrast=contrast, Chromaticity=strength, **curves)


S_CURVE = spline((0, 0), (0.2, 0.14), (0.5, 0.52), (0.8, 0.88), (1, 1))
FADED = spline((0, 0.06), (0.25, 0.24), (0.6, 0.66), (1, 0.95))
LIFTED = spline((0, 0), (0.15, 0.22), (0.5, 0.62), (0.85, 0.93), (1, 1))
CROSSED = section(
    "RGB Curves",
    Enabled="true",
    rCurve=spline((0, 0), (0.25, 0.17), (0.75, 0.86), (1, 1)),
    gCurve=spline((0, 0), (0.3, 0.27), (0.7, 0.78), (1, 1)),
    bCurve=spline((0, 0.12), (0.5, 0.5), (1, 0.85)),
)
MIXED = section("Channel Mixer", Enabled="true", Red="950;80;-30;", Green="20;960;20;", Blue="-30;90;940;")
LIGHTS = section("Shadows & Highlights", Enabled="true", Highlights=40, Shadows=35, Radius=40, Lab="false")
PROFILES = {
    "warm filmic": white(5300, 1.02) + exposure(0.35, 10, 5, S_CURVE),
    "cool matte": white(7800, 0.97) + exposure(0.1, -5, -10, FADED, "Standard"),
    "autumn": exposure(0.15, 12, 0, S_CURVE)
    + hues((0.5, 0.47, 0.4, 0.5, 0.5, 0.5), (0.6, 0.62, 0.55, 0.4, 0.45, 0.5), (0.5, 0.52, 0.46, 0.48, 0.45, 0.5)),
    "teal and orange": exposure(0.1, 10, 5)
    + hues((0.52, 0.5, 0.55, 0.5, 0.46, 0.5), (0.6, 0.55, 0.35, 0.6, 0.6, 0.4))
    + toned((-10, 0, 20), (20, 8, -15)),
    "vibrant": exposure(0.3, 8, 0, LIFTED) + vibrance(55, 20),
    "split toning": exposure(0, 15, -15, FADED) + toned((-15, -5, 30), (30, 12, -20)),
    "portrait": white(5800, 1.0)
    + exposure(0.45, -8, 0, LIFTED)
    + hues(EVEN, (0.42, 0.5, 0.5, 0.5, 0.5, 0.5), (0.58, 0.53, 0.5, 0.5, 0.5, 0.5)),
    "cross process": CROSSED,
    "landscape": exposure(0.2, 5, 0, S_CURVE)
    + lab((0.5, 0.5, 0.53, 0.5, 0.48, 0.5), (0.5, 0.55, 0.6, 0.5, 0.62, 0.5), 10, 18)
    + vibrance(25, 5),
    "bright and airy": white(6200, 1.03)
    + exposure(0.8, -15, -5, LIFTED, "WeightedStd")
    + hues(EVEN, (0.5, 0.5, 0.4, 0.42, 0.45, 0.5)),
    "moody": white(7000, 1.0) + exposure(-0.5, 20, -18, S_CURVE, "Luminance") + MIXED,
    "shadows and lights": exposure(0.15, 8, 5, S_CURVE) + LIGHTS + vibrance(20, 10),
}
CHAINS = {
    "faded film (ImageMagick)": magick(
        "-sigmoidal-contrast", "4x45%", "-modulate", "103,85,97", "-channel", "B", "-level", "-8%,105%", "+channel"
    ),
    "sunset (ImageMagick)": magick(
        "-channel", "R", "-gamma", "1.15", "-channel", "B", "-gamma", "0.88", "+channel", "-modulate", "104,125,96"
    ),
}
METHODS: dict[str, Callable[[Pairs], Predict]] = {
    "look": look_of,
    **{f"{nodes}^3 ridge": partial(table_of, nodes=nodes, smooth=0.0) for nodes in (9, 17, 33)},
    **{f"{nodes}^3 smooth": partial(table_of, nodes=nodes) for nodes in (9, 17, 33)},
    "curves": curves_of,
    "histograms": histograms_of,
}


def rawtherapee(profile: str) -> Edit:
    """An edit by RawTherapee."""

    def edit(rgb: Bytes) -> Bytes:
        with tempfile.TemporaryDirectory() as folder:
            before, after, steps = (Path(folder) / name for name in ("before.png", "after.png", "steps.pp3"))
            Image.fromarray(rgb).save(before)
            steps.write_text("[Version]\nAppVersion=5.9\nVersion=348\n" + profile)
            command = ["rawtherapee-cli", "-q", "-o", after, "-p", steps, "-n", "-b8", "-Y", "-a", "-c", before]
            subprocess.run(command, capture_output=True, check=True)
            return np.array(Image.open(after).convert("RGB"))

    return edit


def edits() -> dict[str, Edit]:
    """The edits that installed programs can make."""
    made = {name: rawtherapee(profile) for name, profile in PROFILES.items()} if shutil.which("rawtherapee-cli") else {}
    return made | (CHAINS if magick_program() else {})


def psnr(result: Tensor, after: Tensor) -> float:
    """In dB, after clipping."""
    return -10 * float((result.clamp(0, 1) - after).double().square().mean().clamp(min=1e-8).log10())


def halves(pair: tuple[Tensor, Tensor]) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The left and the right half of a pair."""
    middle = pair[0].shape[3] // 2
    return (pair[0][..., :middle], pair[1][..., :middle]), (pair[0][..., middle:], pair[1][..., middle:])


def judged(fit: Callable[[Pairs], Predict], pair: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """PSNR of a fitted pair, and of its right half after the left one."""
    left, right = halves(pair)
    return psnr(fit([pair])(pair[0]), pair[1]), psnr(fit([left])(right[0]), right[1])


def mean(values: Sequence[tuple[float, float]], place: int) -> float:
    """Of fitted pairs, or of halves."""
    return statistics.mean(value[place] for value in values)


def report_single(pairs: dict[str, list[tuple[Tensor, Tensor]]], methods: Sequence[str]) -> None:
    """A table for pairs that are fitted by themselves."""
    print(
        f"\none pair: itself, right half after the left one\n{'':26}{'unedited':>14}"
        + "".join(f"{m:>14}" for m in methods)
    )
    figures: dict[str, list[tuple[float, float]]] = {name: [] for name in ("unedited", *methods)}
    for edit, examples in pairs.items():
        shown = []
        for name, all_of in figures.items():
            fit: Callable[[Pairs], Predict] = METHODS.get(name, lambda _: lambda image: image)
            all_of += [judged(fit, pair) for pair in examples]
            shown.append(all_of[-len(examples) :])
        print(f"{edit:26}" + "".join(f"{mean(of, 0):7.2f}{mean(of, 1):7.2f}" for of in shown), flush=True)
    print(f"{'mean':26}" + "".join(f"{mean(of, 0):7.2f}{mean(of, 1):7.2f}" for of in figures.values()))
    for place, what in enumerate(("fitted pairs", "right halves")):
        for name in methods[1:]:
            own, other = (mean(figures[method], place) for method in ("look", name))
            better = [a[place] > b[place] for a, b in zip(figures["look"], figures[name], strict=True)]
            print(f"{what}: look {own - other:+.2f} dB on {name}, better on {sum(better)} of {len(better)}")
        print(f"{what}: lowest of the look {min(value[place] for value in figures['look']):.2f} dB")


def report_several(pairs: dict[str, list[tuple[Tensor, Tensor]]], methods: Sequence[str], count: int) -> None:
    """A table for several photographs that are fitted at once, judged on the others."""
    print(f"\n{count} pairs: other photographs\n{'':26}" + "".join(f"{m:>12}" for m in methods))
    totals: dict[str, list[float]] = {name: [] for name in methods}
    for edit, examples in pairs.items():
        if len(examples) <= count:
            print(f"{edit:26}  left out: there are {len(examples)} photographs")
            continue
        for name in methods:
            predict = METHODS[name](examples[:count])
            totals[name].append(statistics.mean(psnr(predict(before), after) for before, after in examples[count:]))
        print(f"{edit:26}" + "".join(f"{totals[name][-1]:12.2f}" for name in methods), flush=True)
    if totals["look"]:
        print(f"{'mean':26}" + "".join(f"{statistics.mean(totals[name]):12.2f}" for name in methods))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, help="folder of photographs, in place of scikit-image's")
    parser.add_argument("--most", type=int, default=8, help="photographs")
    parser.add_argument("--side", type=int, default=384, help="pixels of the short side")
    parser.add_argument("--counts", type=int, nargs="*", default=[], help="of photographs that are fitted at once")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="all by default")
    parser.add_argument("--edits", nargs="+", default=[""], help="words of the names of the edits; all by default")
    parser.add_argument("--quick", action="store_true", help="two small photographs, and two edits")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.most, arguments.side, arguments.methods = 2, 64, ["9^3 ridge", "curves"]
    made = {name: edit for name, edit in edits().items() if any(word in name for word in arguments.edits)}
    made = dict(list(made.items())[-2:]) if arguments.quick else made
    print(f"{len(made)} edits; rawtherapee-cli is {'' if shutil.which('rawtherapee-cli') else 'not '}installed")
    if not made:
        return
    started = time.perf_counter()
    images = pictures(arguments.pictures, arguments.side, CHOSEN_ON)
    chosen = dict(list(images.items())[: arguments.most])
    print(f"photographs: {', '.join(chosen)}")
    photographs = [(image * 255).round() / 255 for image in chosen.values()]
    pairs = {name: [(image, applied(edit, image)) for image in photographs] for name, edit in made.items()}
    methods = list(dict.fromkeys(("look", *arguments.methods)))
    if not arguments.counts:
        report_single(pairs, methods)
    for count in arguments.counts:
        report_several(pairs, methods, count)
    print(f"{time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
