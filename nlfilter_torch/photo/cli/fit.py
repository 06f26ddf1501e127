"""``nlfilter-torch fit``: find the look that turns photographs into edited ones, and save it for others."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import options_of, step_of, with_options
from nlfilter_torch.photo.cli.fit_tables import Cube, Hald, Tables
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import EDITS

if TYPE_CHECKING:
    from torch import Tensor

    from nlfilter_torch.photo.declared.steps import Step
    from nlfilter_torch.photo.look_fitting.fit_look import FittedLook
    from nlfilter_torch.photo.look_fitting.own_steps import FittedSteps

Before = Annotated[str, typer.Argument(metavar="BEFORE", help="The photograph before the edit, or a folder of them.")]
After = Annotated[
    str, typer.Argument(metavar="AFTER", help="The same after the edit; in a folder, under the same names.")
]
Result = Annotated[Path, typer.Argument(metavar="PRESET", help="The JSON file in which the look is saved.")]
Order = Annotated[
    int,
    typer.Option("--layers", min=2, max=10, metavar="N", help="Number of sliders, from the finest to the coarsest."),
]
Preview = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A picture of the first pair at the viewing size: before, after, the look, and the remaining difference, "
        "amplified, around grey.",
    ),
]
Map = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="A grey picture of the part of the first pair's edit that the look does not explain.",
    ),
]
PAIR_BYTES = 140  # per pixel of a pair at its full size, while it is read and compared
ENOUGH = 0.8  # share that is to be explained
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


@with_options("bandwidth", "spatial_bandwidth", "patch_size", "landmarks", "sampling")
def fit(
    before: Before,
    after: After,
    preset: Result = Path("preset.json"),
    layers: Order = 4,
    mask: options.MasksOfPairs = None,
    preview: Preview = None,
    left: Map = None,
    cube: Cube = None,
    hald: Hald = None,
    **values: Value,
) -> None:
    """Find the look that turns a photograph into an edited one, or a folder of them, whatever program made the edit.

    A look has sliders, tone curves, colours and sharpness, but only those that also explain photographs left out of
    the fit. Prints how much of the change it explains, and saves it in a file for other photographs:

    `nlfilter-torch fit before.jpg after.jpg look.json --preview seen.png`

    `nlfilter-torch apply other.jpg out.jpg --preset look.json`

    For other programs: `nlfilter-torch fit before.jpg after.jpg look.json --cube look.cube`

    If this program made the edit, by detail, tone or sharpen, its steps and their parameters are saved instead.

    Each --mask is a region that has a look of its own, in numbered files:

    `nlfilter-torch fit before.jpg after.jpg look.json --mask sky.png --mask ground.png`
    """
    step = step_of(EDITS["look"], values)

    from nlfilter_torch.photo.cli.progress import steps
    from nlfilter_torch.photo.files.writing import open_beside

    tables = Tables(cube, hald)
    paths = _paths(before, after)
    regions = _regions(mask or [], paths, Path(before).is_dir())
    results = [preset.with_stem(f"{preset.stem}-{i + 1}") for i in range(len(mask))] if mask else [preset]
    _check_results(results, preview, left, photographs=[*chain(*paths)], mask=[*chain(*regions)])
    tables.check(photographs=[*chain(*paths)], mask=[*chain(*regions)])
    alone = len(paths) == 1
    judged = (alone and not mask) or preview is not None or left is not None
    with steps(len(paths) + 1) as begin:
        pairs = Pairs(paths, regions, step, begin, keeps_first=judged)
        looks_only = bool(mask) or cube is not None or hald is not None
        looks, own = _fitted(pairs, layers - 1, step, looks_only=looks_only)
        begin("Judging")
        changes: Sequence[FittedLook | FittedSteps] = looks if own is None else (own,)
        judgement = None if pairs.first is None else _judged(changes, step, *pairs.first)
        if judgement is not None:
            _draw(*judgement, preview, left)
        for change, path in zip(changes, results, strict=True):
            with open_beside(path) as stream:
                stream.write(change.to_json().encode())
        tables.write(looks)
    _note_left_out(Path(before), Path(after), paths)
    whole = judgement if alone and not mask else None
    _report_all(looks, own, results, whole, alone=alone)
    if whole is not None and pairs.first is not None:
        if own is None:
            tables.report(looks[0], *whole[:2])
        _tell_where(*whole, stride=pairs.first[0].shape[-1] / whole[0].shape[-1])


def _fitted(
    pairs: "Pairs", order: int, step: "Step", *, looks_only: bool
) -> "tuple[tuple[FittedLook, ...], FittedSteps | None]":
    """Looks, one for each region, and the steps that explain more than the look does; None if there are none.

    With steps that explain a single pair nearly whole, no look is fitted to it.
    """
    from nlfilter_torch.photo.look_fitting.fit_look import fit_look
    from nlfilter_torch.photo.look_fitting.own_steps import StepSearch

    search = None if looks_only else StepSearch(step, order)
    if search is not None and len(pairs.paths) == 1:
        images = list(search.watching(pairs))
        if search.is_likely():
            own = search.fitted()
            if own.are_nearly_all:
                return (), own
        fitted = fit_look(images, order=order, step=step)
    else:
        fitted = fit_look(iter(pairs) if search is None else search.watching(pairs), order=order, step=step)
    looks = fitted if isinstance(fitted, tuple) else (fitted,)
    steps = None if search is None else search.fitted(looks[0].left_out)
    return looks, steps if steps is not None and steps.explain_more_than(looks[0].left_out) else None


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
    step: "Step"
    begin: Callable[[str], None]
    keeps_first: bool
    first: "tuple[Tensor, ...] | None" = None

    def __iter__(self) -> "Iterator[tuple[Tensor, ...]]":
        """Yield the images of each pair, and its masks if there are any."""
        from nlfilter_torch.photo.cli.editing import read_masks

        for (before, after), masks in zip(self.paths, self.regions, strict=True):
            self.begin(f"Comparing {after.name}")
            images = (*_read(before, after, self.step), *([read_masks(masks, before)] if masks else []))
            if self.keeps_first and self.first is None:
                self.first = images
            yield images


def _check_results(results: list[Path], preview: Path | None, left: Path | None, **inputs: list[Path]) -> None:
    """Raise ValueError or OSError unless all files can be written and differ from the inputs."""
    from nlfilter_torch.photo.cli.editing import check_apart
    from nlfilter_torch.photo.files.photographs import check_type
    from nlfilter_torch.photo.files.writing import check_file

    for path in results:
        check_file(path)
        if path.suffix.lower() != ".json":
            raise ValueError(f"PRESET must end in .json, got {path}; rename it")
        check_apart("PRESET", path, **inputs)
    for option, picture in (("--preview", preview), ("--map", left)):
        if picture is not None:
            check_type(picture, "uint8", alpha=False)
            check_apart(option, picture, **inputs)
    check_apart("--map", left, preview=preview)


def _paths(before: str, after: str) -> list[tuple[Path, Path]]:
    """The files of the pairs."""
    first, second = Path(before), Path(after)
    if not first.is_dir() and not second.is_dir():
        return [(first, second)]
    if not (first.is_dir() and second.is_dir()):
        raise ValueError(
            f"BEFORE and AFTER must be two photographs or two folders, got {before} and {after}; pass both"
        )
    edited = _pictures(second)
    pairs = [(path, pair) for path in _pictures(first) if (pair := _counterpart(path, edited)) is not None]
    if not pairs:
        raise ValueError(f"{after} must hold photographs of the names of those in {before}, got none; rename them")
    for (path, pair), (other, same) in pairwise(sorted(pairs, key=itemgetter(1))):
        if pair == same:
            raise ValueError(
                f"{before} must hold one photograph for {pair}, got {path.name} and {other.name}; remove one of them"
            )
    return pairs


def _note_left_out(before: Path, after: Path, pairs: list[tuple[Path, Path]]) -> None:
    """Print a note on each of two folders that holds photographs without a counterpart."""
    if before.is_dir():
        _note_unpaired(before, {path.stem for _, path in pairs})
        _note_unpaired(after, {path.stem for path, _ in pairs})


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
    from nlfilter_torch.photo.cli.folders import is_picture

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


def _read(before: Path, after: Path, step: "Step") -> "tuple[Tensor, Tensor]":
    """A pair on the same pixels, in colour if one of them is."""
    from nlfilter_torch.photo.cli.editing import viewed_within_memory
    from nlfilter_torch.photo.files.photographs import read_photograph
    from nlfilter_torch.photo.look_fitting.alignment import align
    from nlfilter_torch.photo.look_fitting.pairs import check_belong

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
    looks: "Sequence[FittedLook | FittedSteps]",
    step: "Step",
    image: "Tensor",
    edited: "Tensor",
    masks: "Tensor | None" = None,
) -> "tuple[Tensor, Tensor, Tensor]":
    """A pair at the viewing size, and the result of the looks, each in its region, or of steps."""
    from nlfilter_torch.photo.picture.changes import blend_edited
    from nlfilter_torch.photo.picture.resizing import resize
    from nlfilter_torch.photo.picture.viewing import viewed_size

    whole = (image.shape[2], image.shape[3])
    size = viewed_size(whole, step["viewing_size"])
    if size != whole:
        image, edited = (resize(planes, size).clamp(0, 1) for planes in (image, edited))
        masks = None if masks is None else resize(masks, size).clamp(0, 1)
    results = [look.apply(image).clamp(0, 1) for look in looks]
    return image, edited, results[0] if masks is None else blend_edited(image, results, masks)


def _report_all(
    looks: "Sequence[FittedLook]",
    own: "FittedSteps | None",
    paths: Sequence[Path],
    whole: "tuple[Tensor, Tensor, Tensor] | None",
    *,
    alone: bool,
) -> None:
    """Print what the looks, or the steps, are and what they are worth."""
    from nlfilter_torch.photo.look_fitting.alignment import explained

    share = None if whole is None else explained(*whole)
    if own is not None:
        _report_steps(own, looks, own.fitted if share is None else share, paths[0], alone=alone)
        return
    for look, path in zip(looks, paths, strict=True):
        _report(look, look.fitted if share is None else share, path, alone=alone)


def _report_steps(own: "FittedSteps", looks: "Sequence[FittedLook]", share: float, path: Path, *, alone: bool) -> None:
    """Print the steps as commands, and what they are worth beside a look."""
    typer.echo(f"{'explained of the change by':40}{'fitted':>8}{'left out':>10}")
    rows = {" + ".join(names): shares for names, shares in own.explained.items()}
    if looks:
        rows["a look"] = looks[0].fitted, looks[0].left_out
    for name, (fitted, left_out) in rows.items():
        typer.echo(f"{name:40}{100 * fitted:7.1f} %{100 * left_out:8.1f} %")
    for number, step in enumerate(own.steps, 1):
        typer.echo(f"step {number}: {step.edit} {options_of(step)}")
    others = "parts of the picture left out of the fit" if alone else "other photographs"
    typer.echo(f"explained: {100 * share:.1f} % of the change, {100 * own.left_out:.1f} % in {others}")
    typer.echo(f"preset: {path}")


def _report(look: "FittedLook", share: float, path: Path, *, alone: bool) -> None:
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


def _tell_where(before: "Tensor", after: "Tensor", result: "Tensor", stride: float) -> None:
    """Say where the rest of the change is, if it is in a few places; a pixel is ``stride`` pixels of the photograph."""
    from torch.nn.functional import avg_pool2d

    from nlfilter_torch.photo.look_fitting.alignment import explained, inside_frame

    rest = (after - result).square().mean(1, keepdim=True) * inside_frame(before[0], after[0])
    rest = avg_pool2d(rest, SQUARE, ceil_mode=True)[0, 0]
    if explained(before, after, result) > ENOUGH or rest.numel() < 1 / FEW:
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


def _draw(before: "Tensor", after: "Tensor", result: "Tensor", preview: Path | None, left: Path | None) -> None:
    """Write the preview and the map of what is left."""
    import torch

    from nlfilter_torch.photo.files.photographs import Photograph, write_photograph

    if preview is not None:
        rest = (0.5 + AMPLIFIED * (after - result)).clamp(0, 1)
        write_photograph(Photograph(torch.cat([before, after, result, rest], dim=3)), preview)
    if left is not None:
        rest = (after - result).abs().amax(1, keepdim=True)
        write_photograph(Photograph(rest / rest.amax().clamp(min=1e-6)), left)
