"""``nlfilter-torch abstract``: a photograph as a painting."""

from typing import Annotated

import typer

from nlfilter_torch.cli import options

Power = Annotated[
    float,
    typer.Option(
        min=0.0, max=10.0, metavar="K", help="How much detail goes: 0 none, 0.1 all but outlines, 1 much more."
    ),
]
Edges = Annotated[
    float, typer.Option(min=0.0, max=1.0, metavar="0...1", help="Darkness of lines along edges: 0 draws none.")
]
EdgeWidth = Annotated[float, typer.Option(min=0.1, metavar="PIXELS", help="Width of these lines.")]
Tones = Annotated[
    int | None,
    typer.Option(min=2, max=64, metavar="N", help="Reduce brightness to so many tones. Left out: no such steps."),
]


def abstract(
    source: options.Source,
    target: options.Target,
    power: Power = 0.1,
    edges: Edges = 0.0,
    edge_width: EdgeWidth = 1.0,
    tones: Tones = None,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    landmarks: options.Landmarks = 200,
    seed: options.Seed = 0,
) -> None:
    """Turn a photograph into a painting: flat areas with clear outlines.

    Like a watercolour: `nlfilter-torch abstract in.jpg out.jpg`

    Like a comic: `nlfilter-torch abstract in.jpg out.jpg --edges 1 --tones 8 --bandwidth 50`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.edits.abstract import abstract as edit
    from nlfilter_torch.io.photographs import Photograph

    def work(photograph: Photograph) -> Tensor:
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return edit(photograph.pixels, power=power, edges=edges, edge_width=edge_width, tones=tones, **shared)

    editing.edit_file(source, target, depth, work, landmarks=landmarks)
