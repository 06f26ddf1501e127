"""How near fitted looks come to edits as people make them: ``python -m benchmarks.looks_of_people``.

Twelve chains of white balance, curves, hue-wise shifts, split toning and vibrance by RawTherapee's command line
(``rawtherapee/*.pp3``) and two by ImageMagick on photographs of a folder. Every pair is fitted, and judged on itself;
then its left half is fitted, and judged on the right one; with ``--counts`` also one, three and five photographs at
once, judged on others. Figures are PSNR in dB, after clipping. Peers: tables of 9^3, 17^3 and 33^3 colours with a ridge
towards the identity, without and with smoothness, a curve for each channel, and histograms matched. Needs
``rawtherapee-cli`` of Debian's package rawtherapee; without it, only ImageMagick's edits are made, and without both,
none.
"""

import shutil
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from benchmarks.harness import options, row
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

#: Profiles of RawTherapee, by name.
PROFILES = {
    path.stem.split("-", 1)[1].replace("-", " "): path
    for path in sorted(Path(__file__).with_name("rawtherapee").glob("*.pp3"))
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


def rawtherapee(profile: Path) -> Edit:
    """An edit by RawTherapee."""

    def edit(rgb: Bytes) -> Bytes:
        with tempfile.TemporaryDirectory() as folder:
            before, after = (Path(folder) / name for name in ("before.png", "after.png"))
            Image.fromarray(rgb).save(before)
            command = ["rawtherapee-cli", "-q", "-o", after, "-p", profile, "-n", "-b8", "-Y", "-a", "-c", before]
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


def judged(fit: Callable[[Pairs], Predict], pair: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """PSNR of a fitted pair, and of its right half after the left one."""
    middle = pair[0].shape[3] // 2
    left, right = ((pair[0][..., part], pair[1][..., part]) for part in (slice(middle), slice(middle, None)))
    return psnr(fit([pair])(pair[0]), pair[1]), psnr(fit([left])(right[0]), right[1])


def mean(values: Sequence[tuple[float, float]], place: int) -> float:
    """Of fitted pairs, or of halves."""
    return statistics.mean(value[place] for value in values)


def report_single(pairs: dict[str, list[tuple[Tensor, Tensor]]], methods: Sequence[str]) -> None:
    """A table for pairs that are fitted by themselves."""
    print("\none pair: itself, right half after the left one\n" + row("", ("unedited", *methods), 14))
    figures: dict[str, list[tuple[float, float]]] = {name: [] for name in ("unedited", *methods)}

    def line(name: str, parts: Iterable[list[tuple[float, float]]]) -> None:
        print(row(name, (f"{mean(of, 0):.2f}{mean(of, 1):7.2f}" for of in parts), 14), flush=True)

    for edit, examples in pairs.items():
        for name, all_of in figures.items():
            fit: Callable[[Pairs], Predict] = METHODS.get(name, lambda _: lambda image: image)
            all_of += [judged(fit, pair) for pair in examples]
        line(edit, (of[-len(examples) :] for of in figures.values()))
    line("mean", figures.values())
    for place, what in enumerate(("fitted pairs", "right halves")):
        for name in methods[1:]:
            own, other = (mean(figures[method], place) for method in ("look", name))
            better = [a[place] > b[place] for a, b in zip(figures["look"], figures[name], strict=True)]
            print(f"{what}: look {own - other:+.2f} dB on {name}, better on {sum(better)} of {len(better)}")
        print(f"{what}: lowest of the look {min(value[place] for value in figures['look']):.2f} dB")


def report_several(pairs: dict[str, list[tuple[Tensor, Tensor]]], methods: Sequence[str], count: int) -> None:
    """A table for several photographs that are fitted at once, judged on the others."""
    print(f"\n{count} pairs: other photographs\n" + row("", methods, 12))
    totals: dict[str, list[float]] = {name: [] for name in methods}
    for edit, examples in pairs.items():
        if len(examples) <= count:
            print(f"{edit:26}  left out: there are {len(examples)} photographs")
            continue
        for name in methods:
            predict = METHODS[name](examples[:count])
            totals[name].append(statistics.mean(psnr(predict(before), after) for before, after in examples[count:]))
        print(row(edit, (f"{totals[name][-1]:.2f}" for name in methods), 12), flush=True)
    if totals["look"]:
        print(row("mean", (f"{statistics.mean(totals[name]):.2f}" for name in methods), 12))


def main() -> None:
    """Print the tables."""
    parser = options("looks_of_people", __doc__, "two small photographs, and two edits")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of photographs, in place of scikit-image's")
    add("--most", type=int, default=8, help="photographs")
    add("--side", type=int, default=384, help="pixels of the short side")
    add("--counts", type=int, nargs="*", default=[], help="of photographs that are fitted at once")
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="all by default")
    add("--edits", nargs="+", default=[""], help="words of the names of the edits; all by default")
    chosen = parser.parse_args()
    if chosen.quick:
        chosen.most, chosen.side, chosen.methods = 2, 64, ["9^3 ridge", "curves"]
    made = {name: edit for name, edit in edits().items() if any(word in name for word in chosen.edits)}
    made = dict(list(made.items())[-2:]) if chosen.quick else made
    print(f"{len(made)} edits; rawtherapee-cli is {'' if shutil.which('rawtherapee-cli') else 'not '}installed")
    if not made:
        return
    images = dict(list(pictures(chosen.pictures, chosen.side, CHOSEN_ON).items())[: chosen.most])
    print(f"photographs: {', '.join(images)}")
    photographs = [(image * 255).round() / 255 for image in images.values()]
    pairs = {name: [(image, applied(edit, image)) for image in photographs] for name, edit in made.items()}
    methods = list(dict.fromkeys(("look", *chosen.methods)))
    if not chosen.counts:
        report_single(pairs, methods)
    for count in chosen.counts:
        report_several(pairs, methods, count)


if __name__ == "__main__":
    main()
