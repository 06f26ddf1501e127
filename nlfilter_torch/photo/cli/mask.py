"""``nlfilter-torch mask``: write a soft mask of an object in a photograph."""

from pathlib import Path
from typing import Annotated

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import signature, with_signature
from nlfilter_torch.photo.declared.json_values import Value
from nlfilter_torch.photo.declared.parameters import MASK

Target = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The mask: a grey picture of the photograph's size, white in the selected area. Its extension selects the "
        "file type: .tif (16 bits), .png, .jpg, .webp, .avif (8 bits) or .pfm (floats).",
    ),
]
Depth = Annotated[
    options.FileDepth | None,
    typer.Option(
        help="Bits of the mask, or floats (TIFF only): 16 also for .png. Default: see OUT.",
        rich_help_panel=options.FILES_PANEL,
    ),
]


def mask(
    source: str,
    target: str,
    *,
    region: list[str] | None = None,
    background: list[str] | None = None,
    add: list[str] | None = None,
    remove: list[str] | None = None,
    mask: Path | None = None,
    show: Path | None = None,
    depth: options.FileDepth | None = None,
    seed: int = 0,
    memory: float | None = None,
    full: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    **values: Value,
) -> None:
    """See :data:`MASK`."""
    from nlfilter_torch.photo.cli import editing
    from nlfilter_torch.photo.cli.mask_job import MaskJob
    from nlfilter_torch.photo.cli.scribbles import ScribbleOptions

    scribbles = ScribbleOptions(region, None, mask, {"--background": background, "--add": add, "--remove": remove})
    if not scribbles.marks_objects(MASK):
        raise ValueError(MASK.scribbles[0].advice)
    editing.check_apart("OUT", target, photograph=source, mask=mask)
    editing.check_apart("--show", show, photograph=source, output=target, mask=mask)
    job = MaskJob(values, source, Path(target), scribbles, show, seed, memory, full, depth)
    job.check_depth()
    editing.check_processes(source, target, workers, cluster)
    job.run(workers, cluster)


mask.__doc__, mask.__annotations__ = MASK.help, {}
with_signature(mask, signature(MASK, target=Target, depth=Depth))
