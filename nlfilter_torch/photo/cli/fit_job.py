"""The fit of a look to photographs before and after an edit, and the files that it is written to."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path

import torch
import typer
from torch import Tensor
from torch.nn.functional import avg_pool2d

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.editing import check_apart, read_masks, viewed_within_memory
from nlfilter_torch.photo.cli.folders import is_picture
from nlfilter_torch.photo.cli.progress import steps
from nlfilter_torch.photo.declared.colour_tables import CUBE_NODES, HALD_LEVEL, cube_of, hald_of
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.fit_look import FittedLook, fit_look
from nlfilter_torch.photo.edits.look import colour_part, colour_table, table_error
from nlfilter_torch.photo.files.formats import check_type
from nlfilter_torch.photo.files.writing import check_file, open_beside
from nlfilter_torch.photo.looks.alignment import align, explained_share, inside_frame
from nlfilter_torch.photo.looks.edited_pixels import check_belong
from nlfilter_torch.photo.picture.changes import blend_edited
from nlfilter_torch.photo.picture.photographs import Photograph, read_photograph, write_photograph
from nlfilter_torch.photo.picture.resizing import resize
from nlfilter_torch.photo.picture.viewing import viewed_size

PAIR_BYTES = 140  # per pixel of a pair at its full size, while it is read and compared
ENOUGH = 0.8  # share of an edit that is to be explained
AMPLIFIED = 4  # what is left, in the preview
SQUARE = 16  # pixels, of places that an edit is looked for in
FEW, MOST = 0.1, 0.5  # of these places, and of what is left, for an edit to be called local
CALLED = {
    "alpha": "sliders",
    "bands": "gains of blurs",
    "texture": "texture",
    "tone": "a tone curve",
    "curves": "a tone curve for each channel",
    "matrix": "colours",
    "saturation": "saturation",
    "stretch": "automatic levels",
    "local": "local contrast",
    "lattice": "a lattice of colours",
}


@dataclass(frozen=True)
class FitJob:
    """The look of a photograph and its edited version, or of folders of them, and the files to write.

    Attributes:
        step: whose filter looks at the photographs.
        before: a photograph, or a folder of them.
        after: the same after the edit.
        preset: file of the look; those of several regions get numbers.
        masks: a picture for each region, or a folder of them.
        preview: file for a picture of the first pair, or None.
        left: file for a picture of what the look does not explain of it, or None.
        cube: file for a colour table, or None; those of several regions get numbers.
        hald: file for a picture of such a table, or None.
    """

    step: Step
    before: Path
    after: Path
    preset: Path
    masks: list[Path]
    preview: Path | None
    left: Path | None
    cube: Path | None = None
    hald: Path | None = None

    def run(self, order: int) -> None:
        """Fit the looks, write them, and print what they are worth."""
        paths = _paths(self.before, self.after)
        regions = _regions(self.masks, paths, self.before.is_dir())
        results = [self.preset.with_stem(f"{self.preset.stem}-{i + 1}") for i in range(len(self.masks))]
        results = results or [self.preset]
        self._check(results, photographs=[*chain(*paths)], mask=[*chain(*regions)])
        alone = len(paths) == 1
        whole = alone and not self.masks  # all that was fitted is looked at again
        judges = whole or self.preview is not None or self.left is not None
        judged = None
        with steps(len(paths) + 1) as begin:
            pairs = Pairs(paths, regions, self.step, begin, keeps_first=judges)
            fitted = fit_look(pairs, order=order, step=self.step)
            looks = fitted if isinstance(fitted, tuple) else (fitted,)
            begin("Judging")
            if judges:
                judged = _judged(looks, self.step, *pairs.first)
                _draw(*judged, self.preview, self.left)
            for look, path in zip(looks, results, strict=True):
                with open_beside(path) as stream:
                    stream.write(look.to_json().encode())
            self._write_tables(looks)
        if self.before.is_dir():
            _note_unpaired(self.before, {path.stem for _, path in paths})
            _note_unpaired(self.after, {path.stem for path, _ in paths})
        share = explained_share(*judged) if whole and judged is not None else None
        for look, path in zip(looks, results, strict=True):
            _report(look, look.fitted if share is None else share, path, alone=alone)
        if whole and judged is not None:
            self._report_table(looks[0], *judged[:2])
            _tell_where(*judged, stride=pairs.first[0].shape[-1] / judged[0].shape[-1])

    def _check(self, results: list[Path], **inputs: list[Path]) -> None:
        """Raise ValueError or OSError unless all files can be written and differ from the inputs."""
        for path in results:
            check_file(path)
            if path.suffix.lower() != ".json":
                raise ValueError(f"PRESET must end in .json, got {path}; rename it")
            check_apart("PRESET", path, **inputs)
        for option, picture in (("--preview", self.preview), ("--map", self.left)):
            if picture is not None:
                check_type(picture, "uint8", alpha=False)
                check_apart(option, picture, **inputs)
        check_apart("--map", self.left, preview=self.preview)
        if self.cube is not None:
            check_file(self.cube)
            if self.cube.suffix.lower() != ".cube":
                raise ValueError(f"--cube must end in .cube, got {self.cube}; rename it")
            check_apart("--cube", self.cube, **inputs)
        if self.hald is not None:
            check_type(self.hald, "uint16", alpha=False)
            check_apart("--hald", self.hald, **inputs)

    def _write_tables(self, looks: Sequence[FittedLook]) -> None:
        """Write the tables of looks; those of several get numbers."""
        for number, look in enumerate(looks, 1):
            ending = f"-{number}" if len(looks) > 1 else ""
            if self.cube is not None:
                path = self.cube.with_stem(self.cube.stem + ending)
                with open_beside(path) as stream:
                    stream.write(cube_of(colour_table(look.step, CUBE_NODES).numpy(), path.stem).encode())
            if self.hald is not None:
                levels = hald_of(colour_table(look.step, HALD_LEVEL**2).numpy())
                pixels = torch.from_numpy(levels / 65535).permute(2, 0, 1)[None]
                write_photograph(Photograph(pixels, "uint16"), self.hald.with_stem(self.hald.stem + ending))

    def _report_table(self, look: FittedLook, before: Tensor, after: Tensor) -> None:
        """Say what a table carries of the change between two pictures, and how exact it is, if there is one."""
        if self.cube is None and self.hald is None:
            return
        share = explained_share(before, after, apply_step(colour_part(look.step), before).clamp(0, 1))
        error = table_error(look.step, CUBE_NODES, before)
        carried = f"{self.cube or self.hald} carries {100 * share:.1f} % of the change"
        typer.echo(f"table: {carried}; {CUBE_NODES}^3 colours are off by {error:.2f} levels of 255")
        if share < ENOUGH:
            options.note(
                f"a table carries less than {100 * ENOUGH:.0f} % of the edit, as the rest depends on the picture; "
                "use the preset with nlfilter-torch apply"
            )


@dataclass
class Pairs:
    """Pairs of photographs with their masks, read one after the other.

    Attributes:
        paths: files of the photographs.
        regions: files of the masks of each pair.
        step: whose filter looks at them.
        begin: called with the name of a pair before it is read.
        keeps_first: whether to keep the first pair.
        first: the images of the first pair, and their masks if there are any.
    """

    paths: list[tuple[Path, Path]]
    regions: list[list[Path]]
    step: Step
    begin: Callable[[str], None]
    keeps_first: bool
    first: tuple[Tensor, ...] = ()

    def __iter__(self) -> Iterator[tuple[Tensor, ...]]:
        """Yield the images of each pair, and its masks if there are any."""
        for (before, after), masks in zip(self.paths, self.regions, strict=True):
            self.begin(f"Comparing {after.name}")
            images = (*_read(before, after, self.step), *([read_masks(masks, before)] if masks else []))
            if self.keeps_first and not self.first:
                self.first = images
            yield images


def _paths(first: Path, second: Path) -> list[tuple[Path, Path]]:
    """The files of the pairs."""
    if not first.is_dir() and not second.is_dir():
        return [(first, second)]
    if not (first.is_dir() and second.is_dir()):
        raise ValueError(
            f"BEFORE and AFTER must be two photographs or two folders, got {first} and {second}; pass both"
        )
    edited = _pictures(second)
    pairs = [(path, pair) for path in _pictures(first) if (pair := _counterpart(path, edited)) is not None]
    if not pairs:
        raise ValueError(f"{second} must hold photographs of the names of those in {first}, got none; rename them")
    for (path, pair), (other, same) in pairwise(sorted(pairs, key=itemgetter(1))):
        if pair == same:
            raise ValueError(
                f"{first} must hold one photograph for {pair}, got {path.name} and {other.name}; remove one of them"
            )
    return pairs


def _note_unpaired(folder: Path, paired: set[str]) -> None:
    """Print a note if photographs of a folder have no counterpart of their name in the other."""
    rest = [path.name for path in _pictures(folder) if path.stem not in paired]
    if rest:
        others = f" and {len(rest) - 1} more" if len(rest) > 1 else ""
        options.note(f"{rest[0]}{others} in {folder} left out, without a photograph of that name in the other folder")


def _regions(masks: list[Path], paths: list[tuple[Path, Path]], folders: bool) -> list[list[Path]]:
    """The mask files of every pair: the same for all, or those in folders under the names of the photographs."""
    regions: list[list[Path]] = [[] for _ in paths]
    for mask in masks:
        if mask.is_dir() != folders:
            wanted = (
                "folders of masks, as BEFORE and AFTER are folders" if folders else "pictures, as BEFORE and AFTER are"
            )
            remedy = "put the masks in a folder under the names of the photographs" if folders else "name a file in it"
            raise ValueError(f"--mask must name {wanted}, got {mask}; {remedy}")
        named = _pictures(mask) if folders else []
        for files, (photograph, _) in zip(regions, paths, strict=True):
            own = _counterpart(photograph, named) if folders else mask
            if own is None:
                raise ValueError(
                    f"{mask} must hold a mask for every photograph, got none for {photograph.name}; add one, black all "
                    "over if the region is not in the photograph"
                )
            files.append(own)
    return regions


def _pictures(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if is_picture(path)]


def _counterpart(path: Path, others: Sequence[Path]) -> Path | None:
    """The file with the name of a photograph or, if there is none, with that name and another suffix.

    Raises:
        ValueError: if several differ from it in the suffix only.
    """
    matches = [other for other in others if other.stem == path.stem]
    if len(matches) > 1 and path.name not in {other.name for other in matches}:
        names = " and ".join(other.name for other in matches)
        raise ValueError(
            f"{matches[0].parent} must hold one photograph of the name of {path.name}, got {names}; remove all but one"
        )
    return next((other for other in matches if other.name == path.name), matches[0] if matches else None)


def _read(before: Path, after: Path, step: Step) -> tuple[Tensor, Tensor]:
    """A pair on the same pixels, in colour if one of them is."""
    images = [read_photograph(path, bytes_per_pixel=PAIR_BYTES).pixels for path in (before, after)]
    viewed_within_memory(before, (images[0].shape[2], images[0].shape[3]), step)
    channels = max(image.shape[1] for image in images)
    first, second = (image.expand(-1, channels, -1, -1) for image in images)
    image, edited, done = align(first, second, str(before), str(after))
    if bool((image == edited).all()):
        raise ValueError(f"{after} must differ from {before}, but they are the same; give an edited photograph")
    check_belong(image[0].expand(3, -1, -1), edited[0].expand(3, -1, -1), str(before), str(after))
    if done:
        options.note(done)
    if bool((image == image[..., :1, :1]).all()):
        options.note(f"{before} has a single colour; what the look does to others is not known")
    return image, edited


def _judged(
    looks: Sequence[FittedLook],
    step: Step,
    image: Tensor,
    edited: Tensor,
    masks: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """A pair at the viewing size, and the result of the looks, each in its region."""
    whole = (image.shape[2], image.shape[3])
    size = viewed_size(whole, step["viewing_size"])
    if size != whole:
        image, edited = (resize(planes, size).clamp(0, 1) for planes in (image, edited))
        masks = None if masks is None else resize(masks, size).clamp(0, 1)
    results = [look.apply(image).clamp(0, 1) for look in looks]
    return image, edited, results[0] if masks is None else blend_edited(image, results, masks)


def _report(look: FittedLook, share: float, path: Path, *, alone: bool) -> None:
    """Print what a look is and what it is worth."""
    typer.echo(f"{'explained of the change by':40}{'fitted':>8}{'left out':>10}")
    without_lattice = tuple(part for part in look.parts if part != "lattice")
    for parts, (fitted, left_out) in look.explained.items():
        if len(parts) == 1 or parts in (without_lattice, look.parts):
            name = " + ".join(CALLED[part] for part in parts)
            typer.echo(f"{name:40}{100 * fitted:z7.1f} %{100 * left_out:z8.1f} %")
    if len(look.added) > 1:
        typer.echo("of this, each part adds to those above it")
        for part, (fitted, left_out) in look.added.items():
            typer.echo(f"{CALLED[part]:40}{100 * fitted:+z7.1f} %{100 * left_out:+z8.1f} %")
    typer.echo("alpha: " + ", ".join(f"{slider:.3f}" for slider in look.step["alpha"]))
    others = "parts of the picture left out of the fit" if alone else "other photographs"
    typer.echo(f"explained: {100 * share:.1f} % of the change, {100 * look.left_out:.1f} % in {others}")
    if alone:
        typer.echo("in other photographs: not known from one pair; folders of three pairs or more tell")
    if min(share, look.left_out) < ENOUGH:
        options.note(f"the look explains less than {100 * ENOUGH:.0f} % of the edit; --preview shows what is missing")
    typer.echo(f"preset: {path}")


def _tell_where(before: Tensor, after: Tensor, result: Tensor, stride: float) -> None:
    """Say where the rest of the change is, if it is in a few places; a pixel is ``stride`` pixels of the photograph."""
    rest = (after - result).square().mean(1, keepdim=True) * inside_frame(before[0], after[0])
    rest = avg_pool2d(rest, SQUARE, ceil_mode=True)[0, 0]
    if explained_share(before, after, result) > ENOUGH or rest.numel() < 1 / FEW:
        return
    largest = rest.flatten().topk(max(1, int(FEW * rest.numel())))
    if float(largest.values.sum() / rest.sum()) < MOST:
        return
    place = int(largest.indices[0])
    row, column = (round(SQUARE * stride * number) for number in divmod(place, rest.shape[1]))
    options.note(
        f"most of what is left is in a tenth of the picture, around row {row}, column {column}: an edit of a part; "
        "--map shows where, and --mask fits parts by themselves"
    )


def _draw(before: Tensor, after: Tensor, result: Tensor, preview: Path | None, left: Path | None) -> None:
    """Write the preview and the map of what is left."""
    if preview is not None:
        rest = (0.5 + AMPLIFIED * (after - result)).clamp(0, 1)
        write_photograph(Photograph(torch.cat([before, after, result, rest], dim=3)), preview)
    if left is not None:
        rest = (after - result).abs().amax(1, keepdim=True)
        write_photograph(Photograph(rest / rest.amax().clamp(min=1e-6)), left)
