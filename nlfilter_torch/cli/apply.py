"""``nlfilter-torch apply``: a whole edit out of a file, on a photograph."""

from typing import Annotated

import typer
from torch import Tensor

from nlfilter_torch.cli import editing, options
from nlfilter_torch.cli.detail import OutputDepth, Target
from nlfilter_torch.files import Photograph
from nlfilter_torch.recipe import Recipe

Edit = Annotated[
    str,
    typer.Option(
        "--preset",
        metavar="FILE|NAME",
        help="What the editor saved (`nlfilter-torch app`), what `nlfilter-torch fit` found, or the name of a preset "
        "(`nlfilter-torch presets`).",
    ),
]


def apply(source: options.Source, target: Target, preset: Edit, depth: OutputDepth = None) -> None:
    """Edit a photograph as another one was edited in the browser: sliders, strokes and all.

    Example: `nlfilter-torch apply in.jpg out.jpg --preset edit.json`
    """
    recipe = Recipe.find(preset)

    def work(photograph: Photograph) -> Tensor:
        return recipe.apply(photograph.pixels)

    editing.edit_file(source, target, depth, work, landmarks=recipe.landmarks, factors=recipe.factors)
