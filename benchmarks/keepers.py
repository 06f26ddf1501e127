"""How many results of a retoucher's fifty jobs on free photographs are kept: ``python -m benchmarks.keepers``.

Recolouring by the first strokes that come to mind, masks, defocus, presets, colours for grey photographs, noise and
abstraction. The strokes of ``keepers.json`` were drawn once, with the editor's brush, and never adapted to results.
For every job a picture ``OUT/NUMBER-PHOTOGRAPH-EDIT.png`` is written: the photograph, with strokes, and the result (of
a mask, the object on grey); ``OUT/all.png`` shows the results together. A person looks at each result in full size
and says in ``keepers.json`` whether it would be kept and published as it is ("keeper"), or "why" not; this command
counts these judgements, and names the jobs that nobody has judged. ``keepers_judged.json`` has the digests of the
results that were judged; results that differ are named, and ``--judged`` stores the digests of those that have been
looked at.

``--pictures`` is the folder of :mod:`benchmarks.free_photographs`; without it only scikit-image's
photographs are edited. Jobs on photographs of the choosing set may guide changes of the edits, those on the reporting
set are counted only.
"""

import base64
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.free_photographs import edited_photographs
from benchmarks.harness import options, save_picture
from benchmarks.photographs import luminance, reduced_to, scribbled
from nlfilter_torch.photo import region_mask
from nlfilter_torch.photo.app.tools import BRUSH_RADIUS
from nlfilter_torch.photo.declared.parameters import EDITS, MASK
from nlfilter_torch.photo.declared.presets import Recipe, find_recipe
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.declared.strokes import Mark
from nlfilter_torch.photo.edits.recipe import apply_recipe
from nlfilter_torch.photo.picture.drawn import colour_of
from nlfilter_torch.photo.picture.painting import cover
from nlfilter_torch.photo.picture.resizing import resize

STORED = Path(__file__).with_suffix(".json")
JUDGED = Path(__file__).with_name("keepers_judged.json")  # digests of the results that were judged, by name of the job
CELLS = 8  # of a digest, across and down
SIDE = 600  # short side of photographs, at most
GREY = 0.6  # behind an object that is cut out
TILE, ACROSS = (200, 300), 5  # of the contact sheet
PAINTS = {"in": "#ffd91a", "out": "#e02020"}
AIM = 0.85  # share of the results to keep
KINDS = {"recolor": "recolouring", "mask": "masks and defocus", "defocus": "masks and defocus"}


@dataclass(frozen=True)
class Job:
    """An edit of a photograph."""

    number: int  # from 1
    photograph: str  # its name
    what: str  # is done
    edit: str  # its name, "mask" or "preset"
    recipe: Recipe  # the edit; empty for a mask
    strokes: tuple[Mark, ...]  # drawn with the editor's brush
    noise: float  # standard deviation in grey levels of the noise that is added to the photograph
    keeper: bool | None  # whether the result is kept; None if nobody has looked at it
    why: str  # what is wrong with it, if it is not kept

    @staticmethod
    def of(number: int, entry: dict[str, Any]) -> "Job":
        """The job of an entry of the file."""
        edit, what = entry["edit"], entry["what"]
        drawn = [{"radius": BRUSH_RADIUS} | stroke for stroke in entry.get("strokes", ())]
        strokes = tuple(EDITS.get(edit, MASK).mark_of(stroke, what) for stroke in drawn)
        recipe = find_recipe(entry["preset"]) if edit == "preset" else Recipe()
        if edit in EDITS:
            entries = entry.get("parameters", {}) | ({"strokes": drawn} if drawn else {})
            recipe = Recipe((Step.from_entries(edit, entries, what),))
        rest = entry.get("noise", 0.0), entry.get("keeper"), entry.get("why", "")
        return Job(number, entry["photograph"], what, edit, recipe, strokes, *rest)

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.number:02d}-{self.photograph}-{self.edit}"

    @property
    def set(self) -> str:
        """The set of its photograph: choosing or reporting."""
        return edited_photographs()[self.photograph].set

    def before(self, folder: Path | None) -> Tensor:
        """The photograph before the edit, (1, 3, H, W), or grey, (1, 1, H, W)."""
        image = reduced_to(edited_photographs()[self.photograph].pixels(folder), SIDE)
        if self.noise:
            noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(self.number))
            image = (image + noise * self.noise / 255).clamp(0, 1)
        return luminance(image) if self.edit == "colorize" else image

    def after(self, image: Tensor) -> Tensor:
        """The result for a photograph; of a mask, the object on grey."""
        if self.edit != "mask":
            return apply_recipe(self.recipe, image).clamp(0, 1)
        mask = region_mask(image, mask_of(self.strokes, (image.shape[-2], image.shape[-1])))
        return torch.lerp(torch.full_like(image, GREY), image, mask)

    def marked(self, image: Tensor) -> Tensor:
        """The photograph with its strokes."""
        image = image.expand(-1, 3, -1, -1)
        for stroke in self.strokes:
            mask = mask_of([stroke], (image.shape[-2], image.shape[-1]))
            colour = colour_of(PAINTS.get(stroke.paint, stroke.paint)).view(1, 3, 1, 1)
            image = scribbled(image, colour.expand_as(image), mask)
        return image


def mask_of(strokes: Iterable[Mark], size: tuple[int, int]) -> Tensor:
    """The mask (1, 1, H, W) of the pixels that strokes cover."""
    planes = [cover(stroke, size).float() for stroke in strokes]
    return torch.stack([torch.zeros(size), *planes]).amax(0)[None, None]


