"""How well selections follow outlines of objects drawn by hand on photographs: ``python -m benchmarks.outlines``.

The outlines are polygons whose points are fractions of width and height, with holes; they and all strokes were drawn
without looking at results. Parts that may or may not be meant, such as the orange tips of red legs or a shadow that
hides feet, are "either" and do not count. There are six sets:

- "choosing" and "reporting": the outlines of ``outlines.json`` are of objects in :mod:`benchmarks.keepers`. Each is
  selected from the strokes of its job, with the settings of its edit; that of ``recolor`` before hues are compared.
  Those of the choosing set may guide changes of masks.
- "short" and "generous": ``selections.json`` has objects of 25 other photographs of the reporting set, each with about
  four short strokes inside and four outside, and with longer ones that visit its main parts and go around it.
- "random": the same objects with four random short strokes on each side, away from the outline where there is room.
- "training": likewise, 89 objects on photographs of the training set (``training/outlines.json``), to choose and train
  on. Most of their borders were refined by GrabCut, so they are not meant for comparisons with it.

"IoU" is the intersection over union of the pixels above 0.5 and the object, "missed" the share of the object that is
not selected, and "outside" what is selected beside it, as a share of the object; pixels within 1 % of the short side of
an outline do not count. Further columns are the IoU of the same with a rectangle that has a margin of 2 % around the
object, from the strokes inside alone, and from these with the rectangle.

``--pictures`` is the folder of :mod:`benchmarks.free_photographs`; without it only scikit-image's
photographs are measured. ``--peers`` adds GrabCut, from the same strokes where there are some outside, and with the
rectangle, and closed-form matting with the rectangle on at most 240 pixels of short side, as it takes long. ``--out
FOLDER`` writes the photographs with what is selected, missed in red and beside the object in blue.
``--stability`` draws 40 sets of such random strokes on each object of a set and computes a mask from each. "Alike" is
the share of masks whose IoU with what most of the 40 select is at least 0.93, "IoU" the mean with the outline, and
"moved" the share of those that change at most 5 % of the object's area when one stroke inside moves by its width.
"""

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.composites import RADIUS as STROKE_RADIUS
from benchmarks.composites import draw_strokes
from benchmarks.free_photographs import edited_photographs
from benchmarks.harness import options, row, save_picture
from benchmarks.keepers import SIDE, Job, jobs, mask_of
from benchmarks.mask_peers import PEERS
from benchmarks.photographs import reduced_to
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.declared.strokes import Mark
from nlfilter_torch.photo.edits.applying import edit_of, scribbles_of
from nlfilter_torch.photo.picture.boxes import Box
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import edit_image
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.selections.mask import ObjectEdit

STORED = Path(__file__).with_suffix(".json")
SELECTIONS = Path(__file__).with_name("selections.json")
TRAINING = Path(__file__).parent / "training" / "outlines.json"
SETS = "choosing", "reporting", "short", "generous", "random", "training"
RANDOM_STROKES = 4  # on each side of an outline
SETS_OF_STROKES, ALIKE, MOST_MOVED = 40, 0.93, 0.05  # for stability: their number, least IoU, and largest change
RADIUS = 0.01  # of the strokes of selections.json, as a share of the short side
BAND = 0.01  # on either side of an outline, as a share of the short side
MARGIN = 0.02  # between an object and the rectangle around it, as a share of the short side
OURS, BOXED, INNER, INNER_BOXED = "ours", "rectangle", "inside", "ins., rect."
PEER_SIDE, QUICK_SIDE = 240, 64  # of photographs for closed-form matting, and with --quick
MISSED, BESIDE = (1.0, 0.1, 0.1), (0.1, 0.3, 1.0)

Mask = NDArray[np.bool_]
Polygon = Sequence[tuple[float, float]]
Polygons = tuple[Polygon, ...]


