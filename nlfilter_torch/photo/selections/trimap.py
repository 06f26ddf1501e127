"""Scribbles that cover most of a picture on both sides of a border, and settings of masks that depend on that."""

from torch import Tensor

SPARSE, DENSE = 0.3, 0.6  # share of a picture under scribbles up to which they are a few, and from which on a trimap


def trimap_share(painted: Tensor) -> Tensor:
    """How nearly scribbles are a trimap: 0 for a few of them, 1 for most of the picture, (...).

    Args:
        painted: weights (..., 2, n), for all pixels, of the scribbles on a region and on its background. 0 is returned
            where either side has none.
    """
    shares = (painted.detach() > 0).to(painted).mean(-1)
    return ((shares.sum(-1) - SPARSE) / (DENSE - SPARSE)).clamp(0.0, 1.0) * (shares.amin(-1) > 0)


def by_trimap(values: tuple[float, float], trimap: Tensor) -> Tensor:
    """A setting between its values for a few scribbles and for a trimap, by :func:`trimap_share`."""
    few, most = values
    return few + (most - few) * trimap
