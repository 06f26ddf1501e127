"""``nlfilter-torch denoise``: less noise."""

from typing import Annotated

import typer

from nlfilter_torch.cli import options

NoiseLevel = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        max=255.0,
        metavar="LEVELS",
        help="Strength of the noise: its standard deviation in grey levels of 255. Left out: estimated.",
    ),
]


def denoise(
    source: options.Source,
    target: options.Target,
    noise_level: NoiseLevel = None,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    landmarks: options.Landmarks = 200,
    seed: options.Seed = 0,
) -> None:
    """Remove noise from a photograph.

    Example: `nlfilter-torch denoise in.jpg out.jpg`

    Gently: `nlfilter-torch denoise in.jpg out.jpg --noise-level 3`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.edits.denoise import denoise as edit
    from nlfilter_torch.io.photographs import Photograph

    def work(photograph: Photograph) -> Tensor:
        level = None if noise_level is None else noise_level / options.LEVELS
        return edit(
            photograph.pixels, noise_level=level, **editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        )

    editing.edit_file(source, target, depth, work, landmarks=landmarks)
