"""``nlfilter-torch develop``: exposure, white balance, straightening and crop."""

from typing import Annotated, Any

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import with_declared
from nlfilter_torch.photo.declared.development import DEVELOP, Development
from nlfilter_torch.photo.declared.presets import Recipe

Aspect = Annotated[
    str | None,
    typer.Option(
        "--aspect",
        metavar="W:H",
        help="Width and height to which the crop is trimmed about its middle, such as 3:2 or 1:1; without --crop, that "
        "of the whole photograph.",
    ),
]


@with_declared(DEVELOP)
def develop(
    source: options.Source,
    target: options.Target,
    aspect: Aspect = None,
    depth: options.OutputDepth = None,
    quality: options.Quality = None,
    force: options.Force = False,
    memory: options.Memory = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    **values: Any,
) -> None:
    """Develop a photograph; the help is that of the declaration."""
    recipe = Recipe((), Development(**values | {"crop": options.parse_crop(values["crop"])}))
    sides = None if aspect is None else options.parse_aspect(aspect)

    from nlfilter_torch.photo.cli import editing
    from nlfilter_torch.photo.cli.recipe_job import RecipeJob

    notes = [f"no option changes anything: {target} is written without an edit"]
    job = RecipeJob([recipe], [], source, target, False, notes if recipe.develop.is_idle else [], aspect=sides)
    editing.edit_file(
        job, source, target, depth, memory=memory, workers=workers, cluster=cluster, quality=quality, force=force
    )
