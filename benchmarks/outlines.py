"""How well selections follow outlines of objects drawn by hand on photographs: ``python -m benchmarks.outlines``.

The outlines of ``outlines.json`` are of objects in :mod:`benchmarks.keepers`, as polygons whose points are fractions of
width and height, with holes; they were drawn without looking at results. Parts that may or may not be meant, such as
the orange tips of red legs or a shadow that hides feet, are "either" and do not count. The mask of each job is computed
from its strokes, with the settings of its edit; that of ``recolor`` is the one before hues are compared. "IoU" is the
intersection over union of the pixels above 0.5 and the object, "missed" the share of the object that is not selected,
and "outside" what is selected beside it, as a share of the object; pixels within 1 % of the short side of an outline do
not count.

``--pictures`` is the folder of :mod:`benchmarks.free_photographs`; without it only scikit-image's
photographs are measured. ``--peers`` adds GrabCut and closed-form matting, with the same strokes and, as they cannot do
without a background, everything outside a rectangle around the object. Those see photographs of at most 240 pixels of
short side, as closed-form matting takes long. ``--out FOLDER`` writes the photographs with what is selected, missed in
red and beside the object in blue. The outlines of the choosing set may guide changes of masks.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.free_photographs import edited_photographs
from benchmarks.harness import options, save_picture
from benchmarks.keepers import Job, jobs, mask_of
from benchmarks.mask_peers import PEERS
from benchmarks.photographs import reduced_to
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.edits.applying import edit_of, scribbles_of
from nlfilter_torch.photo.picture.drawn import Drawn
from nlfilter_torch.photo.picture.in_memory import edit_image
from nlfilter_torch.photo.picture.painting import TensorPainter
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.selections.mask import ObjectEdit

STORED = Path(__file__).with_suffix(".json")
OURS = "ours"
BAND = 0.01  # on either side of an outline, as a share of the short side
MARGIN = 0.05  # between an object and the rectangle around it, as a share of the short side
COMPARED = ("GrabCut", "closed form")
PEER_SIDE, QUICK_SIDE = 240, 64
MISSED, BESIDE = (1.0, 0.1, 0.1), (0.1, 0.3, 1.0)

Mask = NDArray[np.bool_]
Polygon = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Outline:
    """The outline of the object of a job: polygons of (x, y) as fractions of width and height."""

    job: Job
    outlines: tuple[Polygon, ...]  # the object is their union
    holes: tuple[Polygon, ...] = ()  # not part of it
    either: tuple[Polygon, ...] = ()  # parts that do not count

    def object(self, size: tuple[int, int]) -> Mask:
        """The object in a picture (H, W)."""
        return filled(self.outlines, size) & ~filled(self.holes, size)


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


def outlines(file: Path = STORED) -> list[Outline]:
    """The outlines that are stored."""
    by_name = {(job.photograph, job.what): job for job in jobs()}
    return [
        Outline(
            by_name[entry["photograph"], entry["what"]],
            *(tuple(entry.get(name, ())) for name in ("outlines", "holes", "either")),
        )
        for entry in json.loads(file.read_text(encoding="utf-8"))
    ]


def score(selected: Mask, wanted: Mask, either: Mask | None = None) -> Score:
    """Score a selection (H, W) of an object, without the band around its outline and parts that do not count."""
    radius = max(1, round(BAND * min(wanted.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    inside, outside = (cv2.erode(side.astype(np.uint8), disc) > 0 for side in (wanted, ~wanted))
    if either is not None:
        inside, outside = inside & ~either, outside & ~either
    covered, total, beside = (
        (side & part).sum() for side, part in ((inside, selected), (inside, inside), (outside, selected))
    )
    return Score(float(covered / (total + beside)), float(1 - covered / total), float(beside / total))


def selected(job: Job, image: Tensor) -> Tensor:
    """The mask (1, 1, H, W) that the edit of a job uses; that of ``recolor`` before it is corrected by hue."""
    size = (image.shape[-2], image.shape[-1])
    if job.edit == "mask":
        return region_mask(image, *_strokes(job, size))
    (step,) = job.recipe.steps
    edit = edit_of(step, size)
    selection = edit.selection_in(size) if isinstance(edit, ObjectEdit) else edit.selection()
    assert selection is not None, job.name
    marks = edit.marks(scribbles_of(step, size, TensorPainter())).masks
    # The last plane of what has colours is its mask.
    return edit_image(selection, image, Drawn({name: mask[:, -1:] for name, mask in marks.items()}))


def _strokes(job: Job, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
    """Masks (1, 1, H, W) of the strokes on the object and, if there are any, on its background."""
    sides = [
        [stroke for stroke in job.strokes if (stroke.role == "background") == opposed] for opposed in (False, True)
    ]
    inside, background = (mask_of(strokes, size) for strokes in sides)
    return inside, background * (1 - inside) if sides[1] else None


def by_peer(name: str, outline: Outline, image: Tensor) -> Tensor:
    """The mask (1, 1, H, W) of another method, which is told a rectangle around the object."""
    small = reduced_to(image, PEER_SIDE)
    size = (small.shape[-2], small.shape[-1])
    inside, background = _strokes(outline.job, size)
    margin = round(MARGIN * min(size))
    rows, columns = (np.flatnonzero(outline.object(size).any(axis)) for axis in (1, 0))
    beyond = torch.ones_like(inside)
    beyond[
        ..., max(0, rows[0] - margin) : rows[-1] + margin + 1, max(0, columns[0] - margin) : columns[-1] + margin + 1
    ] = 0
    beyond = (beyond if background is None else torch.maximum(beyond, background)) * (1 - inside)
    if not bool(beyond.any()):
        beyond[..., 0, :] = 1 - inside[..., 0, :]
    return resize(PEERS[name](small, inside, beyond), (image.shape[-2], image.shape[-1]))


def overlay(image: Tensor, mask: Mask, wanted: Mask) -> Tensor:
    """A photograph (1, 3, H, W) with what is missed, and with what is selected beside the object."""
    shown = image * (0.35 + 0.65 * torch.from_numpy(mask | wanted)[None, None])
    for colour, where in ((MISSED, wanted & ~mask), (BESIDE, mask & ~wanted)):
        tint = torch.tensor(colour).view(1, 3, 1, 1)
        shown = torch.where(torch.from_numpy(where), 0.5 * shown + 0.5 * tint, shown)
    return shown


def measure(outline: Outline, image: Tensor, peers: Sequence[str], out: Path | None) -> dict[str, Score]:
    """Scores of the methods, by name."""
    size = (image.shape[-2], image.shape[-1])
    wanted, either = outline.object(size), filled(outline.either, size)
    masks = {OURS: selected(outline.job, image)} | {name: by_peer(name, outline, image) for name in peers}
    if out is not None:
        save_picture(out / f"{outline.job.name}.png", overlay(image, masks[OURS][0, 0].numpy() > 0.5, wanted))
    return {name: score(mask[0, 0].numpy() > 0.5, wanted, either) for name, mask in masks.items()}


def line(name: str, scores: dict[str, Score]) -> str:
    """A line of the table: IoU, missed and outside of each method."""
    figures = (f"{score.overlap:8.3f}{score.missed:8.1%}{score.outside:9.1%}" for score in scores.values())
    return f"{name:44}" + "  ".join(figures)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print a table."""
    parser = options("outlines", __doc__, "one small photograph")
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of free photographs; default: only scikit-image's")
    add("--set", choices=("choosing", "reporting"), help="measure photographs of this set only")
    add("--peers", action="store_true", help="compare with other methods")
    add("--out", type=Path, help="folder for pictures")
    chosen = parser.parse_args(arguments)
    listed = [outline for outline in outlines() if chosen.set in (None, outline.job.set)]
    if chosen.pictures is None:
        listed = [outline for outline in listed if edited_photographs()[outline.job.photograph].is_shipped]
    peers = COMPARED if chosen.peers else ()
    print(f"{'':44}" + "  ".join(f"{name:>25}" for name in (OURS, *peers)))
    print(f"{'':44}" + "  ".join(["     IoU  missed  outside"] * (1 + len(peers))))
    rows = list[dict[str, Score]]()
    for outline in listed[:1] if chosen.quick else listed:
        image = outline.job.before(chosen.pictures)
        rows.append(measure(outline, reduced_to(image, QUICK_SIDE) if chosen.quick else image, peers, chosen.out))
        print(line(f"{outline.job.name}: {outline.job.what}"[:43], rows[-1]), flush=True)
    if rows:
        fields = ("overlap", "missed", "outside")
        means = {name: Score(*(mean(getattr(row[name], f) for row in rows) for f in fields)) for name in (OURS, *peers)}
        print(line(f"mean of {len(rows)}", means))
    return 0


if __name__ == "__main__":
    sys.exit(main())
