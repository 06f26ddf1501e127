"""Functions of colour on a lattice: values at its nodes, and in between by interpolation.

Colours are interpolated in tetrahedra, between the four nodes around them, as in Kasson et al., "Performing color space
conversions with three-dimensional linear interpolation" (1995). On the axis of greys these are the nodes of the two
nearest greys alone, so that greys depend on no other colours, and never get darker from one to the next if those of the
nodes do not.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from nlfilter_torch.core.kernels.library import by_rows, kernel, place, pointer, run, threads
from nlfilter_torch.core.torch_internals import register

MOST = 128  # nodes along each axis that the kernel in C takes; it counts them in 32 bits


def _compiled_interpolate(colours: Tensor, lattice: Tensor) -> Tensor | None:
    nodes = lattice.shape[-1]
    if nodes > MOST:
        return None
    colours = by_rows(colours)
    batch, _, pixels = colours.shape
    packed = F.pad(lattice.flatten(2).mT, (0, 1)).contiguous()  # the values of a node are read together
    step = packed.stride(0) if len(packed) > 1 else 0
    out = colours.new_empty(colours.shape)
    arguments = (*place(colours), pointer(packed), step, pointer(out))
    run("lattice", threads(colours), pixels, batch, nodes, *arguments)
    return out


@register(
    "interpolate(Tensor colours, Tensor lattice) -> Tensor",
    kernel(_compiled_interpolate),
    lambda colours, lattice: colours.new_empty(colours.shape),
    differentiable=True,
)
def interpolate(colours: Tensor, lattice: Tensor) -> Tensor:
    """Values (B, 3, P) at colours (B, 3, P), by those at the nodes of a lattice, (1 or B, 3, n, n, n).

    The nodes are evenly spaced on [0, 1] along red, green and blue, in this order. Colours outside have the values of
    the nearest inside; those with NaN have NaN. Differentiable in both.
    """
    places, weights = corners(colours, lattice.shape[-1])
    nodes = lattice.flatten(2).expand(len(colours), -1, -1)
    values = colours.new_zeros(colours.shape)
    for index, weight in zip(places.unbind(1), weights.unbind(1), strict=True):
        values = values + weight.unsqueeze(1) * nodes.gather(2, index.unsqueeze(1).expand(-1, 3, -1))
    return values


def corners(colours: Tensor, nodes: int) -> tuple[Tensor, Tensor]:
    """The four nodes around each of some colours (..., 3, P), as row-major indices (..., 4, P), and their weights."""
    places = colours.clamp(0, 1) * (nodes - 1)
    below = places.detach().floor().clamp(max=nodes - 2)
    red, green, blue = (places - below).unbind(-2)
    strides = (nodes * nodes, nodes, 1)
    largest, least = torch.maximum(red, torch.maximum(green, blue)), torch.minimum(red, torch.minimum(green, blue))
    middle = torch.maximum(torch.minimum(red, green), torch.minimum(torch.maximum(red, green), blue))
    # From the lowest node, along the axis of the largest coordinate, then of the middle, then of the least.
    low = below.nan_to_num().long()
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
