"""``nlfilter-torch tone``: contrast of large shapes and of the detail on them."""

from typing import Annotated

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.edits.presets import GAINS

Contrast = Annotated[
    float,
    typer.Option(
        min=GAINS[0],
        max=GAINS[1],
        metavar="GAIN",
        help="Contrast of the smooth shading: 1 leaves it, 1.4 is strong, 0.7 flattens.",
    ),
]
Clarity = Annotated[
    float,
    typer.Option(
        min=GAINS[0],
        max=GAINS[1],
        metavar="GAIN",
        help="Contrast of the largest details on it: 1 leaves it, 4 is strong.",
    ),
]


def tone(
    source: options.Source,
    target: options.Target,
    contrast: Contrast = 1.2,
    clarity: Clarity = 1.0,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    patch_size: options.PatchSize = 5,
    landmarks: options.Landmarks = 100,
    seed: options.Seed = 0,
) -> None:
    """Raise or lower contrast without a change of colour or of mean brightness, but where the picture clips.

    Example: `nlfilter-torch tone in.jpg out.jpg --contrast 1.2 --clarity 2`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.edits.tone import adjust_tone
    from nlfilter_torch.io.photographs import Photograph

    def work(photograph: Photograph) -> Tensor:
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return adjust_tone(photograph.pixels, contrast=contrast, clarity=clarity, patch_size=patch_size, **shared)

    editing.edit_file(source, target, depth, work, landmarks=landmarks, patch_size=patch_size)