@dataclass(frozen=True)
class Outline:
    """The outline of the object of a job: polygons of (x, y) as fractions of width and height."""

    job: Job
    outlines: Polygons  # the object is their union
    holes: Polygons = ()  # not part of it
    either: Polygons = ()  # parts that do not count
    set: str = ""  # one of SETS
    seed: int | None = None  # of random strokes, in place of those of the job

    def object(self, size: tuple[int, int]) -> Mask:
        """The object in a picture (H, W)."""
        return filled(self.outlines, size) & ~filled(self.holes, size)

    def box(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """The rectangle around the object in a picture (H, W): left, top, right and bottom in pixels."""
        margin = round(MARGIN * min(size))
        rows, columns = (np.flatnonzero(self.object(size).any(axis)) for axis in (1, 0))
        left, top = (max(0, int(places[0]) - margin) for places in (columns, rows))
        right, bottom = (
            min(most, int(places[-1]) + 1 + margin) for places, most in ((columns, size[1]), (rows, size[0]))
        )
        return left, top, right, bottom

    def sides(self, size: tuple[int, int]) -> tuple[Mask, Mask]:
        """What counts of the object and of its surroundings in a picture (H, W): not near the outline."""
        wanted, either = self.object(size), filled(self.either, size)
        radius = max(1, round(BAND * min(size)))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        inside, outside = ((cv2.erode(side.astype(np.uint8), disc) > 0) & ~either for side in (wanted, ~wanted))
        return inside, outside

    def scribbles(self, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
        """Masks (1, 1, H, W) of strokes on the object and, if there are any, on its background."""
        if self.seed is None:
            return separated(self.job.strokes, size)
        random = np.random.default_rng(self.seed)
        inside, outside = (draw_strokes(side, RANDOM_STROKES, random) for side in self.sides(size))
        return inside, outside


def filled(polygons: Sequence[Polygon], size: tuple[int, int]) -> Mask:
    """The union of polygons in a picture (H, W)."""
    plane = np.zeros(size, np.uint8)
    for polygon in polygons:
        points = np.array(polygon) * size[::-1] - 0.5
        cv2.fillPoly(plane, [np.round(points).astype(np.int32)], 1)
    return plane > 0


@dataclass(frozen=True)
class Score:
    """Intersection over union, and the missed and the outside share of an object."""

    overlap: float
    missed: float
    outside: float


def outlines() -> list[Outline]:
    """The outlines that are stored; those with strokes of their own once with the short and once with the generous."""
    by_name = {(job.photograph, job.what): job for job in jobs()}
    stored = list[Outline]()
    for entry in json.loads(STORED.read_text(encoding="utf-8")):
        job = by_name[entry["photograph"], entry["what"]]
        stored.append(Outline(job, *_polygons(entry), job.set))
    for kind in SETS[2:]:
        file = TRAINING if kind == "training" else SELECTIONS
        for number, entry in enumerate(json.loads(file.read_text(encoding="utf-8")), 1):
            drawn = [{"radius": RADIUS} | stroke for stroke in entry.get("strokes", {}).get(kind, ())]
            named = {name: entry[name] for name in ("photograph", "what")}
            job = Job.of(number, named | {"edit": "mask", "strokes": drawn})
            stored.append(Outline(job, *_polygons(entry), kind, None if drawn else number))
    return stored


def _polygons(entry: dict[str, Any]) -> tuple[Polygons, Polygons, Polygons]:
    return tuple(entry["outlines"]), tuple(entry.get("holes", ())), tuple(entry.get("either", ()))


def score(selected: Mask, sides: tuple[Mask, Mask]) -> Score:
    """Score a selection (H, W) by :meth:`Outline.sides`."""
    inside, outside = sides
    covered, total, beside = (
        (side & part).sum() for side, part in ((inside, selected), (inside, inside), (outside, selected))
    )
    return Score(float(covered / (total + beside)), float(1 - covered / total), float(beside / total))


def selected(outline: Outline, image: Tensor, box: Box | None = None, *, alone: bool = False) -> Tensor:
    """The mask (1, 1, H, W) that the edit of a job uses; that of ``recolor`` before it is corrected by hue.

    With ``alone``, strokes on the background are left out.
    """
    size, job = (image.shape[-2], image.shape[-1]), outline.job
    if job.edit == "mask":
        inside, background = outline.scribbles(size)
        return region_mask(image, inside, None if alone else background, box=box)
    (step,) = job.recipe.steps
    if alone:
        step = step.changed(strokes=tuple(stroke for stroke in job.strokes if stroke.role != "background"))
    edit = edit_of(step, size)
    selection = edit.selection_in(size) if isinstance(edit, ObjectEdit) else edit.selection()
    assert selection is not None, job.name
    marks = edit.marks(scribbles_of(step, size, TensorPainter())).masks
    # The last plane of what has colours is its mask.
    return edit_image(selection, image, Drawn({name: mask[:, -1:] for name, mask in marks.items()}, box=box))


def separated(strokes: Sequence[Mark], size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
    """Masks (1, 1, H, W) of the strokes on the object and, if there are any, on its background."""
    sides = [[stroke for stroke in strokes if (stroke.role == "background") == opposed] for opposed in (False, True)]
    inside, background = (mask_of(side, size) for side in sides)
    return inside, background * (1 - inside) if sides[1] else None


def by_peer(name: str, outline: Outline, image: Tensor, box: Box | None = None) -> Tensor:
    """The mask (1, 1, H, W) of another method, for which a rectangle around the object adds to its background."""
    inside, background = outline.scribbles((image.shape[-2], image.shape[-1]))
    outside = torch.zeros_like(inside) if background is None else background
    if box is not None:
        left, top, right, bottom = box
        beyond = torch.ones_like(inside)
        beyond[..., top:bottom, left:right] = 0
        outside = torch.maximum(outside, beyond * (1 - inside))
    if not bool(outside.any()):  # the object reaches all borders
        outside[..., 0, :] = 1 - inside[..., 0, :]
    return PEERS[name](image, inside, outside)


def methods(outline: Outline, image: Tensor, *, peers: bool) -> dict[str, Tensor]:
    """Masks (1, 1, H, W) of an object by what is told of it and, if asked for, by other methods, by their names."""
    size = (image.shape[-2], image.shape[-1])
    box, opposed = outline.box(size), outline.scribbles(size)[1] is not None
    masks = {OURS: selected(outline, image), BOXED: selected(outline, image, box)}
    if opposed:
        masks |= {INNER: selected(outline, image, alone=True), INNER_BOXED: selected(outline, image, box, alone=True)}
    if peers:
        small = reduced_to(image, PEER_SIDE)
        matted = by_peer("closed form", outline, small, outline.box((small.shape[-2], small.shape[-1])))
        if opposed:
            masks["GrabCut"] = by_peer("GrabCut", outline, image)
        masks["GrabCut, r."] = by_peer("GrabCut", outline, image, box)
        masks["matting, r."] = resize(matted, (image.shape[-2], image.shape[-1]))
    return masks


def overlay(image: Tensor, mask: Mask, wanted: Mask) -> Tensor:
    """A photograph (1, 3, H, W) with what is missed, and with what is selected beside the object."""
    shown = image * (0.35 + 0.65 * torch.from_numpy(mask | wanted)[None, None])
    for colour, where in ((MISSED, wanted & ~mask), (BESIDE, mask & ~wanted)):
        tint = torch.tensor(colour).view(1, 3, 1, 1)
        shown = torch.where(torch.from_numpy(where), 0.5 * shown + 0.5 * tint, shown)
    return shown


def measure(outline: Outline, image: Tensor, out: Path | None = None, *, peers: bool = False) -> dict[str, Score]:
    """Scores of the masks of an object, by the names of :func:`methods`."""
    size = (image.shape[-2], image.shape[-1])
    masks = {name: mask[0, 0].numpy() > 0.5 for name, mask in methods(outline, image, peers=peers).items()}
    if out is not None:
        save_picture(out / f"{outline.job.name}-{outline.set}.png", overlay(image, masks[OURS], outline.object(size)))
    return {name: score(mask, outline.sides(size)) for name, mask in masks.items()}


def means(rows: Sequence[dict[str, Score]]) -> dict[str, Score]:
    """Mean scores of the methods that all objects have."""
    shared = [name for name in rows[0] if all(name in row for row in rows)]
    return {
        name: Score(*(mean(getattr(row[name], part) for row in rows) for part in ("overlap", "missed", "outside")))
        for name in shared
    }


def line(name: str, scores: dict[str, Score], columns: Sequence[str]) -> str:
    """A line of the table: IoU, missed and outside of ours, and the IoU of the others."""
    ours = scores[OURS]
    figures = (f"{scores[column].overlap:12.3f}" if column in scores else f"{'-':>12}" for column in columns[1:])
    return f"{name:44}{ours.overlap:8.3f}{ours.missed:8.1%}{ours.outside:9.1%}" + "".join(figures)


@dataclass(frozen=True)
class Stability:
    """How little the masks of an object depend on its strokes.

    Attributes:
        alike: share of the masks from random strokes that are :data:`ALIKE` with what most of them select.
        overlap: mean IoU with the outline.
        moved: share of moved strokes that change at most :data:`MOST_MOVED` of the object's area.
    """

    alike: float
    overlap: float
    moved: float


def stability(outline: Outline, image: Tensor, count: int) -> Stability:
    """Compare masks from so many sets of random strokes, and from the same when one stroke on the object has moved."""
    size = (image.shape[-2], image.shape[-1])
    sides, area = outline.sides(size), outline.object(size).sum()
    masks, changes = [], []
    for seed in range(count):
        inside, background = replace(outline, seed=seed).scribbles(size)
        mask, moved = (
            region_mask(image, strokes, background)[0, 0].numpy() > 0.5
            for strokes in (inside, with_one_moved(inside, sides[0], seed))
        )
        masks.append(mask)
        changes.append((mask ^ moved).sum() / area)
    common = np.mean(masks, axis=0) > 0.5
    alike = [(mask & common).sum() / max((mask | common).sum(), 1) >= ALIKE for mask in masks]
    return Stability(
        float(np.mean(alike)),
        mean(score(mask, sides).overlap for mask in masks),
        float(np.mean(np.array(changes) <= MOST_MOVED)),
    )


def report_stability(listed: Iterable[tuple[Outline, Tensor]], count: int) -> None:
    """Print the stability of each object, and means."""
    print(row("", ["alike", "IoU", "moved"], 9, 44))
    found = []
    for outline, image in listed:
        found.append(stability(outline, image, count))
        print(row(f"{outline.job.name}: {outline.job.what}"[:43], _cells(found[-1]), 9, 44), flush=True)
    if found:
        mean_of = Stability(*(mean(getattr(one, part) for one in found) for part in ("alike", "overlap", "moved")))
        print(row(f"mean of {len(found)}", _cells(mean_of), 9, 44))


def _cells(found: Stability) -> list[str]:
    return [f"{found.alike:.0%}", f"{found.overlap:.3f}", f"{found.moved:.0%}"]


def with_one_moved(strokes: Tensor, allowed: Mask, number: int) -> Tensor:
    """Random strokes (1, 1, H, W), one of which is moved by its width along an axis, as far as that is allowed."""
    plane = strokes[0, 0].numpy()
    count, labels = cv2.connectedComponents((plane > 0).astype(np.uint8))
    own = labels == 1 + number % (count - 1)
    width = max(1, round(2 * STROKE_RADIUS * min(plane.shape)))
    steps = ((0, width), (width, 0), (0, -width), (-width, 0))
    shifted = [np.roll(own, step, (0, 1)) & allowed for step in steps]
    most = max(shifted, key=lambda moved: int(moved.sum()))
    return torch.from_numpy(np.where(own, 0, plane) + (most & (labels * ~own == 0)))[None, None].float()


def main(arguments: list[str] | None = None) -> int:
    """Measure and print a table, with the means of each set."""
    parser = options("outlines", __doc__, "one small photograph")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of free photographs; default: only scikit-image's")
    add("--set", choices=SETS, help="measure this set only")
    add("--peers", action="store_true", help="compare with other methods")
    add("--out", type=Path, help="folder for pictures")
    add("--stability", action="store_true", help="compare masks from many random strokes")
    add("--every", type=int, default=1, help="measure every n-th object of each set")
    chosen = parser.parse_args(arguments)
    listed = [outline for outline in outlines() if chosen.set in (None, outline.set)][:: chosen.every]
    if chosen.pictures is None:
        listed = [outline for outline in listed if edited_photographs()[outline.job.photograph].is_shipped]
    listed = listed[:1] if chosen.quick else listed
    seen = (reduced_to(outline.job.before(chosen.pictures), QUICK_SIDE if chosen.quick else SIDE) for outline in listed)
    if chosen.stability:
        report_stability(zip(listed, seen, strict=True), 2 if chosen.quick else SETS_OF_STROKES)
        return 0
    columns = [OURS, BOXED, INNER, INNER_BOXED] + (["GrabCut", "GrabCut, r.", "matting, r."] if chosen.peers else [])
    print(f"{'':44}     IoU  missed  outside" + "".join(f"{column:>12}" for column in columns[1:]))
    rows: dict[str, list[dict[str, Score]]] = {}
    for outline, image in zip(listed, seen, strict=True):
        scores = measure(outline, image, chosen.out, peers=chosen.peers)
        rows.setdefault(outline.set, []).append(scores)
        print(line(f"{outline.job.name}: {outline.job.what}"[:43], scores, columns), flush=True)
    for name, own in rows.items():
        print(line(f"mean of {len(own)}, {name}", means(own), columns))
    return 0


if __name__ == "__main__":
    sys.exit(main())
