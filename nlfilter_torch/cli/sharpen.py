"""``nlfilter-torch sharpen``: sharper edges without more noise."""

from typing import Annotated

import typer

from nlfilter_torch.cli import options
from nlfilter_torch.edits.presets import GAINS

Amount = Annotated[
    float,
    typer.Option(
        min=GAINS[0],
        max=GAINS[1],
        metavar="GAIN",
        help="Strength: 1 leaves the photograph as it is, 4 is visible, 8 is strong.",
    ),
]
GuideBlur = Annotated[
    float,
    typer.Option(min=0.0, metavar="PIXELS", help="How much noise and the finest grain are overlooked: 0 not at all."),
]


def sharpen(
    source: options.Source,
    target: options.Target,
    amount: Amount = 4.0,
    guide_blur: GuideBlur = 1.2,
    bandwidth: options.OwnBandwidth = None,
    spatial_bandwidth: options.OwnSpatialBandwidth = None,
    depth: options.OutputDepth = None,
    patch_size: options.PatchSize = 5,
    landmarks: options.Landmarks = 100,
    seed: options.Seed = 0,
) -> None:
    """Sharpen a photograph and leave its noise alone: one slider instead of those of `nlfilter-torch detail`.

    Example: `nlfilter-torch sharpen in.jpg out.jpg --amount 5`
    """
    from torch import Tensor

    from nlfilter_torch.cli import editing
    from nlfilter_torch.edits.sharpen import sharpen as edit
    from nlfilter_torch.io.photographs import Photograph

    def work(photograph: Photograph) -> Tensor:
        shared = editing.common(bandwidth, spatial_bandwidth, landmarks, seed)
        return edit(photograph.pixels, amount=amount, guide_blur=guide_blur, patch_size=patch_size, **shared)

    editing.edit_file(source, target, depth, work, landmarks=landmarks, patch_size=patch_size)
