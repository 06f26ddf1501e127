"""How near colours from a few strokes are to the true ones, beside optimisation: ``python -m benchmarks.colorize``.

Grey versions of photographs are colourised from 6, 20 and 60 random 5x5 strokes of their true chroma, with three seeds
each. Prints the PSNR of the RGB result against the photograph, and CPU time, for the regression mixed with values of
neighbours (the default), the paper's k-means method, and Levin's optimisation (:mod:`benchmarks.levin`). All keep the
luminance and use the same gamut mapping. Parameters were chosen on :data:`CHOOSING` and on other photographs; results
are reported on :data:`REPORTING`, or on every photograph of a folder, with strokes of other seeds. With ``--lines`` the
strokes are lines of one colour each, which end where the photograph's colour changes, as people draw them.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.denoising.cases import psnr
from benchmarks.harness import options, save_picture
from benchmarks.levin import propagate
from benchmarks.photographs import photograph, pictures
from nlfilter_torch.photo import colorize
from nlfilter_torch.photo.picture.colour import merge_luminance, split_luminance, with_green

CHOOSING = ("astronaut", "chelsea", "coffee", "motorcycle", "rocket")
REPORTING = ("retina", "immunohistochemistry", "hubble_deep_field")  # three crops of each
SIDE, SHAPE = 160, (160, 240)  # pixels of the short side, and of crops
COUNTS = (6, 20, 60)
SEEDS = 3
CHOSEN_BY = "0 to 404, 20000 to 20003, 50000 to 137001 and 500000 to 723003"
BRUSH = 5
LENGTHS, WIDTH = (0.1, 0.3), 3  # of lines: shortest and longest, relative to the short side, and width in pixels
SAME_COLOUR = 0.07  # change of chroma at which a line ends
WON, AHEAD, WORST, TIME = 0.85, 0.8, -0.4, 1.5  # share won, median and worst lead in dB, relative time

GREY = 45  # dB; a photograph whose luminance has a higher PSNR counts as grey

Method = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Case:
    """Results of all methods for one photograph with one set of strokes."""

    name: str
    count: int
    seed: int
    results: dict[str, tuple[float, float]]  # PSNR in dB, and seconds of CPU time, by method

    @property
    def lead(self) -> float:
        """PSNR of the default minus that of Levin, in dB."""
        return self.results["default"][0] - self.results["Levin"][0]


def random_strokes(count: int, seed: int, size: tuple[int, int]) -> Tensor:
    """A mask (1, 1, H, W) of ``count`` squares."""
    generator = torch.Generator().manual_seed(seed)
    tops = torch.randint(0, size[0] - BRUSH + 1, (count,), generator=generator).tolist()
    lefts = torch.randint(0, size[1] - BRUSH + 1, (count,), generator=generator).tolist()
    mask = torch.zeros(1, 1, *size)
    for top, left in zip(tops, lefts, strict=True):
        mask[..., top : top + BRUSH, left : left + BRUSH] = 1
    return mask


def random_lines(image: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Strokes (1, 3, H, W) along ``count`` random lines, each of the mean colour of its pixels, and their mask."""
    generator = np.random.default_rng(seed)
    height, width = image.shape[2:]
    chroma, mask, strokes = split_luminance(image)[1][0], torch.zeros(1, 1, height, width), torch.zeros_like(image)
    for _ in range(count):
        start = generator.integers((0, 0), (height, width))
        angle, length = generator.uniform(0, 2 * np.pi), height * generator.uniform(*LENGTHS)
        steps = np.arange(max(1, round(length)))[:, None] * (np.sin(angle), np.cos(angle))
        rows, columns = torch.from_numpy(np.rint(start + steps)).long().unbind(1)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        rows, columns = rows[inside], columns[inside]
        change = (chroma[:, rows, columns] - chroma[:, rows[:1], columns[:1]]).norm(dim=0)
        before = (change > SAME_COLOUR).cumsum(0) == 0
        line = torch.zeros(1, 1, height, width)
        line[..., rows[before], columns[before]] = 1
        line = torch.nn.functional.max_pool2d(line, WIDTH, 1, WIDTH // 2) * (1 - mask)
        colour = (image * line).sum((2, 3), keepdim=True) / line.sum().clamp(min=1)
        mask, strokes = mask + line, strokes + colour * line
    return strokes, mask


def levin(grey: Tensor, strokes: Tensor, mask: Tensor) -> Tensor:
    """Levin's optimisation with the library's gamut mapping."""
    chroma = split_luminance(strokes)[1][0].double()
    result = propagate(grey[0, 0].double().numpy(), chroma[[0, 2]].numpy(), mask[0, 0].numpy() > 0)
    return merge_luminance(grey, with_green(torch.from_numpy(result).float()[None]))


METHODS: dict[str, Method] = {
    "default": colorize,
    "k-means": lambda grey, strokes, mask: colorize(grey, strokes, mask, method="kmeans"),
    "Levin": levin,
}


def crops(names: tuple[str, ...], shape: tuple[int, int]) -> dict[str, Tensor]:
    """Upper left, middle and lower right crops of photographs, each of half their height and width."""
    images = {}
    for name in names:
        picture = photograph(name)
        height, width = picture.shape[2] // 2, picture.shape[3] // 2
        for number in range(3):
            top, left = number * height // 2, number * width // 2
            part = picture[:, :, top : top + height, left : left + width]
            scale = min(height / shape[0], width / shape[1])
            cut = part[:, :, : round(shape[0] * scale), : round(shape[1] * scale)]
            reduced = torch.nn.functional.interpolate(cut, shape, mode="bicubic", antialias=True).clamp(0, 1)
            images[f"{name[:10]} {number + 1}"] = reduced
    return images


def measure(name: str, image: Tensor, count: int, seed: int, lines: bool, save: Path | None) -> Case:
    """Run every method on one photograph with one set of strokes; save the results side by side."""
    grey = split_luminance(image)[0]
    if lines:
        strokes, mask = random_lines(image, count, seed)
    else:
        mask = random_strokes(count, seed, (image.shape[2], image.shape[3]))
        strokes = image * mask
    results, shown = {}, [torch.where(mask > 0, strokes, grey)]
    for method, function in METHODS.items():
        start = time.process_time()
        colorized = function(grey, strokes, mask)
        results[method] = (psnr(colorized, image), time.process_time() - start)
        shown.append(colorized)
    if save is not None:
        panels = [panel.expand_as(image) for panel in (*shown, image)]
        save_picture(save / f"{name}-{count}-{seed}.png", torch.cat(panels, dim=3))
    return Case(name, count, seed, results)


def report(cases: list[Case]) -> bool:
    """Print wins, leads, times and lost comparisons; return whether the claim holds."""
    leads = [case.lead for case in cases]
    seconds = {method: statistics.median(case.results[method][1] for case in cases) for method in METHODS}
    over_pieces = [case.results["default"][0] - case.results["k-means"][0] for case in cases]
    won, median = sum(lead > 0 for lead in leads) / len(leads), statistics.median(leads)
    ratio = seconds["default"] / seconds["Levin"]
    print("median CPU time " + ", ".join(f"{method} {value:.3f} s" for method, value in seconds.items()))
    print(
        f"beats Levin in {won:.0%} of {len(cases)} cases, by {median:.2f} dB in the median ({min(leads):.2f} to "
        f"{max(leads):.2f}), in {ratio:.2f} of its time; beats k-means in "
        f"{sum(lead > 0 for lead in over_pieces) / len(cases):.0%}, by {statistics.median(over_pieces):.2f} dB"
    )
    lost = sorted((case for case in cases if case.lead <= 0), key=lambda case: case.lead)
    print(f"\nlost against Levin: {len(lost)} of {len(cases)}")
    for case in lost:
        values = "".join(f"{case.results[method][0]:12.2f}" for method in METHODS)
        print(f"{case.name:24}{case.count:4d} strokes, seed {case.seed:<6}{values}{case.lead:8.2f}")
    return won >= WON and median >= AHEAD and min(leads) >= WORST and ratio <= TIME


def main(arguments: list[str] | None = None) -> None:
    """Print the tables and the claim."""
    parser = options("colorize", __doc__, "one seed at 40x60")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of photographs; default: those of scikit-image")
    add("--set", choices=("reporting", "choosing"), default="reporting", help="set of scikit-image's photographs")
    add("--side", type=int, default=SIDE, help="short side in pixels of photographs of a folder")
    add("--first-seed", type=int, default=1000, help=f"of the strokes; {CHOSEN_BY} were used to choose parameters")
    add("--lines", action="store_true", help="lines of one colour in place of squares of true colours")
    add("--seeds", type=int, default=SEEDS, help="sets of strokes for each number of strokes")
    add("--save", type=Path, help="folder for pictures of the scribbles, all results and the photograph, side by side")
    chosen = parser.parse_args(arguments)
    shape = (40, 60) if chosen.quick else SHAPE
    seeds = range(chosen.first_seed, chosen.first_seed + (1 if chosen.quick else chosen.seeds))
    if chosen.pictures is not None:
        images = pictures(chosen.pictures, shape[0] if chosen.quick else chosen.side, ())
    elif chosen.set == "choosing":
        images = {name: photograph(name, *shape) for name in CHOOSING}
    else:
        images = crops(REPORTING, shape)
    for function in METHODS.values():  # the first call imports
        function(photograph("coffee", 16, 24)[:, :1], photograph("coffee", 16, 24), torch.ones(1, 1, 16, 24))

    kind = "lines" if chosen.lines else "5x5 strokes"
    print(f"PSNR in dB of coloured photographs, mean of {len(seeds)} sets of {kind}")
    print(f"{'photograph':24}{'strokes':>8}" + "".join(f"{method:>12}" for method in METHODS))
    cases: list[Case] = []
    for name, image in images.items():
        if psnr(split_luminance(image)[0], image) > GREY:
            print(f"{name:24} is left out: it is grey")
            continue
        for count in COUNTS:
            group = [measure(name, image, count, seed, chosen.lines, chosen.save) for seed in seeds]
            means = [statistics.mean(case.results[method][0] for case in group) for method in METHODS]
            print(f"{name:24}{count:8d}" + "".join(f"{value:12.2f}" for value in means), flush=True)
            cases += group
    holds = report(cases)
    if not chosen.quick:
        claim = f"at least {WON:.0%}, {AHEAD} dB, none below {WORST} dB, {TIME} times the time"
        print(f"\n{claim}: {'holds' if holds else 'FALLS SHORT'}")


if __name__ == "__main__":
    main()
