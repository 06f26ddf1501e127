"""``nlfilter-torch recolor``: new colours for everything that looks like the strokes."""

from typing import Annotated

import typer

from nlfilter_torch.cli import options

Reach = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=0.999,
        metavar="0...1",
        help="How far the colour spreads from what is alike to what is less so. 0 stays close, 0.95 goes far.",
    ),
]


def recolor(
    source: options.Source,
    target: options.Target,
    strokes: options.StrokesFile = None,
    region: options.ColourRegions = None,
    keep: options.Keeps = None,
    reach: Reach = 0.8,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    landmarks: options.Landmarks = 100,
    seed: options.Seed = 0,
    memory: options.Memory = None,
    full: options.Full = False,
) -> None:
    """Give things another colour: paint a little of it on one, and all that look alike take it.

    Brightness stays as it is to the last bit, and so does whatever looks like none of the strokes. Photographs that fit
    no memory are worked out in tiles; best as TIFF files or arrays of zarr, read in parts.

    A red car blue: `nlfilter-torch recolor in.jpg out.jpg --region 420,215,14,14:blue`

    Spare the wood: `nlfilter-torch recolor in.jpg out.jpg --strokes paint.png --keep 60,100,20,20`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli import scribble_rows as painted_rows
    from nlfilter_torch.cli import scribbles as painting
    from nlfilter_torch.cli.tiled import Job
    from nlfilter_torch.edits.recolor import recolor as edit
    from nlfilter_torch.io.photographs import Photograph
    from nlfilter_torch.tiled.recolor import recolor_rows
    from nlfilter_torch.tiled.sources import Rows

    def check(channels: int) -> None:
        editing.check_colour(channels, "recolor", "use nlfilter-torch colorize, which colours grey ones")

    def work(photograph: Photograph) -> Tensor:
        check(photograph.pixels.shape[1])
        painted, mask = painting.colour_strokes(photograph, strokes, region)
        kept = painting.selection(photograph, None, keep, option="--keep")
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return edit(photograph.pixels, painted, mask, keep=kept, reach=reach, **shared)

    def by_rows(job: Job) -> Rows:
        check(job.picture.shape[2])
        painted = painted_rows.stroke_rows(job, strokes, region)
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return recolor_rows(
            job.passes(full),
            job.picture.rows,
            painted,
            keep=painted_rows.mark_rows(job, keep, "--keep"),
            reach=reach,
            names=(source, str(strokes or "--region")),
            **shared,
        )

    editing.edit_file(source, target, depth, work, landmarks=landmarks, memory=memory, by_rows=by_rows)
