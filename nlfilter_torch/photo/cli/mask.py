"""``nlfilter-torch mask``: write a soft mask of an object in a photograph."""

from pathlib import Path
from typing import Annotated, Any

import typer

from nlfilter_torch.photo.cli import options
from nlfilter_torch.photo.cli.edits import with_declared
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

Cutout = Annotated[
    Path | None,
    typer.Option(
        help="Also write the object itself, a transparent .png, .tif, .webp or .avif of the photograph's depth, whose "
        "soft borders are free of the colours of the background.",
        rich_help_panel=options.FILES_PANEL,
    ),
]


@with_declared(MASK)
def mask(
    source: options.Source,
    target: Target,
    cutout: Cutout = None,
    depth: Depth = None,
    seed: options.Seed = 0,
    memory: options.Memory = None,
    full: options.Full = False,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    **values: Any,
) -> None:
    """See :data:`MASK`."""
    from nlfilter_torch.photo.cli import editing
    from nlfilter_torch.photo.cli.mask_job import MaskJob
    from nlfilter_torch.photo.cli.scribbles import ScribbleOptions

    strokes, region, mask, show = (values.pop(name) for name in ("strokes", "region", "mask", "show"))
    rectangles = {option.name: values.pop(option.name.removeprefix("--")) for option in MASK.with_options}
    scribbles = ScribbleOptions(region, strokes, mask, rectangles)
    if not scribbles.marks_objects(MASK):
        raise ValueError(MASK.scribbles[0].advice)
    editing.check_apart("OUT", target, photograph=source, mask=mask, strokes=strokes)
    others = {"photograph": source, "output": target, "mask": mask, "strokes": strokes}
    editing.check_apart("--show", show, **others)
    editing.check_apart("--cutout", cutout, **others, show=show)
    job = MaskJob(values, source, Path(target), scribbles, show, seed, memory, full, depth, cutout)
    job.check_depth()
    editing.check_processes(source, target, workers, cluster)
    job.run(workers, cluster)
