"""``nlfilter-torch apply``: apply a saved edit to a photograph."""

from pathlib import Path
from typing import Annotated

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.edits.presets import find_recipe

Edit = Annotated[
    str,
    typer.Option(
        "--preset",
        metavar="FILE|NAME",
        help="A file saved by the editor (`nlfilter-torch app`) or written by `nlfilter-torch fit`, or the name of a "
        "preset (see `nlfilter-torch presets`).",
    ),
]


def apply(
    source: options.Source,
    target: options.Target,
    preset: Edit,
    depth: options.OutputDepth = None,
    memory: options.Memory = None,
    full: options.Full = False,
) -> None:
    """Apply an edit saved in the browser to a photograph, including its sliders and strokes.

    Photographs larger than memory are edited in tiles.

    Example: `nlfilter-torch apply in.jpg out.jpg --preset edit.json`
    """
    recipe = find_recipe(preset)

    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli.editing import Job
    from nlfilter_torch.io.photographs import Photograph
    from nlfilter_torch.tiled.pictures import Rows
    from nlfilter_torch.tiled.recipe import edit_rows

    def work(photograph: Photograph) -> Tensor:
        return recipe.apply(photograph.pixels)

    def by_rows(job: Job) -> Rows:
        return edit_rows(job.passes(full, Path(target).parent), job.picture.rows, recipe, source)

    editing.edit_file(
        source,
        target,
        depth,
        work,
        bytes_per_pixel=recipe.bytes_per_pixel,
        memory=memory,
        by_rows=by_rows,
        coloured=recipe.gives_colour,
    )
