"""``nlfilter-torch develop``: exposure, white balance, straightening and crop."""

from typing import Any

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import with_declared
from nlfilter_torch.photo.declared.development import DEVELOP, Development
from nlfilter_torch.photo.declared.presets import Recipe


@with_declared(DEVELOP)
def develop(
    source: options.Source,
    target: options.Target,
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

    from nlfilter_torch.photo.cli import editing
    from nlfilter_torch.photo.cli.recipe_job import RecipeJob

    if recipe.develop.is_idle:
        options.note(f"no option changes anything: {target} is written without an edit")
    job = RecipeJob([recipe], [], source, target, full=False)
    editing.edit_file(
        job, source, target, depth, memory=memory, workers=workers, cluster=cluster, quality=quality, force=force
    )