def jobs(file: Path = STORED) -> list[Job]:
    """The jobs that are stored."""
    return [Job.of(number, entry) for number, entry in enumerate(json.loads(file.read_text(encoding="utf-8")), 1)]


def panels(job: Job, folder: Path | None) -> Tensor:
    """The photograph, with strokes, and the result, side by side."""
    image = job.before(folder)
    views = [view.expand(-1, 3, -1, -1) for view in (image, job.marked(image), job.after(image))]
    return torch.cat(views if job.strokes else views[::2], dim=3)


def in_tile(picture: Tensor) -> Tensor:
    """A picture (1, 3, H, W), reduced and with a white border, in a tile of the contact sheet."""
    height, width = picture.shape[-2:]
    scale = min(TILE[0] / height, TILE[1] / width)
    size = (round(height * scale), round(width * scale))
    return F.pad(resize(picture, size), (0, TILE[1] - size[1], 0, TILE[0] - size[0]), value=1.0)


def contact_sheet(pictures: Sequence[Tensor]) -> Tensor:
    """All pictures in rows."""
    tiles = [in_tile(picture) for picture in pictures]
    tiles += [torch.ones_like(tiles[0])] * (-len(tiles) % ACROSS)
    rows = [torch.cat(tiles[first : first + ACROSS], dim=3) for first in range(0, len(tiles), ACROSS)]
    return torch.cat(rows, dim=2)


def digest(result: Tensor) -> str:
    """Mean colours of the cells of a picture (1, 3, H, W), in grey levels."""
    means = F.adaptive_avg_pool2d(result, CELLS).mul(255).round().clamp(0, 255)
    return base64.b64encode(bytes(means.flatten().int().tolist())).decode()


def is_same(digest: str, other: str) -> bool:
    """Whether two digests differ by rounding at most."""
    pairs = zip(base64.b64decode(digest), base64.b64decode(other), strict=True)
    return all(abs(mean - other_mean) <= 1 for mean, other_mean in pairs)


def changed(digests: dict[str, str], judged: dict[str, str]) -> list[str]:
    """Names of the results, by their digests, that are not those that were judged."""
    return [name for name, new in digests.items() if name not in judged or not is_same(new, judged[name])]


def results(listed: Sequence[Job], pictures: Path | None, out: Path) -> dict[str, Tensor]:
    """Write the pictures of the jobs whose photographs are there; the results, by name of the job."""
    written = {}
    for job in listed:
        if pictures is None and not edited_photographs()[job.photograph].is_shipped:
            continue
        picture = panels(job, pictures)
        save_picture(out / f"{job.name}.png", picture)
        written[job.name] = picture[..., -picture.shape[-1] // (3 if job.strokes else 2) :]
    if written:
        save_picture(out / "all.png", contact_sheet(list(written.values())))
    return written


def compare_with_judged(digests: dict[str, str], file: Path, *, store: bool) -> None:
    """Name the results that are not those that were judged, or ``store`` the digests as those of judged ones."""
    judged: dict[str, str] = json.loads(file.read_text(encoding="utf-8"))
    if store:
        file.write_text(json.dumps(dict(sorted((judged | digests).items())), indent=0) + "\n", encoding="utf-8")
    else:
        for name in changed(digests, judged):
            print(f"{name}: the result has changed since it was judged: look again")


def counted(listed: Sequence[Job]) -> str:
    """A table of the judgements, by set and kind of edit, and what is not kept or not judged."""
    judged = [job for job in listed if job.keeper is not None]
    lines = []
    for name in sorted({job.set for job in judged}):
        for kind in ("recolouring", "masks and defocus", "other edits", "all"):
            own = [job for job in judged if job.set == name and kind in ("all", KINDS.get(job.edit, "other edits"))]
            lines.append(f"{name:12}{kind:20}{sum(job.keeper is True for job in own):4} of {len(own)}")
    kept = sum(job.keeper is True for job in judged)
    verdict = "holds" if kept >= AIM * len(judged) else "FALLS SHORT"
    lines += ["", f"kept {kept} of {len(judged)}, at least {AIM:.0%}: {verdict}", ""]
    lines += [f"{job.name}: {job.why or 'not judged'}" for job in listed if not job.keeper]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Write the pictures, print how many are kept, and return 1 if these are too few."""
    parser = options("keepers", __doc__)
    add = parser.add_argument
    add("--pictures", type=Path, help="folder of free photographs; default: only scikit-image's")
    add("--out", type=Path, default=Path("out/keepers"), help="folder for the results")
    add("--only", type=int, nargs="+", metavar="NUMBER", help="edit and count these jobs only")
    add("--set", choices=("choosing", "reporting"), help="edit and count jobs of this set only")
    add("--judged", action="store_true", help="the results have been judged: store their digests")
    add("--count", action="store_true", help="only count the judgements")
    chosen = parser.parse_args(arguments)
    listed = [
        job for job in jobs() if (chosen.only is None or job.number in chosen.only) and chosen.set in (None, job.set)
    ]
    if not listed:
        parser.error("no job has one of the numbers of --only in the set of --set; use others")
    if not chosen.count:
        pictures = results(listed, chosen.pictures, chosen.out)
        digests = {name: digest(result) for name, result in pictures.items()}
        compare_with_judged(digests, JUDGED, store=chosen.judged)
    table = counted(listed)
    print(table)
    return int("FALLS SHORT" in table)


if __name__ == "__main__":
    sys.exit(main())
