"""``nlfilter-torch apply``: apply a saved edit to a photograph."""

from typing import Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.declared.presets import find_recipe

Edits = Annotated[
    list[str],
    typer.Option(
        "--preset",
        metavar="FILE|NAME",
        help="A file saved by the editor (`nlfilter-torch app`) or written by `nlfilter-torch fit`, a colour table (a "
        ".cube file or a Hald), or the name of a preset (see `nlfilter-torch presets`). May be repeated, each "
        "time with the --mask of its region; the rest of the photograph stays unchanged.",
    ),
]


def apply(
    source: options.Source,
    target: options.Target,
    preset: Edits,
    mask: options.Masks = None,
    depth: options.OutputDepth = None,
    quality: options.Quality = None,
    force: options.Force = False,
    memory: options.Memory = None,
    full: options.Full = False,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
) -> None:
    """Apply an edit saved in the browser to a photograph, including its sliders, strokes and crop.

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
    developed = next((name for recipe, name in zip(recipes, preset, strict=True) if not recipe.develop.is_idle), None)
    if masks and developed is not None:
        raise ValueError(
            f"--mask must come with edits that do not develop the photograph, got {developed}; develop it first, by "
            "nlfilter-torch develop"
        )

    from nlfilter_torch.photo.cli import editing, showing
    from nlfilter_torch.photo.cli.recipe_job import RecipeJob

    editing.check_apart("OUT", target, mask=masks, preset=preset)
    notes = [note for recipe, name in zip(recipes, preset, strict=True) for note in showing.notes_if_idle(recipe, name)]
    job = RecipeJob(recipes, masks, source, target, full, notes)
    editing.edit_file(
        job, source, target, depth, memory=memory, workers=workers, cluster=cluster, quality=quality, force=force
    )
