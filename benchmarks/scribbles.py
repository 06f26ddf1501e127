"""What strokes that stray from their object change, beside clean ones: ``python -m benchmarks.scribbles``.

Recolouring by one natural stroke, a bent line, of which a fifth lies on something else, against the same stroke without
that part. On composites (:mod:`benchmarks.composites`) the covered share of the object and the changed share of the
background are known. On 30 free photographs, seven of scikit-image and the others of Debian's packages, the strokes are
stored in ``scribbles.json`` as lists of points, the last of them on something else, and the result of the clean stroke
is the reference: "covered" is the share of what it changes that is changed, "outside" the share of the rest that is.
FOLDER is that of :mod:`benchmarks.free_photographs`; without it only scikit-image's are measured.

Limit: each mean differs by at most 2 points with and without strays. ``--plain`` counts strays like the rest of a
stroke. ``--out FOLDER`` writes the photographs with stroke, what is ignored of it, and both results. ``--each`` lists
the photographs with their packages. ``--set choosing`` takes the photographs and composites on which the constants
were chosen.
"""

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import mean, median
from unittest import mock

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.composites import FIRST_SEED, RADIUS, SIZE, composites, sources
from benchmarks.free_photographs import edited_photographs
from benchmarks.harness import Figure, options, report, save_picture
from benchmarks.photographs import reduced_to
from benchmarks.recolor import CHANGED, COLOURS, recoloured, tinted
from nlfilter_torch.photo import recolor
from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections.stray import stray_parts

STRAY = 0.2  # of a stroke
LENGTH, BEND, POINTS, TRIES = 0.35, 0.4, 40, 400  # of the strokes on composites; length as a share of the short side
COUNT, FIRST = 25, 20_000  # composites, and what is added to the seeds of their set
SIDE = 240  # short side of photographs
LIMIT = 2.0  # points
IGNORED = torch.tensor((1.0, 0.0, 1.0))  # colour of the parts of strokes that do not count
STORED = Path(__file__).with_suffix(".json")

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Job:
    """A recolouring by one stroke."""

    name: str  # of the picture and what is recoloured
    package: str  # of the picture
    image: Tensor  # (1, 3, H, W)
    colour: Tensor  # of the stroke, (1, 3, 1, 1)
    clean: Tensor  # the stroke without its stray part, (1, 1, H, W)
    whole: Tensor  # with it

    def result(self, mask: Tensor) -> Tensor:
        """The photograph, recoloured by a part of the stroke."""
        return recolor(self.image, (self.colour * mask).expand_as(self.image), mask, brightness=0.0)


def line(points: NDArray[np.float64], size: tuple[int, int], width: int) -> Mask:
    """Draw a line through points (n, 2) of rows and columns, (H, W)."""
    drawn = np.zeros(size, np.uint8)
    cv2.polylines(drawn, [np.round(points[:, ::-1]).astype(np.int32)], False, 1, width)
    return drawn > 0


def as_mask(drawn: Mask) -> Tensor:
    """Convert (H, W) to (1, 1, H, W)."""
    return torch.from_numpy(drawn)[None, None].float()


def leaving(inside: Mask, outside: Mask, random: np.random.Generator) -> NDArray[np.float64]:
    """Points (n, 2) of a bent line that begins inside and of which the last fifth lies outside, as far as possible."""
    size, short = inside.shape, min(inside.shape)
    depth = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    places = np.argwhere(depth >= min(depth.max(), 2 * RADIUS * short))
    cut = round(POINTS * (1 - STRAY))
    best, chosen = -1.0, np.repeat(places[:1].astype(np.float64), POINTS, axis=0)
    for _ in range(TRIES):
        angles = random.uniform(0, 2 * np.pi) + random.normal(0, BEND) * np.linspace(0, 1, POINTS)
        steps = np.stack([np.sin(angles), np.cos(angles)], axis=1) * LENGTH * short / POINTS
        points = places[random.integers(len(places))] + np.cumsum(steps, axis=0)
        if points.min() < 1 or (points >= np.array(size) - 1).any():
            continue
        at = tuple(np.round(points).astype(int).T)
        score = inside[at][: cut - 2].mean() + outside[at][cut + 2 :].mean()
        if score > best:
            best, chosen = score, points
    return chosen


