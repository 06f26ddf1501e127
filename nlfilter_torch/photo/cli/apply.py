"""``nlfilter-torch apply``: apply a saved edit to a photograph."""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.declared.presets import find_recipe

Edits = Annotated[
    list[str],
    typer.Option(
        "--preset",
        metavar="FILE|NAME",
        help="A file saved by the editor (`nlfilter-torch app`) or written by `nlfilter-torch fit`, or the name of a "
        "preset (see `nlfilter-torch presets`). May be repeated, each time with the --mask of its region; the rest of "
        "the photograph stays unchanged.",
    ),
]


def apply(
    source: options.Source,
    target: options.Target,
    preset: Edits,
    mask: options.Masks = None,
    depth: options.OutputDepth = None,
    memory: options.Memory = None,
    full: options.Full = False,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
) -> None:
    """Apply an edit saved in the browser to a photograph, including its sliders and strokes.

    Photographs larger than memory are edited in tiles.

    Example: `nlfilter-torch apply in.jpg out.jpg --preset edit.json`

    Two looks that `nlfilter-torch fit` found for regions: `nlfilter-torch apply in.jpg out.jpg --preset look-1.json
    --mask sky.png --preset look-2.json --mask ground.png`
    """
    recipes, masks = [find_recipe(name) for name in preset], mask or []
    if len(masks) != len(recipes) and (masks or len(recipes) > 1):
        raise ValueError(
            f"--mask must come once for each --preset, got {len(masks)} for {len(recipes)}; "
            "say where each of them holds, or give one preset alone"
        )

    from torch import Tensor

    from nlfilter_torch.photo.cli import editing, showing
    from nlfilter_torch.photo.cli.editing import Job
    from nlfilter_torch.photo.edits.applying import apply_recipe
    from nlfilter_torch.photo.io.photographs import Photograph
    from nlfilter_torch.photo.picture.changes import blend_edited
    from nlfilter_torch.photo.tiled.pictures import Picture
    from nlfilter_torch.photo.tiled.recipe import edit_regions, edit_tiling
    from nlfilter_torch.photo.tiled.tiles import Tiling

    editing.check_apart("OUT", target, mask=masks, preset=preset)
    for recipe, name in zip(recipes, preset, strict=True):
        showing.note_idle(recipe, name)
    steps = [step for recipe in recipes for step in recipe.acting]
    colorizes = any(step.edit == "colorize" for step in steps)

    def work(photograph: Photograph) -> Tensor:
        if photograph.pixels.shape[1] == 1:
            showing.note_grey(steps, source)
        if colorizes:
            showing.note_colours(source, photograph.size, lambda rows: photograph.pixels[..., rows, :])
        if not masks:
            return apply_recipe(recipes[0], photograph.pixels)
        shares = editing.read_masks(masks, source, photograph.size)
        return blend_edited(photograph.pixels, [apply_recipe(recipe, photograph.pixels) for recipe in recipes], shares)

    def by_rows(job: Job) -> AbstractContextManager[Tiling]:
        passes = job.passes(full, Path(target).parent)
        if job.picture.shape[2] < 3:
            showing.note_grey(steps, source)
        if colorizes:
            picture = Picture(job.picture.rows, source)
            showing.note_colours(source, job.size, lambda rows: picture.tile(rows.start, rows.stop, 0).pixels)
        if not masks:
            return edit_tiling(passes, job.picture.rows, recipes[0].steps, source)
        found = [job.open(path) for path in masks]
        for path, one in zip(masks, found, strict=True):
            if tuple(one.shape[:2]) != job.size:
                raise ValueError(
                    f"{path} must have the size of {source}, {job.size[1]}x{job.size[0]}, got "
                    f"{one.shape[1]}x{one.shape[0]}; resize it"
                )
        edits = [recipe.steps for recipe in recipes]
        return edit_regions(passes, job.picture.rows, edits, [one.rows for one in found], source)

    editing.edit_file(
        source,
        target,
        depth,
        work,
        bytes_per_pixel=max(recipe.bytes_per_pixel for recipe in recipes) + 16 * len(masks),
        memory=memory,
        by_rows=by_rows,
        coloured=any(recipe.gives_colour for recipe in recipes),
        workers=workers,
        cluster=cluster,
    )
