"""The stray parts of scribbles as a plane, for pictures that show them."""

from torch import Tensor

from nlfilter_torch.photo.picture.in_memory import InMemory
from nlfilter_torch.photo.selections.stray import strays


def stray_parts(source: InMemory, painted: Tensor) -> Tensor:
    """The parts (1, 1, H, W) of scribbles (1, 1, H, W) on an image that do not count."""
    scribbles = source.scribbles(painted, None, "scribbles", needed=False)
    return scribbles.weighted(strays(scribbles, source.size).to(source.image)).planes(source)
