"""``nlfilter-torch defocus``: blur all but what is chosen."""

from enum import StrEnum
from typing import Annotated

import typer

from nlfilter_torch.cli import options


class Aperture(StrEnum):
    """Shape of a blurred dot."""

    disc = "disc"
    gaussian = "gaussian"


Radius = Annotated[
    float | None,
    typer.Option(metavar="PIXELS", help="Radius of the strongest blur. Left out: a fortieth of the short side."),
]
Shape = Annotated[Aperture, typer.Option(help="Turn dots into discs, as a lens does, or into soft spots.")]


def defocus(
    source: options.Source,
    target: options.Target,
    region: options.Regions = None,
    mask: options.MaskFile = None,
    radius: Radius = None,
    aperture: Shape = Aperture.disc,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    landmarks: options.Landmarks = 100,
    seed: options.Seed = 0,
) -> None:
    """Blur a photograph as a wide aperture would, but for what you mark and all that looks like it nearby.

    Mark some spots of each part that is to stay sharp; the rest of it is found.

    Example: `nlfilter-torch defocus in.jpg out.jpg --region 190,60,60,60 --region 60,260,40,180`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.cli import scribbles as painting
    from nlfilter_torch.edits.defocus import defocus as edit
    from nlfilter_torch.io.photographs import Photograph

    def work(photograph: Photograph) -> Tensor:
        focus = painting.selection(photograph, mask, region, option="--region")
        if focus is None:
            raise ValueError(
                "give --region X,Y,W,H or --mask FILE: what is to stay sharp, such as --region 190,60,60,60"
            )
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return edit(photograph.pixels, focus, radius=radius, aperture=aperture.value, **shared)

    editing.edit_file(source, target, depth, work, landmarks=landmarks)
