"""``nlfilter-torch colorize``: colours for a grey photograph from a few strokes."""

from enum import StrEnum
from typing import Annotated

import typer

from nlfilter_torch.cli import options


class Method(StrEnum):
    """How colours spread."""

    regression = "regression"
    kmeans = "kmeans"


Spread = Annotated[
    Method,
    typer.Option(
        help="Soft colours that mix between strokes, or one flat colour for each of as many pieces (k-means)."
    ),
]
Strength = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="0...1",
        help="How much colour goes to what resembles no stroke: 1 colours everything, 0 leaves it grey.",
    ),
]


def colorize(
    source: options.Source,
    target: options.Target,
    strokes: options.StrokesFile = None,
    region: options.ColourRegions = None,
    strength: Strength = 1.0,
    method: Spread = Method.regression,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    landmarks: options.Landmarks = 100,
    seed: options.Seed = 0,
    memory: options.Memory = None,
    full: options.Full = False,
) -> None:
    """Colour a grey photograph: paint some strokes, and the colours spread over what looks alike nearby.

    Brightness stays as it is. A photograph in colour is taken for a grey one: its own colours are replaced. Photographs
    that fit no memory are worked out in tiles, by regression; best as TIFF files or arrays of zarr, read in parts.

    Example: `nlfilter-torch colorize grey.jpg out.jpg --strokes paint.png`

    Without painting: `nlfilter-torch colorize grey.jpg out.jpg --region 10,10,30,30:skyblue --region 10,300,9,9:green`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli import scribble_rows as painted_rows
    from nlfilter_torch.cli import scribbles as painting
    from nlfilter_torch.cli.tiled import Job
    from nlfilter_torch.edits.colorize import colorize as edit
    from nlfilter_torch.io.photographs import Photograph
    from nlfilter_torch.operator.features import reduce_channels
    from nlfilter_torch.tiled.colorize import colorize_rows
    from nlfilter_torch.tiled.sources import Rows

    def work(photograph: Photograph) -> Tensor:
        painted, mask = painting.colour_strokes(photograph, strokes, region)
        grey = reduce_channels(photograph.pixels, "luminance")
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return edit(grey, painted, mask, method=method.value, strength=strength, **shared)

    def by_rows(job: Job) -> Rows:
        painted = painted_rows.stroke_rows(job, strokes, region)
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return colorize_rows(
            job.passes(full),
            job.picture.rows,
            painted,
            method=method.value,
            strength=strength,
            names=(source, str(strokes or "--region")),
            **shared,
        )

    editing.edit_file(source, target, depth, work, landmarks=landmarks, memory=memory, by_rows=by_rows, coloured=True)
