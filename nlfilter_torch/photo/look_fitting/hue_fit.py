"""What hues do under an edit: a few parameters that also tell what becomes of colours that a pair does not have.

Lightness, saturation and hue change by hue, in proportion to the chroma of colours, and differently in the dark and in
the light: products of six hats on the circle of hues with few functions. They are fitted by least squares to what the
other parts of a look leave, and sampled on the grid of a lattice, to which they are added. Greys stay as they are.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nlfilter_torch.operator.features import reduce_channels
from nlfilter_torch.photo.look_fitting.lattice_fit import LOOSER, ColourChange
from nlfilter_torch.photo.looks.lattice import colours_of_nodes

HUES = 6  # hats, at red, yellow, green, cyan, blue and magenta
NODES = 17  # of the grid that the changes are sampled on
RIDGES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # relative to the squares of the columns
ENOUGH = 1 << 14  # pixels that the parameters are fitted to
PRIOR = 1e-4  # weight of evenly distributed colours that stay as they are, and keep hues of few pixels as they are
TINY = 1e-9


def hue_columns(colours: Tensor) -> Tensor:
    """What a unit of each parameter changes of colours (3, P) in [0, 1]: (F, 3, P)."""
    red, green, blue = colours
    largest = colours.amax(0)
    chroma = largest - colours.amin(0)
    light = reduce_channels(colours[None, :, None], "luminance").view_as(chroma)
    safe = chroma.clamp(min=TINY)
    hue = torch.where(
        largest == red,
        ((green - blue) / safe) % HUES,
        torch.where(largest == green, (blue - red) / safe + 2, (red - green) / safe + 4),
    )
    numbers = torch.arange(HUES, dtype=hue.dtype).view(-1, 1)
    hats = (1 - ((hue - numbers + 3) % HUES - 3).abs()).clamp(min=0)
    saturated = colours - colours.mean(0)
    turned = torch.stack([green - blue, blue - red, red - green]) / 3**0.5
    lighter = chroma.expand(3, -1)
    kinds = torch.stack([lighter, saturated, turned, light * lighter, light * saturated, light * turned])
    kinds = torch.cat([kinds, chroma * torch.stack([lighter, saturated])])
    return (hats[:, None, None] * kinds).flatten(0, 1)


@dataclass(frozen=True)
class _Sums:
    """Products (F, F) of the columns, and (F,) of these and what is to be explained.

    ``even`` are squares (F,) of the columns of evenly distributed colours.
    """

    gram: Tensor
    cross: Tensor
    even: Tensor

    def solve(self, ridge: float) -> Tensor:
        """The parameters (F,)."""
        free = ridge * self.gram.diagonal() + PRIOR * self.even
        return torch.linalg.solve(self.gram + torch.diag(free + TINY), self.cross)


def fit_hues(pixels: ColourChange) -> list[Tensor]:
    """Changes (3, n, n, n) for each of the looks in :class:`ColourChange`, by a ridge that leaves least of folds.

    They are zero if that is hardly less than without them.
    """
    few = _thinned(pixels)
    columns, number = hue_columns(few.before), len(few.predicted) - 1
    nodes = hue_columns(colours_of_nodes(NODES).flatten(1))
    even = nodes.square().sum(1).mean(1)
    sums = [_sums(few, columns, even, fold, fold) for fold in range(number)]
    best, least = None, LOOSER * sum(few.energy(few.left(0.0, fold), fold) for fold in range(number))
    for ridge in RIDGES:
        solved = [others.solve(ridge) for others in sums]
        left = sum(few.energy(few.left(_change(columns, x), i), i) for i, x in enumerate(solved))
        if left < least:
            best, least = (ridge, solved), left
    if best is None:
        return [torch.zeros(3, NODES, NODES, NODES, dtype=torch.float64)] * (number + 1)
    ridge, solved = best
    solved.append(_sums(few, columns, even, number).solve(ridge))
    return [_change(nodes, parameters).view(3, NODES, NODES, NODES) for parameters in solved]


def _change(columns: Tensor, parameters: Tensor) -> Tensor:
    return torch.einsum("f,fcp->cp", parameters, columns)


def _sums(pixels: ColourChange, columns: Tensor, even: Tensor, look: int, fold: int | None = None) -> _Sums:
    """Sums over the pixels but for a fold, for what the look of that number leaves."""
    weights = pixels.weights if fold is None else pixels.weights * (pixels.folds != fold)
    weighed = (columns * weights).flatten(1)
    return _Sums(weighed @ columns.flatten(1).mT, weighed @ pixels.left(0.0, look).flatten(), even)


def _thinned(pixels: ColourChange) -> ColourChange:
    """Some of the pixels, evenly."""
    step = 1 + (len(pixels.weights) - 1) // ENOUGH
    before, after = pixels.before[:, ::step], pixels.after[:, ::step]
    predicted = [result[:, ::step] for result in pixels.predicted]
    return ColourChange(before, after, predicted, pixels.weights[::step], pixels.folds[::step])
