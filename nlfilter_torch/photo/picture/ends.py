"""The range of values of a picture."""

from torch import Tensor


def ends_of(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest values (B, C, 1, 1) of planes (B, C, H, W)."""
    return planes.amin((2, 3), keepdim=True), planes.amax((2, 3), keepdim=True)
