"""A function of colour on a grid: changes of the colours at its nodes, and in between by interpolation.

Colours are interpolated in tetrahedra, between the four nodes around them, as in Kasson et al., "Performing color space
conversions with three-dimensional linear interpolation" (1995). On the axis of greys these are the nodes of the two
nearest greys alone, so that greys depend on no other colours, and never get darker from one to the next if those of the
nodes do not.
"""

import torch
from torch import Tensor

from nlfilter_torch.photo.declared.declaration import MAX_NODES, nodes_of

NODES = 9  # along each axis, of a lattice to be learned


def lattice_change(image: Tensor, lattice: Tensor) -> Tensor:
    """Changes (B, 3, H, W) of an image of that shape, by those at the nodes, (3, n, n, n) or (B, 3, n, n, n).

    The nodes are evenly spaced on [0, 1] along red, green and blue, in this order. Colours outside change as the
    nearest inside. Differentiable in both.
    """
    places, weights = corners(image.flatten(2), lattice.shape[-1])
    values = lattice.to(image).flatten(-3).expand(image.shape[0], -1, -1)
    change = torch.zeros_like(image).flatten(2)
    for place, weight in zip(places.unbind(1), weights.unbind(1), strict=True):
        change = change + weight.unsqueeze(1) * values.gather(2, place.unsqueeze(1).expand(-1, 3, -1))
    return change.view_as(image)


def corners(colours: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """The four nodes around each of some colours (..., 3, P), as row-major indices (..., 4, P), and their weights."""
    places = colours.clamp(0, 1) * (nodes - 1)
    below = places.detach().floor().clamp(max=nodes - 2)
    red, green, blue = (places - below).unbind(-2)
    strides = (nodes * nodes, nodes, 1)
    largest, least = torch.maximum(red, torch.maximum(green, blue)), torch.minimum(red, torch.minimum(green, blue))
    middle = torch.maximum(torch.minimum(red, green), torch.minimum(torch.maximum(red, green), blue))
    # From the lowest node, along the axis of the largest coordinate, then of the middle, then of the least.
    low = below.long()
    first = (low[..., 0, :] * nodes + low[..., 1, :]) * nodes + low[..., 2, :]
    second = first + _stride(red >= largest, green >= largest, strides)
    last = first + sum(strides)
    third = last - _stride(red <= least, green <= least, strides)
    weights = (1 - largest, largest - middle, middle - least, least)
    return torch.stack([first, second, third, last], dim=-2), torch.stack(weights, dim=-2)


def _stride(red: Tensor, green: Tensor, strides: tuple[int, int, int]) -> Tensor:
    """Distance between the indices of nodes along the axis of red, or else of green, or else of blue."""
    along_green = torch.where(green, strides[1], strides[2])
    return torch.where(red, strides[0], along_green)


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
