"""A function of colour on a grid: changes of the colours at its nodes, and in between by interpolation.

:mod:`nlfilter_torch.core.kernels.lattice` interpolates.
"""

import torch
from torch import Tensor

from nlfilter_torch.core.kernels.lattice import interpolate
from nlfilter_torch.photo.declared.declaration import MAX_NODES, nodes_of

NODES = 9  # along each axis, of a lattice to be learned


def lattice_change(image: Tensor, lattice: Tensor) -> Tensor:
    """Changes (B, 3, H, W) of an image of that shape, by those at the nodes, (3, n, n, n) or (B, 3, n, n, n).

    The nodes are evenly spaced on [0, 1] along red, green and blue, in this order. Colours outside change as the
    nearest inside. Differentiable in both.
    """
    lattices = lattice.to(image).view(-1, *lattice.shape[-4:])
    return interpolate(image.flatten(2), lattices).view_as(image)


def lattice_of(numbers: Tensor) -> Tensor:
    """A lattice (..., 3, n, n, n) from its numbers in a row, (..., 3 n^3)."""
    nodes = nodes_of(numbers.shape[-1])
    if nodes is None:
        raise ValueError(
            f"lattice must have the shape (3, n, n, n), n from 2 to {MAX_NODES}, or be as many numbers, "
            f"got {numbers.shape[-1]}; add or drop some"
        )
    return numbers.unflatten(-1, (3, nodes, nodes, nodes))


def colours_of_nodes(nodes: int) -> Tensor:
    """Colours (3, n, n, n) of the nodes, in float64."""
    steps = torch.arange(nodes, dtype=torch.float64) / (nodes - 1)
    return torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"))


def resampled(lattice: Tensor, nodes: int) -> Tensor:
    """A lattice (3, n, n, n) with another number of nodes, (3, m, m, m)."""
    flat = colours_of_nodes(nodes).flatten(1)[None, :, None]
    return lattice_change(flat, lattice.double())[0, :, 0].view(3, nodes, nodes, nodes)
