"""How near likes have to be: the default of edits that work locally."""

from collections.abc import Sequence

from torch import Tensor


def nearby(given: float | Tensor | None, share: float, size: Sequence[int]) -> float | Tensor:
    """A spatial bandwidth in pixels: the one given, or for None a share of the short side of a picture (H, W).

    A share, so that a preview and the photograph agree.
    """
    return share * min(size) if given is None else given