def on_composites(count: int, first: int, images: dict[str, Tensor]) -> Iterator[list[float]]:
    """Covered and outside in percent, by clean strokes and by those with strays, of one composite after the other."""
    for number, composite in enumerate(composites(count, first, images, SIZE)):
        scene = tinted(composite, number)
        alpha = scene.alpha[0, 0].numpy()
        points = leaving(alpha > 0.98, alpha < 0.02, np.random.default_rng(first + number))
        whole = line(points, SIZE, max(1, round(2 * RADIUS * min(SIZE))))
        colour = torch.tensor(COLOURS[number % len(COLOURS)]).view(1, 3, 1, 1)
        job = Job(scene.name, "", scene.image, colour, as_mask(whole & (alpha > 0.5)), as_mask(whole))
        ideal = recoloured(scene, colour, job.clean) - scene.image
        visible = (scene.alpha > 0.98) & (ideal.abs().amax(1, keepdim=True) > CHANGED)
        shares = list[float]()
        for mask in (job.clean, job.whole):
            change = job.result(mask) - scene.image
            along = (change * ideal).sum(1, keepdim=True) / ideal.square().sum(1, keepdim=True).clamp(min=1e-8)
            shares.append(100 * float((along > 0.5)[visible].float().mean()))
            moved = change.abs().amax(1, keepdim=True) > CHANGED
            shares.append(100 * float(moved[scene.alpha < 0.02].float().mean()))
        yield shares


def jobs(kind: str, folder: Path | None = None) -> Iterator[Job]:
    """The recolourings that are stored for photographs of a set, of which a folder holds those of Debian's packages."""
    for entry in json.loads(STORED.read_text(encoding="utf-8")):
        edited = edited_photographs()[entry["photograph"]]
        if edited.set != kind or (folder is None and not edited.is_shipped):
            continue
        image = reduced_to(edited.pixels(folder), SIDE)
        size = (image.shape[-2], image.shape[-1])
        points = np.array(entry["points"], dtype=np.float64)[:, ::-1] * size  # of columns and rows, from 0 to 1
        width = max(1, round(2 * RADIUS * min(size)))
        clean = line(points[: -entry["stray"]], size, width)
        whole = line(points, size, width)
        colour = torch.tensor(entry["colour"]).view(1, 3, 1, 1)
        name = f"{edited.name}: {entry['what']}"
        yield Job(name, edited.package, image, colour, as_mask(clean), as_mask(whole))


def on_photograph(job: Job, out: Path | None) -> list[float]:
    """Covered and outside in percent, by a stroke with strays against a clean one."""
    results = [job.result(mask) for mask in (job.clean, job.whole)]
    if out is not None:
        seen = torch.lerp(job.image, job.colour.expand_as(job.image), job.whole)
        seen = torch.where(stray_parts(InMemory(job.image), job.whole) > 0, IGNORED.view(1, 3, 1, 1), seen)
        name = job.name.replace(": ", "-").replace(" ", "-")
        save_picture(out / f"{name}.png", torch.cat([seen, *results], dim=3))
    before, after = ((result - job.image).abs().amax(1, keepdim=True) > 5 * CHANGED for result in results)
    return [100 * float(after[before].float().mean()), 100 * float(after[~before].float().mean())]


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table, and return 1 if a figure falls short of its limit."""
    parser = options("scribbles", __doc__, "one composite and photograph")
    add = parser.add_argument
    add("--set", choices=tuple(FIRST_SEED), default="reporting", help="of photographs and composites")
    add("--plain", action="store_true", help="strays count like the rest of a stroke")
    add("--photographs", type=Path, help="folder of free photographs of Debian's packages")
    add("--each", action="store_true", help="list the photographs")
    add("--out", type=Path, help="folder for pictures")
    chosen = parser.parse_args(arguments)
    with ExitStack() as stack:
        for module in ("selections.painted", "selections.mask") if chosen.plain else ():
            stack.enter_context(
                mock.patch(f"nlfilter_torch.photo.{module}.without_strays", lambda drawn, _, **__: drawn)
            )
        first = FIRST_SEED[chosen.set] + FIRST
        number = 1 if chosen.quick else COUNT
        rows = list(on_composites(number, first, sources(None, chosen.set)))
        covered, outside, covered_stray, outside_stray = (mean(column) for column in zip(*rows, strict=True))
        shares = list[list[float]]()
        for job in islice(jobs(chosen.set, chosen.photographs), 1 if chosen.quick else None):
            shares.append(on_photograph(job, chosen.out))
            if chosen.each:
                print(f"{job.name:60}{job.package:18}covered{shares[-1][0]:6.1f} %   outside{shares[-1][1]:6.1f} %")
    figures = [
        Figure("composites: covered by clean strokes", covered, unit="%"),
        Figure("composites: outside of clean strokes", outside, unit="%"),
        Figure("composites: less covered with strays", covered - covered_stray, LIMIT, "points"),
        Figure("composites: more outside with strays", outside_stray - outside, LIMIT, "points"),
        Figure("photographs: not covered with strays, mean", 100 - mean(row[0] for row in shares), LIMIT, "points"),
        Figure("photographs: outside with strays, mean", mean(row[1] for row in shares), LIMIT, "points"),
        Figure("photographs: outside with strays, median", median(row[1] for row in shares), unit="points"),
        Figure("photographs: outside with strays, worst", max(row[1] for row in shares), unit="points"),
        Figure("photographs: strokes", len(shares)),
    ]
    return report(figures, quick=chosen.quick)


if __name__ == "__main__":
    sys.exit(main())
